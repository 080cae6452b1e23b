"""The README: its links, its commands, and that it stays short. Its Python is run by `test_documents.py`."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(), re.DOTALL)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md"])
def test_links_and_pictures_exist(name):
    page = README.parent / name
    for target in re.findall(r"\]\((?!http)([^)#]+)[^)]*\)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_it_takes_two_minutes():
    assert len(README.read_text().split()) < 700


def test_commands_are_those_of_the_package():
    from gsisio_jax.cli import main

    commands = {line.split()[0] for block in blocks("sh") for line in re.findall(r"\bgsisio (.*)", block)}
    assert commands == {"estimate"}
    for command in commands:
        with pytest.raises(SystemExit) as stop:
            main([command, "--help"])
        assert stop.value.code == 0

"""What the README says is run: its Python, and the commands it names."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(), re.DOTALL)


def test_the_python_examples_run():
    """In order, as one session: the later ones go on with what the first one made."""
    session: dict = {}
    for code in blocks("python"):
        exec(compile(code, str(README), "exec"), session)
    assert dict(session["study"].sizes) == {"box": 50, "noise": 3, "state": 2, "input": 2}


def test_links_and_pictures_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target


def test_commands_are_those_of_the_package():
    from gsisio_jax.cli import main

    commands = {line.split()[0] for block in blocks("sh") for line in re.findall(r"\bgsisio (.*)", block)}
    assert commands == {"estimate"}
    for command in commands:
        with pytest.raises(SystemExit) as stop:
            main([command, "--help"])
        assert stop.value.code == 0

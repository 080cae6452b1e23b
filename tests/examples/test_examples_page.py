"""The page of examples: all of them, their sentence, their picture; its code runs."""

import re
from pathlib import Path

import gsisio_jax as gx

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "examples.md").read_text("utf-8")


def test_the_page_has_every_example():
    assert re.findall(r"^## (.*)$", PAGE, re.MULTILINE) == list(gx.examples.names())
    text = " ".join(PAGE.replace("`", "").split()).lower()
    for name, sentence in gx.examples.teaches().items():
        assert sentence.lower() in text, name
        example = gx.examples.load(name)
        sizes = f"{example.system.n}, {example.system.l}, {example.system.p}"
        assert re.search(rf"\| \[{name}\]\(#{name}\)[^|]*\| {sizes} \|", PAGE), name


def test_pictures_and_links_are_there_and_small():
    for target in re.findall(r"\]\((?!http|#)([^)#]+)\)", PAGE):
        assert (DOCS / target).exists(), target
    for picture in (DOCS / "images" / "examples").iterdir():
        assert picture.stat().st_size < 60_000, picture.name
        assert f"(images/examples/{picture.name})" in PAGE


def test_the_code_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    session: dict = {}
    exec(compile(code, "examples.md", "exec"), session)
    assert "power_lower" in session["table"].columns
    assert (tmp_path / "tclab.png").exists()

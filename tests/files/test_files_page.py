"""Every block of the page about files runs, in order, as one session in an empty folder."""

import re
import sys
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "files.md"


def test_the_page_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    found = re.findall(r"```(python|text)\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    session: dict = {}
    said = ""
    for language, text in found:
        if language == "text":  # what the block before has printed
            expected = re.escape(" ".join(text.split())).replace(r"\.\.\.", r"\d*")
            assert re.fullmatch(expected, " ".join(said.split())), said
        elif text.startswith("# plant.py"):
            (tmp_path / "plant.py").write_text(text)
        else:
            capsys.readouterr()
            exec(compile(text, str(PAGE), "exec"), session)
            said = capsys.readouterr().out
    sys.modules.pop("plant", None)
    assert sum(language == "text" for language, _ in found) == 2
    assert (tmp_path / "boxes.png").stat().st_size > 10_000
    assert not list(tmp_path.glob(".*"))

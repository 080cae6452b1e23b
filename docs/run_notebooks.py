"""Runs the notebooks and keeps their outputs in them, so that they can be read without being run.

Run from the root of the repository: ``python docs/run_notebooks.py [NAME ...]``.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"


def run(path: Path) -> None:
    """Execute a notebook in place. Names of temporary folders and times of cells would differ with every run."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": FOLDER}}).execute()
    notebook.metadata.pop("language_info", None)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            _without_temporary_names(output)
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if not _wiped_out(output)]
    nbformat.write(notebook, path)


def _wiped_out(output: Any) -> bool:
    """Progress of a design: nothing of it is left on a page, but in the file it would differ with every run."""
    return output.get("name") == "stderr" and output.get("text", "").startswith("\r")


def _without_temporary_names(part: Any) -> None:
    for key, value in part.items():
        if isinstance(value, str):
            part[key] = re.sub(r"/tmp/tmp\w+", "/tmp/out", value)
        elif isinstance(value, dict):
            _without_temporary_names(value)


def main() -> None:
    os.environ.pop("MPLBACKEND", None)  # pictures go into the notebook
    for path in sorted(FOLDER.glob("*.ipynb")):
        if not sys.argv[1:] or path.stem in sys.argv[1:]:
            run(path)
            print(path.name, f"{path.stat().st_size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    main()

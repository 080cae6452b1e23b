"""Pages that live elsewhere in the repository, and links to files outside of `docs/`.

Sources link as a checkout does (``../benchmarks/README.md``). On the site some of these files are pages of their own;
any other is copied beside the pages, so that the site is complete by itself.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
PAGES = {
    "benchmarks/README.md": "benchmarks.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
# "theory 2.1", "theory 2.8-2.11", "theory 3, 4 and 6"
THEORY = re.compile(r"\btheory \d+(?:\.\d+)?(?:(?:,\s+|\s+and\s+|-)\d+(?:\.\d+)?)*\b(?![^<]*</a>)")
SECTION = re.compile(r"(?:theory )?(\d+)(?:\.(\d+))?")
# A template of mkdocstrings leaves a space before this bracket.
DEFAULT = re.compile(r"(default:\s*<code>(?:(?!</code>).)*</code>)\s+\)", re.DOTALL)


def outside(source: str, target: str) -> str | None:
    """Path of the file that the page `source` links to, both from the root of the repository; None where a link holds
    on the site as it is: an address, or from one page of `docs/` to another."""
    if re.match(r"[a-z]+:", target):
        return None
    path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
    within = path.startswith("docs/") and source.startswith("docs/")
    return path if not within and (ROOT / path).is_file() else None


def place(path: str) -> str:
    """Where a file of the repository lies on the site."""
    return path.removeprefix("docs/") if path.startswith("docs/") else PAGES.get(path, f"files/{path}")


def origin(uri: str) -> str:
    """Where a page of the site lies in the repository."""
    return {page: path for path, page in PAGES.items()}.get(uri, f"docs/{uri}")


def on_files(files: Any, config: Any) -> Any:
    for path, uri in PAGES.items():
        files.append(File.generated(config, uri, content=(ROOT / path).read_text(encoding="utf-8")))
    for page in list(files.documentation_pages()):
        for _, target, _ in LINK.findall(page.content_string):
            path = outside(origin(page.src_uri), target)
            if path and not path.startswith("docs/") and place(path) not in files.src_uris:
                files.append(File.generated(config, place(path), abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    source = origin(page.file.src_uri)
    here = posixpath.dirname(page.file.src_uri)

    def moved(match: re.Match[str]) -> str:
        before, target, after = match.groups()
        path = outside(source, target)
        if path is None:
            return match.group()
        return f"{before}{posixpath.relpath(place(path), here or '.')}{after}"

    return LINK.sub(moved, markdown)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Docstrings cite "theory N.M": a link on the pages of the reference."""
    if not page.file.src_uri.startswith("reference/"):
        return html

    def linked(match: re.Match[str]) -> str:
        anchor = f"theory-{'-'.join(filter(None, match.groups()))}"
        return f'<a href="../theory.html#{anchor}">{match.group()}</a>'

    return THEORY.sub(lambda match: SECTION.sub(linked, match.group()), DEFAULT.sub(r"\1)", html))

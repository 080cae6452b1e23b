"""The documentation as a site: it builds without a warning, shows every formula, and needs no network."""

from __future__ import annotations

import importlib.util
import logging
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest

import gsisio_jax as gx

ROOT = Path(__file__).parents[1]
SITE = ROOT / "docs" / "_site"
LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src"}


class Page(HTMLParser):
    """What a page loads, its anchors, its formulas, and its plain text."""

    def __init__(self, path: Path):
        super().__init__()
        self.loads, self.anchors, self.text, self.formulas, self.open = set(), set(), [], 0, []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.formulas += tag == "math"
        self.anchors |= {found.get("id")}
        # A canonical address or an icon's name loads nothing.
        if tag in LOADED and (tag != "link" or found.get("rel") in ("stylesheet", "preload", "icon", "modulepreload")):
            self.loads.add(found.get(LOADED[tag]))
        if tag in ("math", "code", "pre", "script", "style"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_data(self, data):
        if not self.open:
            self.text.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    out, records = tmp_path_factory.mktemp("site"), []
    handler = logging.Handler(logging.WARNING)
    handler.emit = records.append  # type: ignore[method-assign]
    logging.getLogger("mkdocs").addHandler(handler)
    try:
        build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(out)))
    finally:
        logging.getLogger("mkdocs").removeHandler(handler)
    assert [record.getMessage() for record in records] == []
    return {path.relative_to(out).as_posix(): Page(path) for path in out.rglob("*.html")}


def formulas(text: str) -> int:
    """Formulas of a Markdown page: between dollars, outside of code."""
    text = re.sub(r"^```.*?^```$|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
    display = re.findall(r"\$\$.+?\$\$", text, re.DOTALL)
    return len(display) + len(re.findall(r"\$[^$]+\$", re.sub(r"\$\$.+?\$\$", "", text, flags=re.DOTALL)))


def test_every_formula_is_rendered(site):
    for source in sorted((ROOT / "docs").rglob("*.md")):
        page = source.relative_to(ROOT / "docs").as_posix().replace("README.md", "index.md").replace(".md", ".html")
        assert site[page].formulas >= formulas(source.read_text(encoding="utf-8")), page
        assert not re.search(r"\\[a-z]{2,}|\$", "".join(site[page].text)), page
    assert site["theory.html"].formulas > 800


def hook(name):
    spec = importlib.util.spec_from_file_location(name, SITE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(module := importlib.util.module_from_spec(spec))
    return module


def test_formulas_are_what_browsers_show():
    mathml, space = hook("mathematics").mathml, '<mspace width="0.167em" />'
    # Names stand apart from what they are applied to, but not from brackets or their own index.
    assert f"<mi>cos</mi>{space}<mi>m</mi>{space}<mi>cos</mi>{space}<mi>r</mi>" in mathml(r"\cos m\cos r", "inline")
    assert f"<mn>2</mn>{space}<mi>eps</mi>" in mathml(r"2\mathrm{eps}", "inline")
    assert "mspace" not in mathml(r"\sin(x)+\mathrm{clip}_Y(b)", "inline")
    # A space of TeX that browsers would drop.
    assert space in mathml(r"A\thinspace\delta", "inline")
    assert "<msup><mrow>" in mathml(r"{\binom lq}^2", "inline")


def test_a_formula_stays_with_the_punctuation_around_it():
    def shown(before, after):
        html = rf'text {before}<span class="arithmatex">\(x\)</span>{after} text'
        return re.sub("<math.*</math>", "x", hook("mathematics").on_page_content(html, None, None, None))

    assert shown("", "") == "text x text"
    assert shown("(", "),") == 'text <span class="kept">(x),</span> text'
    assert shown("", "'s") == """text <span class="kept">x's</span> text"""


def test_every_section_that_a_docstring_cites_is_a_link():
    links, page = hook("links"), SimpleNamespace(file=SimpleNamespace(src_uri="reference/design.md"))
    shown = links.on_page_content("theory 3, 4.1 and 6; theory 2.8-2.11.", page, None, None)
    assert re.findall("#theory-([0-9-]+)", shown) == ["3", "4-1", "6", "2-8", "2-11"]
    code = "(<code>int</code>, default:\n  <code>3</code>\n)"
    assert links.on_page_content(code, page, None, None).endswith("<code>3</code>)")


@pytest.mark.parametrize(
    ("formula", "named"),
    [
        (r"\binom lq^2", "braces"),  # three parts and a power in one element
        (r"\begin{aligned} a &= b \end{aligned}", "no MathML"),  # a bare ampersand
        (r"\nosuch x", r"\nosuch"),
    ],
)
def test_formulas_that_browsers_would_show_wrongly_are_errors(formula, named):
    with pytest.raises(ValueError, match=re.escape(named)):
        hook("mathematics").mathml(formula, "inline")


def test_a_session_of_a_docstring_is_one_block():
    text = "Before.\n\n    >>> print(table)\n    head\n      1  2\n\nAfter."
    assert "```pycon\n    >>> print(table)\n    head\n      1  2\n    ```\n" in hook("docstrings").fenced(text)


def test_names_that_share_a_line_of_a_docstring_have_their_own_type():
    import griffe

    code, joined = "class C:\n    K: int\n    L: float\n    M: int\n", hook("docstrings").joined
    found = griffe.visit("m", filepath=Path("m.py"), code=code)["C"]
    assert joined("    K, M: text", found) == "    K,\xa0M (int): text"
    assert joined("    K, L: text", found) == "    K,\xa0L (int, float): text"
    assert joined("    K, other: text", found) == "    K,\xa0other: text"


def test_nothing_is_loaded_from_elsewhere(site):
    for name, page in site.items():
        assert not [target for target in page.loads if re.match(r"(https?:)?//", target or "")], name


def test_every_public_name_has_its_place_in_the_reference(site):
    anchors = set().union(*(page.anchors for name, page in site.items() if name.startswith("reference/")))
    modules = ("inclusion", "study", "tuning", "plot", "paper")
    parts = {f"{module}.{name}": getattr(getattr(gx, module), name) for module in modules
             for name in getattr(gx, module).__all__}  # fmt: skip
    # A function in a file of its own name is shown from there.
    places = {name: {f"gsisio_jax.{name}", f"gsisio_jax.{name}.{name.rpartition('.')[2]}"} for name in parts}
    assert [name for name in parts if not places[name] & anchors] == []
    # Some names stand in two places, and are shown in one of them.
    shown = {id(value) for name, value in parts.items()}
    top = [name for name in gx.__all__ if name not in (*modules, "dataset", "estimation", "examples")]
    found = {n for n in top if {f"gsisio_jax.{n}", f"gsisio_jax.{n}.{n}"} & anchors or id(getattr(gx, n)) in shown}
    assert set(top) - found == set()


def test_sections_of_the_theory_have_the_anchors_that_docstrings_cite(site):
    cited, links = set(), hook("links")
    for path in (ROOT / "gsisio_jax").rglob("*.py"):
        for citation in links.THEORY.findall(path.read_text(encoding="utf-8")):
            cited |= {".".join(filter(None, parts)) for parts in links.SECTION.findall(citation)}
    assert len(cited) > 20
    missing = {section for section in cited if f"theory-{section.replace('.', '-')}" not in site["theory.html"].anchors}
    assert missing == set()

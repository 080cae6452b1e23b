"""Formulas become MathML when the site is built: no script, no font and no network is needed to read them."""

from __future__ import annotations

import html as entities
import itertools
import re
import unicodedata
from typing import Any
from xml.etree import ElementTree

from latex2mathml.converter import convert

# With what stands beside it without a space: a bracket, a comma, "'s", "-th".
INLINE = re.compile(r'([(\["]*)<span class="arithmatex">\\\((.*?)\\\)</span>([^\s<]{0,12}(?![^\s<]))?', re.DOTALL)
# Browsers know no variants but "normal": letters of another alphabet are characters of their own.
VARIANT = re.compile(r'<(m[in]) mathvariant="(double-struck|script|bold)">(\w)</m[in]>')
ALPHABETS = {"double-struck": "DOUBLE-STRUCK", "script": "SCRIPT", "bold": "BOLD"}
# These stood in Unicode before the rest.
LETTERS = {("script", letter): found for letter, found in zip("BEFHILMR", "ℬℰℱℋℐℒℳℛ", strict=True)}
LETTERS |= {("double-struck", letter): found for letter, found in zip("CHNPQRZ", "ℂℍℕℙℚℝℤ", strict=True)}
# A minus after a bracket, a comma or a relation is a sign, without the space of a difference.
SIGN = re.compile(
    r"((?:<mo[^>]*>(?:[\[(,;]|&#x0002[8C];|&#x0005B;|&#x0003[BCDE];|&#x02264;|&#x02265;)</mo>))<mo>&#x02212;</mo>"
)
# A word in upright letters is one name.
WORD = re.compile(r'<mrow>((?:<mi mathvariant="normal">[A-Za-z]</mi>){2,})</mrow>')
SPACE = "http://www.w3.org/1998/Math/MathML"
ElementTree.register_namespace("", SPACE)
# How many parts these have. The converter gives the power of a binomial coefficient more: browsers show a row.
PARTS = {"msub": 2, "msup": 2, "mfrac": 2, "mover": 2, "munder": 2, "mroot": 2, "msubsup": 3, "munderover": 3}
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def _letter(match: re.Match[str]) -> str:
    tag, variant, letter = match.groups()
    kind = "DIGIT" if letter.isdigit() else "SMALL" if letter.islower() else "CAPITAL"
    spoken = unicodedata.name(letter).rpartition(" ")[2]
    found = LETTERS.get((variant, letter)) or unicodedata.lookup(f"MATHEMATICAL {ALPHABETS[variant]} {kind} {spoken}")
    return f'<{tag} mathvariant="normal">{found}</{tag}>'


def _tag(part: ElementTree.Element) -> str:
    return part.tag.removeprefix(f"{{{SPACE}}}")


def _name(part: ElementTree.Element) -> bool:
    """A name of several letters (sin, rank, eps), or one with an index."""
    if _tag(part) in ("msub", "msup", "msubsup"):
        return _name(part[0])
    text = part.text or ""
    return _tag(part) == "mi" and len(text) > 1 and text.isalpha()  # .5 is an identifier to the converter


def _spaced(formula: str, made: str) -> str:
    """Names stand apart from what they are applied to (sin x, 2 eps), unless that has brackets."""
    try:
        tree = ElementTree.fromstring(made)
    except ElementTree.ParseError as error:
        raise ValueError(f"formula {formula!r}: latex2mathml makes no MathML of it ({error})") from error
    for part in list(tree.iter()):
        if len(part) != PARTS.get(_tag(part), len(part)):
            raise ValueError(
                f"formula {formula!r}: put what has an index or a power into braces, as in {{\\binom nk}}^2"
            )
        if _tag(part) not in ("math", "mrow", "mstyle"):
            continue
        between = [
            i + 1
            for i, (one, two) in enumerate(itertools.pairwise(part))
            if (_name(one) or _name(two)) and not {_tag(one), _tag(two)} & {"mo", "mspace", "mtext"}
        ]
        for i in reversed(between):
            part.insert(i, ElementTree.Element(f"{{{SPACE}}}mspace", width="0.167em"))
    return ElementTree.tostring(tree, encoding="unicode")


def mathml(formula: str, display: str) -> str:
    """MathML of TeX. The converter keeps what it does not know as text, which must not reach a reader."""
    made = convert(entities.unescape(formula).strip(), display=display)
    unknown = re.findall(r"\\[A-Za-z]+", re.sub(r"<annotation.*?</annotation>", "", made, flags=re.DOTALL))
    if unknown:
        raise ValueError(f"formula {formula!r}: latex2mathml does not know {unknown[0]}")
    made = WORD.sub(lambda match: f"<mi>{re.sub('<[^>]*>', '', match[1])}</mi>", made)
    made = made.replace('width="thinmathspace"', 'width="0.167em"')  # browsers know no names of widths
    made = VARIANT.sub(_letter, made)
    if left := re.search(r'mathvariant="(?!normal)([a-z-]+)"', made):
        raise ValueError(f"formula {formula!r}: no browser shows mathvariant {left[1]!r}")
    made = SIGN.sub(r'\1<mo form="prefix">&#x02212;</mo>', made)
    made = re.sub(r"<mi>(&#x000B1;)</mi>", r"<mo>\1</mo>", made)
    # Bars are fences here, never a relation: no space around them.
    for bar in ("&#x0007C;", "&#x02016;"):
        made = made.replace(f"<mo>{bar}</mo>", f'<mo fence="true" stretchy="false" lspace="0" rspace="0">{bar}</mo>')
    return _spaced(formula, made)


def _inline(match: re.Match[str]) -> str:
    """Browsers do not break formulas: on a narrow screen the longest ones scroll within their line. They break between
    a formula and the comma behind it, though: the two are held together."""
    before, formula, after = match[1], match[2], match[3] or ""
    made = f"{before}{mathml(formula, 'inline')}{after}"
    if len(re.sub(r"\\[a-z]+", "", formula)) > 25:
        return f'<span class="long-formula">{made}</span>'
    return f'<span class="kept">{made}</span>' if before or after else made


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    html = BLOCK.sub(lambda m: f'<div class="formula">{mathml(m[1], "block")}</div>', html)
    html = INLINE.sub(_inline, html)
    if "arithmatex" in html:
        raise ValueError(f"{page.file.src_uri}: a formula was not rendered")
    return html

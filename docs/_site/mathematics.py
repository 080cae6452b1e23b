"""Formulas become MathML when the site is built: no script, no font and no network is needed to read them."""

from __future__ import annotations

import html as entities
import re
import unicodedata
from typing import Any

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
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
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def _letter(match: re.Match[str]) -> str:
    tag, variant, letter = match.groups()
    kind = "DIGIT" if letter.isdigit() else "SMALL" if letter.islower() else "CAPITAL"
    spoken = unicodedata.name(letter).rpartition(" ")[2]
    found = LETTERS.get((variant, letter)) or unicodedata.lookup(f"MATHEMATICAL {ALPHABETS[variant]} {kind} {spoken}")
    return f'<{tag} mathvariant="normal">{found}</{tag}>'


def mathml(formula: str, display: str) -> str:
    """MathML of TeX. The converter keeps what it does not know as text, which must not reach a reader."""
    made = convert(entities.unescape(formula).strip(), display=display)
    unknown = re.findall(r"\\[A-Za-z]+", re.sub(r"<annotation.*?</annotation>", "", made, flags=re.DOTALL))
    if unknown:
        raise ValueError(f"formula {formula!r}: latex2mathml does not know {unknown[0]}")
    made = VARIANT.sub(_letter, made)
    if left := re.search(r'mathvariant="(?!normal)([a-z-]+)"', made):
        raise ValueError(f"formula {formula!r}: no browser shows mathvariant {left[1]!r}")
    made = SIGN.sub(r'\1<mo form="prefix">&#x02212;</mo>', made)
    made = re.sub(r"<mi>(&#x000B1;)</mi>", r"<mo>\1</mo>", made)
    # Bars are fences here, never a relation: no space around them.
    return made.replace("<mo>&#x0007C;</mo>", '<mo fence="true" stretchy="false" lspace="0" rspace="0">|</mo>')


def _inline(formula: str) -> str:
    """Browsers do not break formulas: on a narrow screen the longest ones scroll within their line."""
    made = mathml(formula, "inline")
    return f'<span class="long-formula">{made}</span>' if len(re.sub(r"\\[a-z]+", "", formula)) > 25 else made


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    html = BLOCK.sub(lambda m: f'<div class="formula">{mathml(m[1], "block")}</div>', html)
    html = INLINE.sub(lambda m: _inline(m[1]), html)
    if "arithmatex" in html:
        raise ValueError(f"{page.file.src_uri}: a formula was not rendered")
    return html

"""Mathematics is TeX between dollar signs, in the repository and on the site, not characters that look like it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))

_CODE = re.compile(r"^(```|~~~).*?^\1|^(?: {4}|\t)\S.*?$|`[^`\n]*`|\]\([^)\s]*\)|<!--.*?-->", re.DOTALL | re.MULTILINE)
"""Code, and where links lead."""
_QUOTED = re.compile(r"\"[^\"\n]*\"")
_FORMULA = re.compile(r"\$\$.+?\$\$|\$[^$\n]+\$", re.DOTALL)
_RAW = re.compile(
    r"[^\W\d_]_(?:[a-z\d]\b|\{)"  # x_k, Σ_0, M_{i}
    r"|[\u0302\u0304]"  # x̂, P̄
    r"|[\u2080-\u209c\u2c7c]"  # x₀, xₖ
    r"|[^\W\d](?:[ᵀᵉˢ]|⁻¹)"  # Aᵀ, Q⁻¹
    r"|\^[\w{(½]"  # Q^½
)
_REFUSED = re.compile(r"\\(?:operatorname|mbox|phantom|arg)\b|\\[Bb]igg?[lr]?\\[lr](?:floor|ceil)")
"""The first three GitHub does not allow; the rest the site's converter leaves as it is."""


def raw(text: str) -> list[str]:
    """What is written in characters and should be a formula. Quotations are as they are printed."""
    words = _QUOTED.sub("", _FORMULA.sub("", _CODE.sub("", text))).split()
    return [word for word in words if _RAW.search(word)]


def mistakes(text: str) -> list[str]:
    """Formulas that GitHub or the site would show as text, or as another formula."""
    text = _CODE.sub("", text)
    wrong = [formula for formula in _FORMULA.findall(text) if _REFUSED.search(formula)]
    for line in re.sub(r"\$\$.+?\$\$", "", text, flags=re.DOTALL).splitlines():
        if line.count("$") % 2:
            wrong.append(line)
        for match in re.finditer(r"\$([^$]+)\$", line):
            formula, around = match[1], line[match.start() - 1 : match.start()] + line[match.end() : match.end() + 1]
            is_spaced = formula != formula.strip()
            is_escaped = re.search(r"\\[^A-Za-z ]", formula) is not None  # Markdown takes the backslash of \, and \{
            is_cut = line.startswith("|") and "|" in formula  # \lvert, \mid
            if is_spaced or is_escaped or is_cut or re.search(r"\w", around):
                wrong.append(match[0])
    return wrong


@pytest.mark.parametrize("page", PAGES)
def test_symbols_are_formulas(page: str) -> None:
    """In sentences, tables and headings too."""
    assert raw((DOCS / page).read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", PAGES)
def test_formulas_are_recognised(page: str) -> None:
    """By GitHub and by the site: a dollar sign beside a letter, or a backslash before a comma, ends or changes a formula."""
    assert mistakes((DOCS / page).read_text(encoding="utf-8")) == []


def test_all_pages_of_the_mathematics_are_looked_at() -> None:
    """So that the tests above test something."""
    assert {"mathematics/model.md", "notation.md", "papers/naha2021.md"} <= set(PAGES)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("The estimate x̂_{k−1} of x_k.", ["x̂_{k−1}", "x_k."]),
        ("With Aᵀ, Q^½, xₖ₋₁, Σ_0 and Q⁻¹.", ["Aᵀ,", "Q^½,", "xₖ₋₁,", "Σ_0", "Q⁻¹."]),
        ("A key `state_probability`, its words state_probability, $x_k$, [a page](a_page.md#x_k), and 10⁻⁹ of μ.", []),
        ('"Greater than 10³", without knowledge of "χ_k".', []),
        ("```text\nx_k\n```\n\n    A^k\n\n$$\nx_k\n$$\n", []),
    ],
)
def test_raw_symbols_are_found(text: str, expected: list[str]) -> None:
    """So that the first test tests something."""
    assert raw(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "$x_k$s",
        "a$x$",
        "$ x$",
        r"$a\,b$",
        r"$\{a\}$",
        "| $P(a|b)$ |",
        "costs $5, or $6",
        "one $ sign",
        r"$\operatorname{tr}P$",
    ],
)
def test_formulas_that_are_not_are_found(text: str) -> None:
    """So that the second test tests something."""
    assert mistakes(text)

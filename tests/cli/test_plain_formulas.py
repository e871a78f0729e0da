"""`evedrop docs` prints formulas as text that a terminal can show."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.cli.plain_formulas import formula, plain

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(
    ("tex", "text"),
    [
        (r"\mu_d", "μ_d"),
        (r"x_{k+1} = A x_k + w_k", "xₖ₊₁ = A xₖ + wₖ"),
        (r"A P_{k-1} A^\top + Q", "A Pₖ₋₁ Aᵀ + Q"),
        (r"\hat{x}_k^{\mathrm{s}}", "x̂ₖˢ"),
        (r"Q^{\tfrac{1}{2}}", "Q^(1/2)"),
        (r"\frac{p}{p+r}", "p/(p+r)"),
        (r"\sqrt{2}", "√2"),
        (r"w \sim N(0, Q), \quad \rho \ge 1", "w ~ N(0, Q),  ρ ≥ 1"),
        (r"\begin{bmatrix} 1 & 0 \\ 0 & 1 \end{bmatrix}", "[ 1 0 ; 0 1 ]"),
        (r"\unknown{x} \%", "unknownx %"),
    ],
)
def test_a_formula_becomes_text(tex: str, text: str) -> None:
    """By letters of Unicode where there are some."""
    assert " ".join(formula(tex).split()) == " ".join(text.split())


def test_code_and_prices_stay_as_they_are() -> None:
    """Only what stands between dollar signs in prose is a formula."""
    page = "`$\\mu$` costs 5 $ or 6 $.\n\n```sh\n$ echo $HOME $PATH\n```\n"
    assert plain(page) == page
    assert plain("$$\na = b\n$$\n") == "    a = b\n"


@pytest.mark.parametrize("page", sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")))
def test_no_tex_remains_on_a_page(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every command of TeX that pages use is known."""
    assert cli.main(["docs", page]) == 0
    text = capsys.readouterr().out
    prose = re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
    assert re.findall(r"\\[a-zA-Z]+|\$\$", prose) == []

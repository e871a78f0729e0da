r"""Formulas of pages as plain text: TeX between dollar signs becomes Unicode, so that a terminal shows μ_d and not $\mu_d$.

It knows the commands that the pages use; of an unknown one it prints the name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

_CODE_OR_FORMULA = re.compile(
    r"(?P<code>^```.*?^```|`[^`\n]*`)|\$\$(?P<display>.+?)\$\$|(?<![\\$\w])\$(?=\S)(?P<inline>(?:[^$\n]|\n(?!\n))+?)(?<=\S)\$(?!\w)",
    re.DOTALL | re.MULTILINE,
)
_TOKEN = re.compile(r"\\[a-zA-Z]+|\\.|\s+|.", re.DOTALL)
_SYMBOLS = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "varepsilon": "ε", "epsilon": "ϵ", "zeta": "ζ",
    "eta": "η", "theta": "θ", "iota": "ι", "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "pi": "π",
    "rho": "ρ", "varrho": "ϱ", "sigma": "σ", "tau": "τ", "phi": "φ", "varphi": "φ", "chi": "χ", "psi": "ψ",
    "omega": "ω", "Gamma": "Γ", "Delta": "Δ", "Theta": "Θ", "Lambda": "Λ", "Xi": "Ξ", "Pi": "Π", "Sigma": "Σ",
    "Phi": "Φ", "Psi": "Ψ", "Omega": "Ω", "sum": "∑", "prod": "∏", "int": "∫", "infty": "∞", "le": "≤", "ge": "≥",
    "ne": "≠", "approx": "≈", "sim": "~", "to": "→", "leftarrow": "←", "rightarrow": "→", "Rightarrow": "⇒",
    "in": "∈", "notin": "∉", "cdot": "·", "times": "×", "otimes": "⊗", "mid": "|", "lvert": "|", "rvert": "|",
    "lVert": "‖", "rVert": "‖", "lfloor": "⌊", "rfloor": "⌋", "lceil": "⌈", "rceil": "⌉", "lbrace": "{",
    "rbrace": "}", "langle": "⟨", "rangle": "⟩", "dots": "…", "cdots": "…", "ldots": "…", "ell": "ℓ", "top": "ᵀ",
    "pm": "±", "partial": "∂", "nabla": "∇", "succeq": "⪰", "preceq": "⪯", "equiv": "≡", "ll": "≪", "gg": "≫",
    "cup": "∪", "cap": "∩", "subset": "⊂", "forall": "∀", "exists": "∃", "prime": "′", "circ": "∘",
}  # fmt: skip
_MARKS = {"hat": "\u0302", "bar": "\u0304", "overline": "\u0304", "tilde": "\u0303", "dot": "\u0307"}
"""Combining characters, which stand after their letter."""
_SIGNS = {
    **_SYMBOLS,
    ",": " ",
    ";": " ",
    " ": " ",
    "!": "",
    "quad": "  ",
    "qquad": "    ",
    "\\": "\n",
    **dict.fromkeys(("left", "right", "big", "Big", "bigl", "bigr", "Bigl", "Bigr", "textstyle", "displaystyle"), ""),
}
_FRACTIONS = {"frac", "tfrac", "dfrac"}
_BRACKETS = {"bmatrix": ("[", "]"), "pmatrix": ("(", ")")}
_RAISED = dict(
    zip("0123456789+-=()abcdefghijklmnoprstuvwxyzT*ᵀ", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻⁼⁽⁾ᵃᵇᶜᵈᵉᶠᵍʰⁱʲᵏˡᵐⁿᵒᵖʳˢᵗᵘᵛʷˣʸᶻᵀ*ᵀ", strict=True)
)
_LOWERED = dict(zip("0123456789+-=()aehijklmnoprstuvx", "₀₁₂₃₄₅₆₇₈₉₊₋₌₍₎ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ", strict=True))


def plain(page: str) -> str:
    """A page in Markdown with its formulas as plain text; code stays as it is."""

    def written(match: re.Match[str]) -> str:
        if match["code"] is not None:
            return match["code"]
        if match["display"] is not None:
            return "\n".join(f"    {line.strip()}" for line in formula(match["display"]).splitlines() if line.strip())
        return formula(match["inline"])

    return _CODE_OR_FORMULA.sub(written, page)


def formula(tex: str) -> str:
    """A formula in TeX as plain text."""
    text = _Reader(tex).all()
    return re.sub(r" +\n", "\n", re.sub(r" {3,}", "   ", text)).strip()


class _Reader:
    """Reads a formula from left to right."""

    def __init__(self, tex: str) -> None:
        self._tokens = _TOKEN.findall(tex)[::-1]
        self._rows = False  # whether it is inside a matrix

    def all(self) -> str:
        """Everything up to the end, or to the brace that closes the group."""
        parts: list[str] = []
        while self._tokens and self._tokens[-1] != "}":
            parts.append(self._one())
        if self._tokens:
            self._tokens.pop()
        return "".join(parts)

    def _one(self) -> str:
        """The next symbol, group or command with its arguments."""
        read = self._tokens.pop()
        if read == "{":
            return self.all()
        if read in "^_":
            return _script(self._argument(), _RAISED if read == "^" else _LOWERED, read)
        if read == "&":
            return " "
        if not read.startswith("\\"):
            return " " if read.isspace() else read
        return self._command(read[1:])

    def _command(self, name: str) -> str:
        if name in _MARKS:
            body = self._argument()
            return body[:1] + _MARKS[name] + body[1:]
        if name in _FRACTIONS:
            return f"{_grouped(self._argument())}/{_grouped(self._argument())}"
        if name in {"begin", "end"}:
            kind = self._argument()
            self._rows = name == "begin" and kind in _BRACKETS
            return _BRACKETS.get(kind, ("", ""))[name == "end"]
        if name in _ARGUMENT:
            return _ARGUMENT[name](self._argument())
        return "; " if name == "\\" and self._rows else _SIGNS.get(name, name)

    def _argument(self) -> str:
        while self._tokens and self._tokens[-1].isspace():
            self._tokens.pop()
        return self._one() if self._tokens else ""


def _script(body: str, letters: dict[str, str], sign: str) -> str:
    """A subscript or superscript: in small letters if Unicode has all of them, otherwise after the sign."""
    body = body.replace(" ", "") if all(letter in letters or letter == " " for letter in body) else body
    if body and all(letter in letters for letter in body):
        return "".join(letters[letter] for letter in body)
    return f"{sign}{body if len(body) == 1 or body.isalnum() else f'({body})'}"


def _grouped(body: str) -> str:
    return body if len(body) == 1 or body.isalnum() else f"({body})"


_ARGUMENT: Mapping[str, Callable[[str], str]] = {
    "sqrt": lambda body: f"√{_grouped(body)}",
    **dict.fromkeys(("text", "mathrm", "mathsf", "mathbf", "mathcal", "mathbb", "operatorname"), str),
}
"""What becomes of a command's argument."""

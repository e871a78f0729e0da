"""Numbers as text that know their value: a table on the terminal shows the text, a file of the table has the value."""

from __future__ import annotations

from typing import Self, final


@final
class ShownNumber(str):
    """The text of a number, such as `0.0123 ± 0.0004 Wh`; its value and standard error go where a text is formatted again."""

    value: float | None
    """At full precision; None: there is no number, and the text is a dash."""
    error: float | None
    """The standard error; None: there is none."""
    after: str
    """What follows the number, such as its unit."""

    def __new__(cls, text: str, value: float | None, error: float | None = None, after: str = "") -> Self:
        """text: what is shown."""
        found = super().__new__(cls, text)
        found.value, found.error, found.after = value, error, after
        return found

    def __add__(self, after: str) -> ShownNumber:
        """The same number with a unit or a mark after it."""
        return ShownNumber(f"{self}{after}", self.value, self.error, self.after + after)

    def __getnewargs__(self) -> tuple[str, float | None, float | None, str]:  # type: ignore[override]  # that of a plain text
        """What a copy is made from."""
        return str(self), self.value, self.error, self.after

"""The letters that the viewer's font has: others would end a headless viewer, which then draws no picture. Does not use Rerun."""

from __future__ import annotations

_RANGES = ((0x20, 0x7E), (0xA1, 0x148), (0x14A, 0x2AF), (0x386, 0x3CE), (0x400, 0x45F))  # Latin, Greek, Cyrillic
_SINGLE = frozenset("−≤≥≈₀ₖ→←∞∑·…–—„“”‘’‰€‖∂\u0302")
_UNASSIGNED = frozenset("\u0387\u038b\u038d\u03a2")


def drawable(text: str) -> str:
    """The text with a question mark for each letter that the viewer's font may lack."""
    return "".join(character if _known(character) else "?" for character in text)


def _known(letter: str) -> bool:
    inside = any(first <= ord(letter) <= last for first, last in _RANGES)
    return letter in _SINGLE or (inside and letter not in _UNASSIGNED)

"""Types of the fields of messages and files, with the bounds that msgspec holds them to."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

Slot = Annotated[int, Meta(ge=0, le=2**62)]
"""A slot, or a count: slots can be added to it without leaving 64 bits."""
Finite = Annotated[float, Meta(ge=-1e308, le=1e308)]
"""A finite number: NaN is in no range."""
NotNegative = Annotated[float, Meta(ge=0.0, le=1e308)]
"""The same, 0 or more."""
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]

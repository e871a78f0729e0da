"""The kernels in use: those in C where they were built, and otherwise those in numpy. `choice.py` decides.

Both modules have the same functions with the same signatures, which a test compares.
"""

from __future__ import annotations

from evedrop.model.kernels import reference as kernels
from evedrop.model.kernels.choice import COMPILED

if COMPILED:
    from evedrop.model.kernels import compiled as kernels  # type: ignore[no-redef]

__all__ = ["kernels"]

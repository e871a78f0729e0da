"""Whether the C kernels are used, or numpy in their place; and why.

`EVEDROP_KERNELS=numpy` forces numpy; `baseline`, `avx2` and `avx512` ask for the C kernels with at most this instruction set.
"""

from __future__ import annotations

import importlib
import os

from evedrop.errors import UsageError
from evedrop.names import KERNELS_VARIABLE

EXTENSION = "evedrop.model.kernels._compiled"
"""The module that `binding.py` builds."""
_NUMPY = "numpy"
_SETS = ("baseline", "avx2", "avx512")


FALLBACK = "numpy, because the C kernels are not built"
"""The value of `KERNELS` where there are none."""


def _chosen() -> tuple[bool, str]:
    """Whether the C kernels are used, and the kernels in use, in words."""
    wanted = os.environ.get(KERNELS_VARIABLE, "")
    if wanted not in {"", _NUMPY, *_SETS}:
        raise UsageError(
            f"{KERNELS_VARIABLE} is {wanted!r}; expected one of {', '.join((_NUMPY, *_SETS))}, or leave it out"
        )
    if wanted == _NUMPY:
        return False, f"numpy, as {KERNELS_VARIABLE} says"
    try:
        library = importlib.import_module(EXTENSION).lib
    except ImportError as error:
        if wanted:
            raise UsageError(f"{KERNELS_VARIABLE} is {wanted}, but the C kernels cannot be loaded: {error}") from error
        return False, FALLBACK
    best = library.kernels_best()
    used = min(best, _SETS.index(wanted)) if wanted else best
    library.kernels_use(used)
    return True, f"C ({_SETS[used]})"


COMPILED, KERNELS = _chosen()
"""Whether the C kernels are used; and the kernels in use, in words."""


def fallback_warning() -> str | None:
    """A line for the user if the C kernels are missing; None if they are in use, or numpy was asked for."""
    if KERNELS != FALLBACK:
        return None
    return f"the kernels are {FALLBACK}: the same results take several times as long (docs/performance.md)"

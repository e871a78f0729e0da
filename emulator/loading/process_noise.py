"""The process noise of a results folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evedrop.errors import UsageError
from evedrop.loading.file import load


def process_noise(folder: Path) -> float:
    """The trace of Q of the scenario in a results folder; 0 if it cannot be read."""
    try:
        return float(np.trace(load(folder, beyond_horizon=True).process.process.Q))
    except UsageError:
        return 0.0

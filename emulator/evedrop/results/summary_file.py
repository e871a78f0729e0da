"""summary.json, the last file of a results folder to be written.

Source: docs/results.md, summary.json.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from evedrop.results.crash_proof_tables import forget
from evedrop.results.folder import replace_private
from evedrop.score.summary import Summary
from evedrop.system.world import world


def write_summary(folder: Path, summary: Summary) -> None:
    """Write summary.json, which completes a results folder; infinite and undefined numbers as strings, which JSON lacks."""
    path = folder / "summary.json"
    replace_private(path, summary_text(summary))
    with suppress(OSError):  # who cannot sync its new name has written it all the same
        world().disk.sync(path)  # or else a power cut could leave a complete run that seems cut short
    forget(folder)


def summary_text(summary: Summary) -> str:
    """The text of a summary's file."""
    return msgspec.json.format(json.dumps(plain(summary.as_dict()), ensure_ascii=False), indent=1) + "\n"


def plain(value: Any) -> Any:
    """The same value with infinite and undefined numbers as strings, because JSON lacks them."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value


def unwritten(error: OSError) -> str:
    """The message, also in summaries, about results that could not be written."""
    if isinstance(error, FileNotFoundError):
        return (
            f"the results cannot be written ({error}); leave the folder where it is while a run goes on, and run again"
        )
    if error.errno == errno.EIO:
        return (
            f"the results cannot be written ({error}); look at the disk, and run again on another one; whether the results so "
            "far can be read depends on the disk"
        )
    return (
        f"the results cannot be written ({error}); free some room or look at the folder's rights, and run again; the results "
        "so far can be read"
    )

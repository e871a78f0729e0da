"""The disturbances of a plant, from a CSV file: a line with their names, then a line of numbers for every slot.

A name may have its unit beside it, as in `P_solar [kW]`; columns that are not asked for are left out.

Source: docs/scenario.md, plant.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from emulator.errors import TraceError


def found_file(name: str, folder: Path) -> Path:
    """Where a file that a scenario in this folder names is: in the folder, or else among those that are shipped."""
    beside = folder / name
    shipped = Path(str(resources.files("scenarios"))) / name
    return shipped if not beside.exists() and shipped.is_file() else beside


def read_disturbances(path: Path, names: Sequence[str]) -> list[list[float]]:
    """A row for each slot with the numbers of these names, in their order. Raises TraceError for what cannot be read."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [line for line in csv.reader(file) if line and not line[0].lstrip().startswith("#")]
    except OSError as error:
        raise TraceError(str(path), "file", f"cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise TraceError(str(path), "file", f"is no CSV in UTF-8 ({error})") from error
    if not lines:
        raise TraceError(str(path), "file", "is empty; expected a line of names, then a line for every slot")
    head = [name.partition("[")[0].strip() for name in lines[0]]
    missing = [name for name in names if name not in head]
    if missing:
        raise TraceError(
            str(path), "file", f"has the columns {', '.join(head)}; expected {', '.join(missing)} among them"
        )
    columns = [head.index(name) for name in names]
    rows = []
    for number, line in enumerate(lines[1:], 2):
        try:
            row = [float(line[column]) for column in columns]
        except (ValueError, IndexError) as error:
            raise TraceError(
                str(path), "file", f"row {number} is {','.join(line)!r:.60}; expected a number in each column"
            ) from error
        if not all(map(math.isfinite, row)):
            raise TraceError(str(path), "file", f"row {number} is {','.join(line)!r:.60}; expected finite numbers")
        rows.append(row)
    return rows


def disturbances_text(names: Sequence[str], rows: Sequence[Sequence[float]]) -> str:
    """A file that is read back to the same bits."""
    return "".join(f"{','.join(line)}\n" for line in [list(names), *([repr(value) for value in row] for row in rows)])

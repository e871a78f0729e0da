"""A recording read back."""

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from emulator.view import paths


def rows(rrd: Path, entity: str, component: str) -> dict[int, Any]:
    """The component's values of one entity, by slot."""
    found: dict[int, Any] = {}
    for chunk in RrdReader(rrd).stream().filter(content=f"/{entity}", is_static=False):
        columns = chunk.to_record_batch().to_pydict()
        found |= dict(zip(columns[paths.TIMELINE], columns[component], strict=True))
    return found

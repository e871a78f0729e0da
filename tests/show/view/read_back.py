"""A recording read back."""

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from evedrop.show.view.column import TIMELINE


def rows(rrd: Path, entity: str, component: str) -> dict[int, Any]:
    """The component's values of one entity, by slot."""
    rows: dict[int, Any] = {}
    for chunk in RrdReader(rrd).stream().filter(content=f"/{entity}", is_static=False):
        columns = chunk.to_record_batch().to_pydict()
        rows |= dict(zip(columns[TIMELINE], columns[component], strict=True))
    return rows


def lane(rrd: Path, entity: str, slots: int) -> list[str]:
    """A lane's word in every slot, from its changes."""
    changes = rows(rrd, entity, "StateChange:state")
    words: list[str] = []
    for k in range(slots):
        words.append(changes[k][0] if k in changes else words[-1])
    return words


def events(rrd: Path) -> dict[int, list[str]]:
    """The lines of the events panel at every slot that changes them; the newest first."""
    documents = rows(rrd, "events", "TextDocument:text")
    return {k: text.splitlines() for k, (text,) in documents.items()}


def new_events(rrd: Path) -> dict[int, list[str]]:
    """The events of every slot that has any, without their number of the slot."""
    return {
        k: [line.split(maxsplit=1)[1] for line in lines if line.startswith(f"#{k} ")]
        for k, lines in events(rrd).items()
    }

"""The operator's access to a run in progress: `control.json` in the run's results folder, mode 0600.

The file is written when the run starts and removed when it ends, for whatever reason.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import msgspec

from evedrop.errors import UsageError
from evedrop.live.protocol.brief import Identity
from evedrop.live.protocol.json_tables import read
from evedrop.system.files import Unreadable, is_folder, is_there, text_of
from evedrop.system.world import world

_NAME = "control.json"
_UNFINISHED = f"{_NAME}.new"
_MOST_BYTES = 2**20


@dataclass(frozen=True)
class Control:
    """The address of a run's router, and the operator's credentials, made for this run alone."""

    run: str
    router: str
    """Zenoh endpoint."""
    user: str
    password: str = field(repr=False)
    identity: Identity | None = None
    """The operator's certificate and key, if the run's router takes certificates."""
    process: int | None = None
    """The id of the process, if it is a wire."""

    def write(self, folder: Path) -> None:
        """Write the file into a results folder, readable by its owner only."""
        unfinished = folder / _UNFINISHED
        world().disk.write(unfinished, json.dumps(asdict(self), indent=1).encode())
        world().disk.replace(unfinished, folder / _NAME)


def remove_control(folder: Path) -> None:
    """Remove the control file of a run that is over, also one whose writer was killed or had no room."""
    with suppress(OSError):  # the disk may not be writable any more; the password is useless after the run
        world().disk.remove(folder / _NAME)
    with suppress(OSError):
        if (folder / _UNFINISHED).exists():
            world().disk.remove(folder / _UNFINISHED)


def no_run(folder: Path, why: str) -> UsageError:
    """The error for steering a run that is not in progress; why: how that was found out."""
    return UsageError(
        f"no run is going on in {folder}; {why}; give the results folder of a run or wire between its start and its end"
    )


def read_controls(folder: Path) -> list[Control]:
    """Read the control file of a run in progress, or those of its shards. Raises UsageError as `read_control` does."""
    controls = []
    for path in sorted(folder.glob(f"shards/*/{_NAME}")):
        try:
            controls.append(read_control(path.parent))
        except UsageError:
            if is_there(path):  # the shard is not over
                raise
    return controls or [read_control(folder)]


def shards_in(folder: Path) -> int:
    """The number of shards of a run in progress, whether or not they have begun, or are over."""
    return sum(path.is_dir() for path in folder.glob("shards/*"))


def read_control(folder: Path) -> Control:
    """Read the control file of a run in progress. Raises UsageError if there is none, or it is malformed."""
    path = folder / _NAME
    try:
        return read(Control, msgspec.json.decode(text_of(path, _MOST_BYTES)))
    except Unreadable as error:
        if is_there(path):
            raise no_run(folder, f"{path.name} cannot be read ({error})") from error
        over = is_there(folder / "summary.json")
        why = "it is over" if over else f"it has no {_NAME} (yet)" if is_folder(folder) else "there is no such folder"
        raise no_run(folder, why) from error
    except (ValueError, RecursionError) as error:
        raise no_run(folder, f"{path.name} is not a control file ({error})") from error

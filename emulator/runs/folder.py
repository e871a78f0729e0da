"""The folder that results go into."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Iterator
from pathlib import Path

from emulator.errors import UsageError
from emulator.files import shown


def default_folder(scenario: str | Path) -> Path:
    """`runs/<scenario>-<time>`, in the current folder: what a results folder is called if nobody says."""
    stem = Path(scenario).stem if Path(scenario).suffix else Path(scenario).name
    return Path("runs") / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"


def claimed(wanted: Path) -> Path:
    """Make a new folder of that name, or of that name and a number: nobody else makes the same one. Raises UsageError."""
    for number in itertools.count(1):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(mode=0o700)
        except FileExistsError as error:
            if not folder.parent.is_dir():
                raise _unusable(folder, "a part of it is a file") from error
            continue
        except OSError as error:
            raise _unusable(folder, str(error.strerror)) from error
        return folder
    raise AssertionError  # there is always another number


@contextlib.contextmanager
def results_folder(out: str | Path | None, scenario: str | Path) -> Iterator[Path]:
    """The folder for results: `out`, else a new one of the scenario's name, which is removed if it is still empty."""
    if out is not None:
        yield Path(out)
        return
    folder = claimed(default_folder(scenario))
    try:
        yield folder
    finally:
        with contextlib.suppress(OSError):
            folder.rmdir()  # only an empty one can be removed


def _unusable(folder: Path, why: str) -> UsageError:
    return UsageError(f"{shown(folder)} cannot be made ({why}); give another folder for the results")


def new_folder(folder: Path) -> Path:
    """Create a results folder. Raises UsageError if it has something in it or cannot be written."""
    if shown(folder) != str(folder):
        raise UsageError(f"--out {shown(folder)} is not a name in UTF-8, which results and messages are; give another")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UsageError(f"{folder} is not empty; give another --out, or empty it")
    except NotADirectoryError as error:
        raise UsageError(f"{folder}: a part of it is a file; give another --out") from error
    except FileExistsError as error:
        raise UsageError(f"{folder} is a file; give another --out") from error
    except OSError as error:
        raise UsageError(f"{folder} cannot be written ({error.strerror}); give another --out") from error
    return folder

"""The folder that results go into."""

from __future__ import annotations

from pathlib import Path

from emulator.errors import UsageError


def new_folder(folder: Path) -> Path:
    """Create a results folder. Raises UsageError if it has something in it or cannot be written."""
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

"""The built-in scenarios, found by name. Commands that only list or copy them import nothing else."""

from __future__ import annotations

from pathlib import Path

from evedrop.errors import UsageError
from evedrop.system.hints import near

_FOLDER = Path(__file__).parent


def shipped() -> dict[str, Path]:
    """The scenarios inside the package: name → file."""
    return {path.stem: path for path in sorted(_FOLDER.glob("[a-z]*.toml"), key=lambda path: path.stem)}


def built_in_text(name: str) -> str:
    """The text of a built-in scenario. Raises UsageError if no built-in scenario has this name."""
    if name not in shipped():
        raise UsageError(
            f"there is no built-in scenario {name}{near(name, shipped()) or '; evedrop list prints the names'}"
        )
    return shipped()[name].read_text(encoding="utf-8")


def write_new(path: Path, origin: str | None = None) -> None:
    """Write a scenario to start from: the commented one, or a copy of the built-in scenario `origin`.

    Raises UsageError if the file exists or cannot be written, or there is no such scenario.
    """
    text = (_FOLDER / "_new.toml").read_text(encoding="utf-8") if origin is None else built_in_text(origin)
    try:
        with path.open("x", encoding="utf-8") as file:
            try:
                file.write(text)
                file.flush()
            except BaseException:
                path.unlink(missing_ok=True)
                raise
    except FileExistsError as error:
        raise UsageError(f"{path} exists already; give another name") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another place") from error

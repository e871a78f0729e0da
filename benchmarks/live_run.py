"""Starts live runs by the command that users type, and returns their summaries."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tomli_w

from evedrop.scenarios import shipped

_COMMAND = (sys.executable, "-m", "evedrop", "run")
_MEASURED = (0, 1)  # 1: the scenario did not meet an expectation of its own, but its performance metrics are right


@contextmanager
def started(scenario: str | Path, *options: str) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    """A run in progress, and its results folder; without a view unless the options say otherwise.

    Raises RuntimeError if it has failed when the block is left, which waits for its end.
    """
    view = () if "--view" in options else ("--view", "off")
    with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "errors", "w+b") as errors:
        out = Path(folder) / "run"
        command = [*_COMMAND, str(scenario), "--json", "--out", str(out), *view, *options]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        try:
            yield process, out
            process.wait()
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        if process.returncode not in _MEASURED:
            errors.seek(0)
            complaint = errors.read().decode(errors="replace").strip()
            raise RuntimeError(f"{' '.join(command[1:])} ended with status {process.returncode}: {complaint}")


def measured(
    scenario: str | Path, *options: str, watch: Callable[[subprocess.Popen[bytes], Path], None] | None = None
) -> dict[str, Any]:
    """The summary of one run; watch: is called with its process and its results folder while it is running."""
    with started(scenario, *options) as (process, out):
        if watch is not None:
            watch(process, out)
        process.wait()
        summary = out / "summary.json"
        values: dict[str, Any] = json.loads(summary.read_text(encoding="utf-8")) if summary.exists() else {}
    return values


def rate(scenario: str | Path, *options: str) -> float:
    """Slots a second, from the start of the first slot to the last row on disk."""
    return float(measured(scenario, *options)["slots_per_second"])


def scenario_file(folder: str | Path, changes: Mapping[str, Any]) -> Path:
    """The shipped scenario `eavesdroppers` with other top-level entries and without expectations, as a file."""
    tables = tomllib.loads(shipped()["eavesdroppers"].read_text(encoding="utf-8")) | dict(changes)
    tables.pop("expect", None)
    file = Path(folder) / "scenario.toml"
    file.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return file


def slots_on_disk(out: Path) -> int:
    """How many slots of a run are in its results so far. Source: docs/results.md, while a run goes on."""
    try:
        lines = (out / "unfinished" / "rounds").read_bytes().split(b"\n")[:-1]
    except FileNotFoundError:
        return 0
    return int(json.loads(lines[-1])["slots"]) if lines else 0

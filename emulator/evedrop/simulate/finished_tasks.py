"""Keeps the results of a study's finished tasks in its folder, so that an interrupted study can go on where it stopped.

The folder `finished_tasks` in a results folder has `study.json`, which says exactly what is studied, and a file for each task.
A file counts only if it is complete, undamaged, and of this study. All of it is data (`evedrop.results.shard_score`).

Source: docs/results.md, an interrupted study.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from hashlib import sha256
from pathlib import Path
from typing import Any, final

import pyarrow as pa

from evedrop.errors import EvedropError, Interrupted, RunError, UsageError
from evedrop.results.crash_proof_tables import goes_on
from evedrop.results.folder import (
    STATES,
    UNFINISHED,
    HeldFolder,
    disk_errors,
    make_private,
    new_folder,
    private_replacement,
    write_private,
)
from evedrop.results.resolved_scenario import DISTURBANCES, made_with
from evedrop.results.shard_score import NotData, packed, unpacked
from evedrop.scenario.tables import Scenario
from evedrop.simulate.tasks import R, Task
from evedrop.system.files import try_lock
from evedrop.system.output import say

TASKS = "finished_tasks"
"""The folder in a results folder."""
STUDY = "study.json"
"""The file in it that says what is studied."""
_SECONDS = "seconds.json"
_MAGIC = b"evedrop finished task 2\n"
_NAME = re.compile(r"([0-9a-f]{32})-([0-9]+)-([0-9]+)")
_MOST_BYTES = 2**33
"""The most bytes of a task's result, uncompressed."""
_REWRITTEN = ("*.parquet", "summary.json", "report.html", "compare.json", "sweep.json")
"""Files of an interrupted study that the resumed one writes again."""
_OF_TRIALS = ("scenario", "start", "stop")
_MOST_NAMED = 3  # differences between two studies in one message

Study = Mapping[str, Any]
"""What is studied, as JSON: equal for two studies exactly if all their results are equal."""


def study_of(kind: str, options: Mapping[str, Any], scenarios: Sequence[Scenario]) -> Study:
    """What a study computes; kind: the command; options: those that change results, beside the scenarios, at least one."""
    secrets = dict.fromkeys(scenario.secret_file for scenario in scenarios if scenario.secret_file is not None)
    tables = [scenario.model_dump(mode="json", exclude_none=True) for scenario in scenarios]
    every = sha256()
    made: dict[str, Any] = {}
    for table in tables:
        every.update(_json(table))
        made |= made_with(table)
    study = {
        "study": kind,
        **options,
        "scenario": tables[0],
        "scenarios": every.hexdigest(),
        "secrets": [sha256(Path(scenario).read_bytes()).hexdigest() for scenario in secrets],
        "made_with": made,
    }
    plain: Study = json.loads(json.dumps(study, default=str))
    return plain


def _json(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, default=str).encode()


@contextlib.contextmanager
def finished_tasks(folder: Path, study: Study, resume: bool) -> Iterator[FinishedTasks]:
    """Where the finished tasks of a study are kept, in its results folder, which is created.

    resume: go on with the study in the folder; a new or empty folder is that of a study that has not begun. If the block fails
    and tasks are kept, the error says which folder can be resumed.

    Raises UsageError if the folder cannot be used, has another study, has nothing to resume, or another process works in it.
    """
    began = resume and folder.is_dir() and any(folder.iterdir())
    had_folder = folder.exists()
    if began:
        _check(folder, study)
    else:
        new_folder(folder)
        with disk_errors(folder):
            make_private(folder / TASKS)
            write_private(folder / TASKS / STUDY, json.dumps(study, ensure_ascii=False, indent=1) + "\n")
    tasks = FinishedTasks(folder / TASKS, study, resumed=began, had_folder=had_folder)
    try:
        if began:
            _clear(folder)
        yield tasks
    except EvedropError as error:
        if tasks.count:
            with contextlib.suppress(OSError):  # the folder was removed meanwhile
                error.resumable = str(tasks.results_folder)
        raise
    finally:
        tasks.close()


def _check(folder: Path, study: Study) -> None:
    """Raise UsageError unless a folder has this study, and no process works in it."""
    try:
        there = json.loads((folder / TASKS / STUDY).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(
            f"{folder} has no interrupted study: there is no {TASKS}/{STUDY} in it, so its study is complete, or is not one "
            "of a version that keeps finished trials; give another folder"
        ) from None
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder / TASKS / STUDY} cannot be read ({error}); give another folder") from error
    if there != study:
        raise UsageError(
            f"{folder} has another study: {'; '.join(_differences(there, study))}; give the same scenario and options, or "
            "another folder"
        )
    if goes_on(folder):
        raise UsageError(f"{folder} belongs to a run in progress; wait for its end, or give another folder")


def _differences(schema: Any, ours: Any, path: str = "") -> list[str]:
    """The first entries in which two studies differ."""
    if not (isinstance(schema, dict) and isinstance(ours, dict)):
        return [f"{path.removeprefix('scenario.') or 'it'} is {_short(schema)} there and {_short(ours)} here"]
    lines: list[str] = []
    for name in dict.fromkeys([*ours, *schema]):
        if name == "scenarios" and (lines or not path):  # a hash says less than an entry does
            continue
        if schema.get(name) != ours.get(name):
            lines += _differences(schema.get(name), ours.get(name), f"{path}.{name}" if path else name)
    return lines[:_MOST_NAMED] or ["a scenario differs"]


def _short(value: object) -> str:
    if value is None:
        return "missing"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else f"{text[:39]}…"


def _clear(folder: Path) -> None:
    """Remove the results so far of an interrupted study: all of them are written again."""
    shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    for pattern in _REWRITTEN:
        for path in folder.glob(pattern):
            path.unlink()


@final
class FinishedTasks:
    """The finished tasks of one study. Holds a lock on their folder."""

    def __init__(self, place: Path, study: Study, *, resumed: bool, had_folder: bool) -> None:
        """place: the folder; had_folder: whether the results folder was there before. Raises UsageError if it is locked."""
        self._resumed, self._had_folder = resumed, had_folder
        self._held = HeldFolder(place)
        self._study = sha256(_json(study)).digest()
        self._digests: dict[tuple[Any, ...], tuple[object, str]] = {}
        self._examples: dict[str, Any] = {}
        self._began, self._before = time.monotonic(), _seconds(place)
        self._lock = os.open(place, os.O_RDONLY)
        if not try_lock(self._lock):
            self.close()
            raise UsageError(f"{place.parent} belongs to a study in progress; wait for its end")
        self._files = {path.name for path in place.iterdir() if _NAME.fullmatch(path.name)}

    @property
    def seconds(self) -> float:
        """How long the study has been worked on, before it was interrupted and since."""
        return self._before + time.monotonic() - self._began

    @property
    def count(self) -> int:
        """How many tasks are kept."""
        return len(self._files)

    @property
    def results_folder(self) -> Path:
        """The results folder that the tasks are in."""
        return self._held.now.parent

    def ranges(self, task: Task[Any]) -> list[range]:
        """The trials of the kept tasks that differ from this one in their trials only, in order."""
        ranges = []
        for name in self._files:
            match = _NAME.fullmatch(name)
            if match is not None and match[1] == self._digest(task):
                ranges.append(range(int(match[2]), int(match[3])))
        return sorted(ranges, key=lambda trials: trials.start)

    def has(self, task: Task[Any]) -> bool:
        """Whether a task is kept; one whose file is damaged is forgotten, which is said on standard error."""
        name = self._name(task)
        if name not in self._files:
            return False
        if self._content(name) is not None:
            return True
        self._files.discard(name)
        say(f"{self._held.now / name} is damaged; its trials are computed again")
        return False

    def load(self, task: Task[R]) -> R:
        """The result of a task that is kept. Raises RunError if it cannot be read."""
        name = self._name(task)
        digest = self._digest(task)
        if digest not in self._examples:
            self._examples[digest] = task.example()
        content = self._content(name)
        try:
            if content is None:
                raise NotData("it is damaged")
            result: R = unpacked(_inflated(content), self._examples[digest])
        except (NotData, pa.ArrowException, OSError) as error:
            raise RunError(
                f"{self._held.now / name} cannot be used ({error}); remove this file and resume again"
            ) from error
        return result

    def keep(self, task: Task[R], result: R) -> None:
        """Write a task's result; the file is complete at any moment. A result that is not data is left out. Raises OSError."""
        name = self._name(task)
        try:
            body = packed(result)
        except NotData:  # a class of the user's own holds what only its process has: the task is computed again
            return
        content = len(body).to_bytes(8, "little") + pa.Codec("zstd", 1).compress(body, asbytes=True)
        self._write(name, _MAGIC + self._check(name, content) + content)
        self._files.add(name)
        self._write(_SECONDS, json.dumps(self.seconds).encode())

    def forget(self) -> None:
        """Remove all that is kept: the study is complete."""
        shutil.rmtree(self._held.now, ignore_errors=True)
        self._files = set()

    def remove_unless_any(self) -> None:
        """Unless a task is kept, leave the results folder as the study found it, but for the results of a resumed one."""
        if self._files:
            return
        with contextlib.suppress(OSError):
            folder = self.results_folder
            _clear(folder)
            if self._resumed:
                return
            for name in (DISTURBANCES, STATES, "scenario.toml"):
                (folder / name).unlink(missing_ok=True)
            shutil.rmtree(self._held.now)
            if not self._had_folder:
                folder.rmdir()

    def interrupted(self, before: str) -> Interrupted:
        """The end of a study that has no results yet; before: what would have been the first."""
        if not self._files:
            return Interrupted(f"interrupted before {before}; nothing was kept")
        return Interrupted(f"interrupted before {before}; finished trials are kept in {self.results_folder}")

    def close(self) -> None:
        """Release the lock; the files stay."""
        for close in (self._held.close, lambda: os.close(self._lock)):
            with contextlib.suppress(OSError):
                close()

    def _write(self, name: str, data: bytes) -> None:
        with private_replacement(self._held.now / name) as unfinished:
            unfinished.write_bytes(data)

    def _content(self, name: str) -> bytes | None:
        """What a file has behind its check; None if it is damaged, or of another study."""
        try:
            data = (self._held.now / name).read_bytes()
        except OSError:
            return None
        head, content = data[: len(_MAGIC) + 32], data[len(_MAGIC) + 32 :]
        return content if head == _MAGIC + self._check(name, content) else None

    def _check(self, name: str, content: bytes) -> bytes:
        return sha256(self._study + name.encode() + content).digest()

    def _name(self, task: Task[Any]) -> str:
        return f"{self._digest(task)}-{task.start}-{task.stop}"

    def _digest(self, task: Task[Any]) -> str:
        """What a task computes, but for its trials."""
        options = {option.name: getattr(task, option.name) for option in fields(task) if option.name not in _OF_TRIALS}
        key = (
            id(task.scenario),
            type(task),
            *options.values(),
        )  # the tasks of a scenario share its table, which may be large
        if key not in self._digests:
            content = [type(task).__qualname__, options, task.scenario]
            self._digests[key] = task.scenario, sha256(_json(content)).hexdigest()[:32]
        return self._digests[key][1]


def _seconds(place: Path) -> float:
    """How long a study had been worked on when its last task was kept; 0 if that is not known."""
    try:
        seconds = json.loads((place / _SECONDS).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 0.0
    return seconds if isinstance(seconds, float) and 0.0 <= seconds < math.inf else 0.0


def _inflated(content: bytes) -> bytes:
    size = int.from_bytes(content[:8], "little")
    if size > _MOST_BYTES:
        raise NotData(f"it has {size} bytes")
    inflated: bytes = pa.Codec("zstd").decompress(content[8:], size, asbytes=True)
    return inflated

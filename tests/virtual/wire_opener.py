"""A program that opens a simulated wire from Python, as `evedrop.wire` does, steers it, and reads its journal meanwhile.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evedrop.errors import EvedropError, UsageError
from evedrop.system.output import say
from evedrop.system.world import world
from evedrop.virtual.processes import ChildProcess, VirtualMachine
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.plan import WirePlan
from evedrop.wire.running import ExpectationFailed, RunningWire, described_wire
from tests.virtual.wire_programs import Course

_LONGER = 5.0
"""Seconds for which the wire may go on by itself, compared with its opener."""


def open_from_python(
    file: Path, folder: Path, seconds: float, wire: str, machine: VirtualMachine, course: Course
) -> int:
    """Open the wire for some seconds, and use it; wire: the name of its process."""

    def start(*words: str) -> ChildProcess:
        child = ChildProcess(machine, wire, *words)
        course.processes.append(child.process)
        return child

    plan, _ = described_wire(file, folder, {})
    _describe_again(plan, file, folder, course)
    running = RunningWire(plan, folder, seconds + _LONGER, start)
    try:
        with running:
            _use(running, plan, seconds, course)
    except ExpectationFailed as error:
        say(str(error))
    except EvedropError as error:
        course.doubts.append(str(error))
        return error.exit_status
    finally:
        for process in course.processes[-1:]:
            process.printed = "".join(running._errors)
    if not (folder / JOURNAL_FOLDER).is_dir():  # somebody has moved it away meanwhile
        return 0
    heard = running.summary()["heard"]
    rows = running.rows().num_rows
    if heard > rows or (folder / "summary.json").exists() != (running.typed_summary().state == "ended"):
        course.doubts.append(f"the summary heard {heard} messages, and the journal has {rows}")
    return 0


def _describe_again(plan: WirePlan, file: Path, folder: Path, course: Course) -> None:
    """The same wire is described by its plan, and by its tables; entries beside a plan are refused."""
    tables = tomllib.loads(file.read_text("utf-8"))
    names = [*tables["side"]]
    for source, entries in ((plan, {}), (None, {**tables}), (None, {**tables, "side": names})):
        same, _ = described_wire(source, folder, entries)
        if [*same.sides] != names or same.links != plan.links:
            course.doubts.append(f"{same} is another wire")
    _refused(lambda: described_wire(plan, folder, {"seed": 1}), "expected no entries", course)


def _use(running: RunningWire, plan: WirePlan, seconds: float, course: Course) -> None:
    """Do one thing after the other."""
    first, second, *_ = plan.sides
    link = plan.links[0].name
    steps: list[Callable[[], Any]] = [
        lambda: running.partition(first, second),
        running.status,
        lambda: _perhaps(lambda: running.heal(first, second)),
        lambda: _refused(lambda: running.heal(first, "moon"), "moon", course),
        running.summary,
        lambda: running.cut(link),
        lambda: _refused(lambda: running.link(link, qualty=0.5), "qualty", course),
        running.rows,
        lambda: _perhaps(lambda: running.heal(link)),
        lambda: _refused(lambda: running.endpoint("moon"), "a side that listens", course),
        lambda: running.expect(f"{link}.heard", above=0.0),
        lambda: _refused(lambda: running.expect(f"{link}.heard", above=1e9), "FAILED", course),
    ]
    for name, side in plan.sides.items():
        if side.listen and running.endpoint(name) not in side.listen:
            course.doubts.append(f"side {name} is at {running.endpoint(name)}")
        if side.listen:
            running.config(name)
            _refused(lambda name=name: running.config(name, "nobody"), "has no user", course)  # type: ignore[misc]
    _refused(running.__enter__, "runs already", course)
    for step in steps:
        world().sleep(seconds / len(steps))
        if not running.is_running:
            return
        step()


def _perhaps(work: Callable[[], object]) -> None:
    """Do what an operator may have done meanwhile, so that it is refused."""
    try:
        work()
    except UsageError as error:
        if "nothing was changed" not in str(error):
            raise


def _refused(work: Callable[[], object], why: str, course: Course) -> None:
    """Do what must be refused."""
    try:
        work()
    except (UsageError, ExpectationFailed) as error:
        if why not in str(error):
            course.doubts.append(f"{error} does not say {why!r}")
    else:
        course.doubts.append(f"nothing says {why!r}")

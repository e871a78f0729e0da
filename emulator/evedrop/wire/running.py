"""A wire in a process of its own, for programs and tests in Python.

Source: docs/wire/python.md, from Python.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Protocol, Self

import zenoh

from evedrop.errors import EvedropError, RunError, UsageError
from evedrop.live.network.control_file import Control, no_run, read_control
from evedrop.live.network.operator import Answer, ask
from evedrop.live.protocol.requests import LinkRequest, OperatorRequest, StatusRequest, WireStatus
from evedrop.results.folder import claimed, default_folder, write_private
from evedrop.results.wire_summary import WireSummary
from evedrop.scenario.loading import plain_tables
from evedrop.scenario.words import listed
from evedrop.show.report.wire import expectation_failures, wire_faults
from evedrop.system.killable import KillableProcess
from evedrop.system.native_log import MARK
from evedrop.system.output import is_warning
from evedrop.system.processes import kill, wait_for
from evedrop.system.threads import Thread
from evedrop.system.world import world
from evedrop.wire.file import load_wire, resolved_wire, wire_of
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.on_disk import ended_summary, scorekeeper_on_disk
from evedrop.wire.plan import WirePlan
from evedrop.wire.tables import seconds_of

if TYPE_CHECKING:
    import pyarrow as pa

_PATIENCE = 60.0  # seconds, for the process to begin, to answer, and to end
_POLL_SECONDS = 0.02
LONGEST_SECONDS = 3600.0
"""The seconds after which a wire ends by itself: the program that opened it may have been killed."""


class ExpectationFailed(EvedropError, AssertionError):
    """An expectation of a wire that failed; or programs could speak past the wire."""

    exit_status = 1


def wire(
    source: str | Path | WirePlan | None = None,
    *,
    out: str | Path | None = None,
    seconds: float | str = LONGEST_SECONDS,
    **entries: Any,
) -> RunningWire:
    """A wire in a process of its own, which begins with the `with` statement and ends with it.

    source: a wire file, or a plan; None: the entries are the whole wire, such as `side=["robot", "base"]` and
    `link=[{"from": "robot", "to": "base", "quality": 0.6}]`. out: the results folder; seconds: after which the wire ends by
    itself, or a text such as "10 min". entries: with a file, changes by dotted key, with `__` for the dot, such as `seed=8` or
    `side__base__listen=[]`.

    Raises ScenarioError with every mistake of the wire. The `with` statement raises UsageError or RunError if the wire cannot
    begin, and ExpectationFailed if one of its `[[expect]]` failed, or programs could speak past it.
    """
    limit = seconds_of(str(seconds), "seconds")  # refused before there is a folder
    return RunningWire(*described_wire(source, out, entries), limit)


def described_wire(
    source: str | Path | WirePlan | None, out: str | Path | None, entries: dict[str, Any]
) -> tuple[WirePlan, Path]:
    """The plan of a wire, and its results folder, from the arguments of `wire`."""
    entries = plain_tables(entries, "wire")  # numbers of numpy as well
    if isinstance(source, WirePlan):
        if entries:
            raise UsageError(
                f"wire(plan, {', '.join(entries)}): expected no entries with a plan; change the plan instead"
            )
        plan, name = source, "wire"
    elif source is not None:
        plan = load_wire(source, {entry.replace("__", "."): value for entry, value in entries.items()})
        name = Path(source).stem
    else:
        names = entries.get("side")
        if isinstance(names, list) and all(isinstance(side, str) and names.count(side) == 1 for side in names):
            entries["side"] = {side: {} for side in names}
        plan, name = wire_of(entries), "wire"
    folder = claimed(default_folder(f"wire-{name}")) if out is None else Path(out)
    return plan, folder


class ProcessOfWire(KillableProcess, Protocol):
    """The part of `subprocess.Popen` that is used here."""

    @property
    def pid(self) -> int:
        """Its id."""

    @property
    def returncode(self) -> int | None:
        """Its exit status, as of the latest look."""

    @property
    def stderr(self) -> IO[str] | None:
        """Its warnings and errors."""

    def poll(self) -> int | None:
        """Its exit status; None while it runs."""

    def send_signal(self, sig: int) -> None:
        """Send a signal to it."""


Start = Callable[..., ProcessOfWire]
"""Starts a process of Evedrop with the words of a command."""


class RunningWire:
    """A wire in a process of its own; use it as a context manager."""

    def __init__(
        self, plan: WirePlan, folder: Path, seconds: float | str = LONGEST_SECONDS, start: Start | None = None
    ) -> None:
        """seconds: a number, or a text with a unit. start: starts a process of Evedrop; by default one of the machine."""
        self.plan = plan
        self.folder = folder.absolute()
        """The results folder."""
        self._seconds = seconds_of(str(seconds), "seconds")
        self._start: Start = _started if start is None else start
        self._process: ProcessOfWire | None = None
        self._endpoints: Mapping[str, Sequence[str]] = {}
        self._errors: list[str] = []
        self._listener: Thread | None = None

    def __enter__(self) -> Self:
        """Start the wire, and wait until programs can connect. Raises UsageError or RunError if it cannot begin."""
        if self.is_running:
            raise UsageError(f"the wire in {self.folder} runs already; expected one `with` statement after the other")
        self._endpoints, self._errors, self._listener = {}, [], None
        with self._file() as file:
            self._process = self._start(
                "wire", str(file), "--out", str(self.folder), "--for", f"{self._seconds} s", "--quiet"
            )
            try:
                listener = world().thread(self._hear_errors, self._process, name="wire")
                listener.start()
                self._listener = listener
                self._wait()
            except BaseException:  # such as Ctrl-C: no `__exit__` follows
                self._stop(signal.SIGTERM)
                raise
        return self

    @contextmanager
    def _file(self) -> Iterator[Path]:
        """The file of the wire; not in the results folder, which must be empty, or that of an earlier start."""
        folder = world().temporary_folder() / f"evedrop-wire-{world().token(8).hex()}"
        try:
            try:
                world().disk.make_folder(folder, 0o700)
                write_private(folder / "wire.toml", resolved_wire(self.plan))
            except OSError as error:
                raise UsageError(
                    f"cannot write the wire's file ({error.strerror}); set TMPDIR to a folder that can be written"
                ) from error
            yield folder / "wire.toml"
        finally:
            world().disk.remove_tree(folder, ignore_errors=True)

    def _wait(self) -> None:
        """Wait until the wire answers."""
        deadline = world().monotonic() + _PATIENCE
        while not self._endpoints:
            if not self.is_running or world().monotonic() > deadline:
                raise self._failure(self._stop(signal.SIGKILL))
            with suppress(UsageError):  # it has not begun yet
                self._endpoints = self.status().sides
            world().sleep(_POLL_SECONDS)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the wire. Raises ExpectationFailed or RunError, unless the `with` block raised an error itself."""
        status = self._stop(signal.SIGTERM)  # a background job and all that it starts ignore SIGINT
        if error is not None or status == 0:
            return
        with suppress(UsageError):
            summary = self.typed_summary()
            if summary.failed_expectations or summary.bypasses:
                raise self._failed(summary, self.plan, wire_faults(summary))
        raise self._failure(status)

    @property
    def is_running(self) -> bool:
        """Whether the wire is running."""
        return self._process is not None and self._process.poll() is None

    def endpoint(self, side: str) -> str:
        """The Zenoh endpoint of a side, such as tcp/127.0.0.1:41999. Raises UsageError if it does not listen."""
        return self._endpoints_of(side)[0]

    def config(self, side: str, user: str | None = None) -> zenoh.Config:
        """A configuration for `zenoh.open`: a client of a side, which finds no other program without the wire.

        user: who connects, with the password of the wire's file; by default the first of the side's users, if it has any.
        Raises UsageError if the side does not listen, or has no such user.
        """
        users = self.plan.sides[side].users if side in self.plan.sides else None
        if user is not None and user not in (users or {}):
            raise UsageError(f'side "{side}" has no user {user!r}; expected {listed([*users]) if users else "none"}')
        settings: dict[str, Any] = {
            "mode": "client",
            "connect": {"endpoints": list(self._endpoints_of(side))},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        if users:
            name = next(iter(users)) if user is None else user
            settings["transport"] = {"auth": {"usrpwd": {"user": name, "password": users[name]}}}
        return zenoh.Config.from_json5(json.dumps(settings))

    def partition(self, side: str, other: str) -> None:
        """Let nothing pass between two sides, except liveliness and lossless messages."""
        self._steer({"partition": [side, other]})

    def heal(self, side: str, other: str | None = None) -> None:
        """End the partition of two sides, or the cut of a link."""
        self._steer({"heal": side} if other is None else {"join": [side, other]})

    def cut(self, link: str) -> None:
        """Let nothing pass over a link, except lossless messages."""
        self._steer({"cut": link})

    def link(self, name: str, **settings: Any) -> None:
        """Give a link other settings, such as `quality=0.2` or `delay={"model": "constant", "value": 0.1}`."""
        # Such as numbers of numpy, which a message cannot have; None is the value of an entry that is not given.
        self._steer({"link": name, "set": {**dict.fromkeys(settings), **plain_tables(settings, name)}})

    def status(self) -> WireStatus:
        """The state of the wire now. Raises UsageError if it does not run."""
        answer = self._ask(StatusRequest())
        if answer.wire is None:
            raise UsageError("; ".join(answer.refused))
        return answer.wire

    def rows(self) -> pa.Table:
        """The journal so far: a row for each message and link (docs/wire/results.md, the journal)."""
        import pyarrow as pa  # noqa: PLC0415 - only for this

        return pa.concat_tables(journal_tables(self.folder))

    def summary(self) -> Mapping[str, Any]:
        """What became of the messages so far: the entries of summary.json (docs/wire/results.md, the summary)."""
        return self.typed_summary().as_dict()

    def typed_summary(self) -> WireSummary:
        """What became of the messages so far, with types. Raises UsageError if it cannot be read."""
        ended = None if self.is_running else ended_summary(self.folder)
        return scorekeeper_on_disk(self.folder, self.plan).summary() if ended is None else ended

    def expect(self, metric: str | None = None, **bounds: Any) -> None:
        """Raise ExpectationFailed if an expectation fails so far.

        The arguments are the entries of an `[[expect]]` of a wire file, such as `"scan.delivery", above=0.5`, or `link="scan"`.
        """
        table = plain_tables({"metric": metric, **bounds}, "expect")
        plan = wire_of({**tomllib.loads(resolved_wire(self.plan)), "expect": [table]})
        summary = scorekeeper_on_disk(self.folder, plan).summary()
        if summary.failed_expectations:
            raise self._failed(summary, plan, (bypass.event for bypass in summary.bypasses))

    def _failed(self, summary: WireSummary, plan: WirePlan, faults: Iterable[str]) -> ExpectationFailed:
        """What failed, why, and where the results are."""
        failures = expectation_failures(summary, [table.subject for table in plan.expectations])
        return ExpectationFailed("\n".join([*failures, *faults, f"results: {self.folder}"]))

    def _endpoints_of(self, side: str) -> Sequence[str]:
        places = self._endpoints.get(side, ())
        if not places:
            sides = [name for name, endpoints in self._endpoints.items() if endpoints]
            raise UsageError(f'side "{side}": expected a side that listens: {listed(sides)}')
        return places

    def _steer(self, event: Mapping[str, Any]) -> None:
        """Let an event begin now. Raises UsageError if the wire refuses it, or does not run."""
        if refused := self._ask(LinkRequest(event)).refused:
            raise UsageError(f"{'; '.join(refused)}; nothing was changed")

    def _ask(self, request: OperatorRequest) -> Answer:
        """The wire's answer. Raises UsageError if it does not run."""
        control = self._control()
        try:
            answer = ask(control, request, _PATIENCE)
        except zenoh.ZError as error:
            raise no_run(self.folder, f"no wire answers at {control.router}") from error
        if answer is None:
            raise no_run(self.folder, "it ended before it answered")
        return answer

    def _control(self) -> Control:
        """How this wire is steered. Raises UsageError if it does not run, although another one may, in the same folder."""
        control = read_control(self.folder)
        if self._process is None or control.process != self._process.pid:
            raise UsageError(f"this wire does not run; the control.json in {self.folder} is that of another one")
        return control

    def _hear_errors(self, process: ProcessOfWire) -> None:
        assert process.stderr is not None  # noqa: S101 - it is a pipe
        with process.stderr as errors:
            self._errors.extend(line for line in errors if not line.startswith(MARK))

    def _stop(self, number: int) -> int:
        """End the process, wait until it is gone, and return its status."""
        process = self._process
        if process is None:
            return 0
        if process.poll() is None:
            process.send_signal(number)
        kill(*wait_for([process], _PATIENCE))
        if self._listener is not None:
            self._listener.join(_PATIENCE)
        return -signal.SIGKILL if process.returncode is None else process.returncode

    def _failure(self, status: int) -> EvedropError:
        """The error for a process that failed, in its own words."""
        told = [line.removeprefix("evedrop: ") for line in self._errors if not is_warning(line)]
        warned = [line.removeprefix("evedrop: ").rstrip() for line in self._errors if is_warning(line)]
        ended = f"the wire in {self.folder} ended with status {status}"
        text = "".join(told).strip() or "; ".join([ended, *warned])
        return UsageError(text) if status == UsageError.exit_status else RunError(text)


def _started(*arguments: str) -> subprocess.Popen[str]:
    """A process of Evedrop that Ctrl-C in the terminal does not reach; the program that started it ends it."""
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "evedrop", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
        encoding="utf-8",
        process_group=0,
    )

"""Cases in which a wire is disturbed between programs: its journal must be true to what its receivers got.

Source: docs/wire/results.md, the journal; a wire that starts again.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import pyarrow as pa

from evedrop.errors import UsageError
from evedrop.model.slot.link import NEVER, Link, LinkSchedule, streams_of
from evedrop.model.streams import Batch, root_of_seed
from evedrop.scenario.receivers import wire_stream_key
from evedrop.wire.journal_reading import journal_tables
from tests.faults import ours
from tests.faults.looks import failed_looks
from tests.faults.programs import KEYS

SEED = 7
QUALITY = {"scan": 0.6, "slow": 0.8}
FILE = f"""
seed = {SEED}
[side.robot]
[side.base]
[[link]]
name = "scan"
from = "robot"
to = "base"
keys = "scan"
quality = {QUALITY["scan"]}
[[link]]
name = "slow"
from = "robot"
to = "base"
keys = "slow"
quality = {QUALITY["slow"]}
delay = {{ model = "constant", value = "30 ms" }}
[[link]]
name = "rest"
from = "robot"
to = "base"
"""
_ENDS = {"interrupt": signal.SIGINT, "terminate": signal.SIGTERM, "hang up": signal.SIGHUP}
_APPEAR_SECONDS = 120.0
_END_SECONDS = 90.0
_LEAVE_SECONDS = 60.0
_SETTLE_SECONDS = 0.4
"""Time for messages that the wire handed on before its end to reach the subscriber."""
_LOST_IN_ZENOH = 40
"""Messages that a wire may have given to Zenoh in the instant before it was killed, and that did not go out."""


@dataclass(frozen=True)
class WireFault:
    """The fault in one start of a wire, which also ends it."""

    kind: str
    target: str
    after: float
    """Seconds from the first message that arrived."""
    stopped: float | None
    """For how long the wire is suspended before, if at all."""

    def __str__(self) -> str:
        stop = "" if self.stopped is None else f"stop {self.stopped:.1f} s, "
        return f"{stop}{self.kind} at {self.after:.2f} s"


@final
@dataclass(frozen=True)
class WireCase:
    """A wire that is started, disturbed and ended one to three times in one folder."""

    seed: int
    faults: tuple[WireFault, ...]

    def __str__(self) -> str:
        return f"wire: {'; '.join(map(str, self.faults))}"


def wire_case(seed: int, draw: random.Random) -> WireCase:
    """The case of a seed."""
    faults = []
    for _ in range(draw.choice((1, 2, 2, 3))):
        kind = draw.choices(["kill", *_ENDS], (4, 2, 1, 1))[0]
        stopped = round(draw.uniform(0.1, 1.5), 2) if draw.random() < 0.4 else None
        faults.append(WireFault(kind, "wire", round(draw.uniform(0.0, 1.2), 2), stopped))
    return WireCase(seed, tuple(faults))


@dataclass
class Start:
    """A start of the wire, and what its programs saw."""

    first: int
    """The number of the first message that was sent."""
    status: int = 0
    sent: set[tuple[str, int]] = field(default_factory=set)
    received: list[tuple[str, int]] = field(default_factory=list)


def carried_out(case: WireCase, folder: Path, before: frozenset[int]) -> Iterator[str]:
    """Run a case; yields the broken promises."""
    temporary = folder / "temporary"
    temporary.mkdir(parents=True)
    (folder / "robot.toml").write_text(FILE)
    starts: list[Start] = []
    for number, fault in enumerate(case.faults):
        first = 1 + max((size for start in starts for _, size in start.sent), default=9)
        start = Start(first)
        starts.append(start)
        yield from _started(fault, start, folder, f"start-{number + 1}")
        left = ours.none_left(before, _LEAVE_SECONDS, temporary)
        yield from (
            f"process {process.pid} is left: {' '.join(process.words)}; {ours.doing(process.pid)}" for process in left
        )
        ours.end_all(left)
        yield from (f"{path} is left" for path in sorted(temporary.iterdir()))
    out = folder / "out"
    try:
        tables = {number: pa.concat_tables(journal_tables(out, number)) for number in range(1, len(starts) + 1)}
    except UsageError as error:
        yield f"the journal cannot be read: {error}"
        return
    rows = {number: table.to_pylist() for number, table in tables.items()}
    yield from wrong_numbers(rows)
    yield from wrong_fates(rows)
    for number, start in enumerate(starts, 1):
        yield from true_to_receivers(number, start, rows[number])
    if case.faults[-1].kind in _ENDS:
        yield from wrong_summary(out, rows[len(starts)], len(starts))
    yield from failed_looks(out, None)


def _started(fault: WireFault, start: Start, folder: Path, name: str) -> Iterator[str]:
    """One start of the wire, its programs, and the fault."""
    words = [sys.executable, "-m", "evedrop", "wire", "robot.toml", "--out", "out"]
    environment = {**os.environ, "TMPDIR": str(folder / "temporary"), "PYTHONUNBUFFERED": "1"}
    (folder / name).mkdir()
    with (folder / f"{name}.out").open("w+") as out, (folder / f"{name}.err").open("w+") as err:
        wire = subprocess.Popen(words, cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment)
    endpoints = _endpoints(wire, folder / f"{name}.out")
    if endpoints is None:
        wire.kill()
        wire.wait()
        yield f"the wire did not begin: {(folder / f'{name}.err').read_text()}"
        return
    program = subprocess.Popen(
        [sys.executable, "-m", "tests.faults.programs", *endpoints, str(start.first), str(folder / name)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=Path(__file__).parents[2],
        env=environment,
    )
    try:
        received = folder / name / "received"
        if not _until(lambda: received.exists() and received.stat().st_size > 0, _APPEAR_SECONDS):
            yield f"no message came through the wire within {_APPEAR_SECONDS:.0f} s"
        time.sleep(fault.after)
        if fault.stopped is not None:
            wire.send_signal(signal.SIGSTOP)
            time.sleep(fault.stopped)
            wire.send_signal(signal.SIGCONT)
            time.sleep(fault.after)
        wire.send_signal(_ENDS.get(fault.kind, signal.SIGKILL))
        try:
            start.status = wire.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            yield f"the wire did not end within {_END_SECONDS:.0f} s"
            wire.kill()
            start.status = wire.wait()
        time.sleep(_SETTLE_SECONDS)
    finally:
        program.terminate()
        try:
            program.wait(_LEAVE_SECONDS)
        except subprocess.TimeoutExpired:
            program.kill()
            program.wait()
    start.sent = set(_written(folder / name / "sent"))
    start.received = _written(folder / name / "received")
    wanted = -signal.SIGKILL if fault.kind == "kill" else 0
    text = (folder / f"{name}.err").read_text(errors="replace")
    if start.status != wanted:
        yield f"status {start.status} after {fault.kind}: {text.strip()[-300:]}"
    if "Traceback (most recent call last)" in text or "panicked at" in text:
        yield f"a traceback: {text.strip().splitlines()[-1]}"


def _until(there: Any, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not there():
        if time.monotonic() > deadline:
            return False
        threading.Event().wait(0.02)
    return True


def _endpoints(wire: subprocess.Popen[bytes], output: Path) -> list[str] | None:
    """Where the sides listen, as the wire says."""
    endpoints: dict[str, str] = {}

    def look() -> bool:
        for line in output.read_text().splitlines():
            words = line.split()
            if len(words) > 1 and words[0] in ("robot", "base") and "/" in words[1]:
                endpoints[words[0]] = words[1]
        return len(endpoints) == 2 or wire.poll() is not None

    return [endpoints["robot"], endpoints["base"]] if _until(look, _APPEAR_SECONDS) and len(endpoints) == 2 else None


def _written(path: Path) -> list[tuple[str, int]]:
    """Keys and numbers of messages, of the lines that are whole."""
    if not path.exists():
        return []
    lines = path.read_text().split("\n")[:-1]
    return [(key, int(size)) for key, size in (line.split() for line in lines)]


def wrong_numbers(rows: Mapping[int, list[dict[str, Any]]]) -> Iterator[str]:
    """The numbers of each key's messages go on over all starts, without a gap and without one twice."""
    numbered = defaultdict(list)
    for start in rows.values():
        for row in start:
            numbered[row["link"], row["key"], row["kind"]].append(row["n"])
    for stream, numbers in numbered.items():
        if sorted(numbers) != list(range(len(numbers))):
            twice = [n for n, count in Counter(numbers).items() if count > 1][:3]
            gaps = sorted(set(range(max(numbers))) - set(numbers))[:3]
            yield f"the journal numbers {stream} with gaps at {gaps} and twice {twice}"


def lost_by_model(key: str, count: int) -> list[bool]:
    """Which of the first messages of a key its link's model loses, decided in one go."""
    settings = {"loss": {"model": "bernoulli", "quality": QUALITY[key]}}
    schedule = LinkSchedule(settings, NEVER - 1)
    root = root_of_seed(SEED)
    keys = {name: wire_stream_key(root, name, "put", key) for name in streams_of(key, schedule)}
    return [bool(code) for code in Link(schedule, key, keys, Batch(NEVER, 1)).fates(range(count)).codes[:, 0]]


def wrong_fates(rows: Mapping[int, list[dict[str, Any]]]) -> Iterator[str]:
    """Message n of each key is lost if the model loses it, whatever happened to the wire before."""
    for key in KEYS:
        of_key = {row["n"]: row for start in rows.values() for row in start if row["key"] == key}
        if not of_key:
            continue
        lost = lost_by_model(key, max(of_key) + 1)
        wrong = [n for n, row in of_key.items() if (row["reason"] == "loss") != lost[n]]
        if wrong:
            yield f"{len(wrong)} fates of {key} are not those of its model, first of message {min(wrong)}"
        if key != "slow" and (late := [n for n, row in of_key.items() if row["delay"]]):
            yield f"{len(late)} messages of {key} were held back"


def true_to_receivers(number: int, start: Start, rows: list[dict[str, Any]]) -> Iterator[str]:
    """Each message that arrived is in the journal, once, as delivered, and each that was delivered arrived."""
    where = f"start {number}"
    killed = start.status != 0
    got = Counter(start.received)
    if twice := [message for message, count in got.items() if count > 1]:
        yield f"{where}: {twice[0]} arrived {got[twice[0]]} times"
    ours_only = [row for row in rows if row["key"] in KEYS]
    by_fate = defaultdict(set)
    for row in ours_only:
        by_fate[row["reason"] if row["fate"] != "delivered" else "delivered"].add((row["key"], row["size"]))
    heard = {(row["key"], row["size"]) for row in ours_only}
    if strangers := heard - start.sent:
        yield f"{where}: the journal has {len(strangers)} messages that nobody sent, such as {min(strangers)}"
    for key in KEYS:
        sizes = sorted(size for name, size in heard if name == key)
        if sizes and sizes != list(range(sizes[0], sizes[0] + len(sizes))):
            yield f"{where}: messages of {key} between others that the wire heard are missing in the journal"
    if unwritten := set(got) - heard:
        yield f"{where}: {len(unwritten)} messages arrived that the journal does not have, such as {min(unwritten)}"
    if wrong := set(got) & set().union(
        *(some for fate, some in by_fate.items() if fate not in ("delivered", "underway"))
    ):
        yield f"{where}: {len(wrong)} messages arrived that the journal calls lost, such as {min(wrong)}"
    underway = by_fate["underway"]
    if not killed and set(got) & underway:
        yield f"{where}: {len(set(got) & underway)} messages arrived that the journal calls underway"
    missing = by_fate["delivered"] - set(got)
    newest = {(key, size) for key in KEYS for size in sorted(s for k, s in heard if k == key)[-_LOST_IN_ZENOH:]}
    if missing and (not killed or missing - newest):
        yield f"{where}: {len(missing)} messages never arrived that the journal calls delivered, such as {min(missing)}"
    if not heard:
        yield f"{where}: the journal has no message"


def wrong_summary(out: Path, rows: list[dict[str, Any]], start: int) -> Iterator[str]:
    """The metrics of the last start, which ended by itself, are those of its rows."""
    path = out / "summary.json"
    if not path.exists():
        yield "there is no summary"
        return
    summary = json.loads(path.read_text())
    if (summary["state"], summary["start"], summary["unaccounted"]) != ("ended", start, 0):
        yield f"the summary says {summary['state']}, start {summary['start']}, {summary['unaccounted']} unaccounted"
    if summary["heard"] != len(rows):
        yield f"the summary heard {summary['heard']} messages, and the journal has {len(rows)}"
    for name, link in summary["links"].items():
        of_link = [row for row in rows if row["link"] == name]
        counts = Counter(row["fate"] for row in of_link)
        account = (link["heard"], link["delivered"], sum(link["lost_by"].values()), sum(link["dropped_by"].values()))
        wanted = (len(of_link), counts["delivered"], counts["lost"], counts["dropped"])
        if account != wanted:
            yield f"link {name} heard, delivered, lost and dropped {account}, and by the journal {wanted}"

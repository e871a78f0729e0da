"""Disturb live runs, wires and studies at random, seeded, and hold what becomes of them against what is promised.

    python -m tests.faults.campaign --seed 1 --count 100

Each case has a number, and its scenario, faults and moments are drawn from that: the same number is the same case. Folders of
cases in which something promised does not hold are kept. Source: docs/maintainers/tests.md, faults.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, final

from evedrop.virtual.reference import RunReference, in_memory
from tests.faults import ours, studies, wires
from tests.faults.cases import PATIENT_SECONDS, AnyCase, Case, case_of
from tests.faults.disturbed import FORK_SERVERS, Disturbed, disturbed
from tests.faults.facilities import Facilities, facilities
from tests.faults.judge import OUTCOMES, misses, outcome_of, status_of
from tests.faults.kinds import KINDS, Fault
from tests.faults.moments import Usual
from tests.faults.studies import StudyFault, Undisturbed
from tests.faults.variants import Variant
from tests.faults.wires import WireCase, WireFault
from tests.sshd import Sshd, sshd

T = TypeVar("T")

_LIMIT_SECONDS = 75.0
"""Within which a run must have ended after its last fault; the longest outage comes on top."""


_UNDISTURBED_SECONDS = 600.0
_RESTART_SECONDS = 130.0
"""Within which a run gives up a fork server that must start a process again and does not respond."""
_HEADS = {"kind": "fault", "target": "target"}
SKIPPED = "NOT TESTED HERE"


class Refused(Exception):
    """The campaign cannot begin, because what nobody disturbed is not as it must be."""


@dataclass(frozen=True)
class Verdict:
    """The outcome of a case."""

    case: AnyCase
    hits: tuple[Fault | WireFault | StudyFault, ...]
    """The faults that hit something: some come when the run is over."""
    outcome: str
    misses: tuple[str, ...]
    seconds: float
    lack: str | None = None
    """Why it was skipped."""

    def __str__(self) -> str:
        late = len(self.case.faults) - len(self.hits)
        some = f" ({late} too late)" if late else ""
        why = f": {self.lack}" if self.lack is not None else some
        return f"{self.case.seed:6d}  {self.outcome:18} {self.seconds:5.1f} s  {self.case}{why}"


@final
@dataclass
class Campaign:
    """Cases in a folder."""

    folder: Path
    facilities: Facilities
    _known: dict[str, tuple[RunReference, Usual]] = field(default_factory=dict)
    _study: Undisturbed | None = None

    def carry_out(self, case: AnyCase) -> Verdict:
        """Run a case to its end. Raises Refused if it goes wrong undisturbed."""
        if isinstance(case, Case):
            lacks = [self.facilities.lacks[need] for need in sorted(case.needs) if need in self.facilities.lacks]
            return Verdict(case, (), SKIPPED, (), 0.0, lacks[0]) if lacks else self._run(case)
        before = frozenset(process.pid for process in ours.descendants())
        folder, begun = self.folder / str(case.seed), time.monotonic()
        if isinstance(case, WireCase):
            misses = list(wires.carried_out(case, folder, before))
        else:
            misses = list(studies.carried_out(case, folder, before, self._studied()))
        return self._verdict(case, case.faults, misses, OUTCOMES[0], time.monotonic() - begun)

    def _verdict(
        self,
        case: AnyCase,
        hits: tuple[Fault | WireFault | StudyFault, ...],
        misses: list[str],
        outcome: str,
        seconds: float,
    ) -> Verdict:
        """What became of a case, whose folder is kept if something promised did not hold."""
        ours.reap()
        if not misses:
            shutil.rmtree(self.folder / str(case.seed))
        return Verdict(case, hits, OUTCOMES[-1] if misses else outcome, tuple(misses), seconds)

    def _studied(self) -> Undisturbed:
        if self._study is None:
            folder = self.folder / "study"
            folder.mkdir()
            self._study = _begun(lambda: studies.undisturbed(folder))
        return self._study

    def _run(self, case: Case) -> Verdict:
        """Disturb a live run."""
        reference, usual = self.known(case.variant)
        folder = self.folder / str(case.seed)
        hits: dict[Fault, float] = {}
        with _server(case.variant, folder) as server:
            before = frozenset(process.pid for process in ours.descendants())
            begun = time.monotonic()
            disk = self._disk(case)
            with disturbed(case.variant, folder, case.options, case.wired, disk, case.limits, server) as run:
                hung = _follow(run, case, usual, hits)
                seconds = time.monotonic() - begun
                if hung:
                    run.launcher.kill()
                run.launcher.wait()
                run.free()
                complaints = misses(run, hits, case.longest_outage, reference, before) if not hung else [hung]
                ours.end_all(ours.none_left(before, 5.0 if hung else 0.0))
        return self._verdict(case, tuple(hits), complaints, outcome_of(status_of(run)), seconds)

    def _disk(self, case: Case) -> str | None:
        return case.disk if case.disk != "full" or self.facilities.small_disks else None

    def known(self, variant: Variant) -> tuple[RunReference, Usual]:
        """The result of an undisturbed run of a variant, and how long it takes."""
        if variant.name not in self._known:
            folder = self.folder / variant.name
            folder.mkdir()
            reference = _begun(lambda: in_memory(variant.scenario(folder), folder / "memory"))
            with _server(variant, folder / "live") as server:
                self._known[variant.name] = reference, _usual(variant, folder / "live", reference, server)
            ours.reap()
        return self._known[variant.name]


@contextmanager
def _server(variant: Variant, folder: Path) -> Iterator[Sshd | None]:
    """An sshd for one run of a variant, if it is over ssh.

    Not one for all runs: while we have no other child, the system itself can say that a run has left no process.
    """
    if not variant.hosts:
        yield None
        return
    place = folder / "sshd"
    place.mkdir(parents=True)
    with sshd(place) as server:
        yield server


def _usual(variant: Variant, folder: Path, reference: RunReference, server: Sshd | None) -> Usual:
    """How long an undisturbed run takes. Raises Refused if it does not keep what is promised."""
    before = frozenset(process.pid for process in ours.descendants())
    with disturbed(variant, folder, ["--set", f"longest_outage={PATIENT_SECONDS}"], server=server) as run:
        try:
            run.launcher.wait(_UNDISTURBED_SECONDS)
        except subprocess.TimeoutExpired:
            run.launcher.kill()
            ours.end_all(ours.none_left(before, 0.0))
            raise Refused(
                f"an undisturbed run of {variant.name} did not end within {_UNDISTURBED_SECONDS:.0f} s"
            ) from None
        ended = time.monotonic()
        run.over.wait(0.1)  # for the last events to be read
        if run.launcher.returncode:
            ours.end_all(ours.none_left(before, 5.0))
            raise Refused(f"an undisturbed run of {variant.name} fails: {run.text('stderr')}")
        wrong = misses(run, {}, PATIENT_SECONDS, reference, before)
        if wrong or run.started is None or run.finished is None:
            raise Refused(f"an undisturbed run of {variant.name} is not as it must be: {'; '.join(wrong)}")
        return Usual(run.started - run.begun, run.finished - run.started, ended - run.finished)


def _begun(work: Callable[[], T]) -> T:
    """The result of work that nobody disturbs. Raises Refused if it fails."""
    try:
        return work()
    except Exception as error:
        raise Refused(f"undisturbed, {type(error).__name__}: {error}") from error


def _follow(run: Disturbed, case: Case, usual: Usual, hits: dict[Fault, float]) -> str | None:
    """Let the faults strike, and wait for the launcher's end; what is wrong if it does not come."""

    def strike(fault: Fault) -> None:
        begun = fault.strike(run, usual)
        if begun is not None:
            hits[fault] = begun

    threads = [threading.Thread(target=strike, args=(fault,)) for fault in case.faults]
    for thread in threads:
        thread.start()
    lasting = sum(fault.seconds or 0.0 for fault in case.faults)
    if any(fault.target in FORK_SERVERS and fault.seconds is None for fault in case.faults):
        lasting += _RESTART_SECONDS
    limit = usual.start + usual.run + usual.finish + lasting + case.longest_outage + _LIMIT_SECONDS
    hung = None
    try:
        run.launcher.wait(limit)
    except subprocess.TimeoutExpired:
        hung = f"the run did not end within {limit:.0f} s"
    run.ended = time.monotonic()
    run.over.set()
    for thread in threads:
        thread.join()
    return hung


def tally(verdicts: Sequence[Verdict]) -> str:
    """How many faults of each kind came to which end, and each target, as tables in Markdown."""
    parts = []
    for head in ("kind", "target"):
        counts = Counter((getattr(fault, head), verdict.outcome) for verdict in verdicts for fault in verdict.hits)
        names = [name for name in KINDS if any(key[0] == name for key in counts)] if head == "kind" else []
        names += sorted({key[0] for key in counts} - set(names))
        lines = [f"| {_HEADS[head]} | {' | '.join(OUTCOMES)} | all |", "|---" * (len(OUTCOMES) + 2) + "|"]
        for name in names:
            row = [counts[name, outcome] for outcome in OUTCOMES]
            lines.append(f"| {name} | {' | '.join(map(str, row))} | {sum(row)} |")
        sums = [sum(counts[name, outcome] for name in names) for outcome in OUTCOMES]
        lines.append(f"| all | {' | '.join(map(str, sums))} | {sum(sums)} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


@contextmanager
def campaign(folder: Path | None = None) -> Iterator[Campaign]:
    """A campaign in a folder, by default a temporary one, which is removed if nothing is kept in it."""
    ours.adopt_orphans()
    ours.heed_signals()
    mounts = ours.mounts_of_our_own()
    made = folder or Path(tempfile.mkdtemp(prefix="faults-"))
    made.mkdir(parents=True, exist_ok=True)
    campaign = Campaign(made, facilities(mounts, made))
    try:
        yield campaign
    finally:
        kept = [path for path in made.iterdir() if path.name.isdecimal()]
        if not kept and folder is None:
            shutil.rmtree(made)


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out some cases; 1 if something promised did not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.campaign", description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, nargs="+", default=[1], help="numbers of the first cases")
    parser.add_argument("--count", type=int, default=1, help="how many cases from each number on")
    parser.add_argument("--list", action="store_true", help="print the cases and run none")
    parser.add_argument("--first", action="store_true", help="end at the first case in which something did not hold")
    parser.add_argument("--keep", type=Path, help="a folder for what is kept; default a temporary one")
    options = parser.parse_args(arguments)
    cases = [case_of(seed) for first in options.seed for seed in range(first, first + options.count)]
    if options.list:
        for case in cases:
            say(f"{case.seed:6d}  {case}")
        return 0
    verdicts: list[Verdict] = []
    with campaign(options.keep) as running:
        try:
            for case in cases:
                verdicts.append(running.carry_out(case))
                say(str(verdicts[-1]))
                for miss in verdicts[-1].misses:
                    say(f"        {miss}")
                if options.first and verdicts[-1].misses:
                    break
        except KeyboardInterrupt:
            say("interrupted")
        except Refused as error:
            say(f"REFUSED {error}")
    missed = [verdict for verdict in verdicts if verdict.misses]
    say(f"\n{tally(verdicts)}\n")
    say(f"{sum(len(verdict.hits) for verdict in verdicts)} faults in {len(verdicts)} runs, {len(missed)} with a miss")
    for verdict in missed:
        say(
            f"    make test-faults SEED={verdict.case.seed}    what is left of it: {running.folder / str(verdict.case.seed)}"
        )
    skipped = [verdict for verdict in verdicts if verdict.lack is not None]
    for lack in sorted({str(verdict.lack) for verdict in skipped}):
        count = sum(verdict.lack == lack for verdict in skipped)
        say(f"!!!!!!!! {SKIPPED}: {count} of {len(verdicts)} cases, because this machine cannot run them: {lack}")
    return 1 if missed or len(verdicts) < len(cases) else 0


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main())

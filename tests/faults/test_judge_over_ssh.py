"""The judge of the campaign sees what a run over ssh must not do, and the parts of its hosts can be told apart."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from evedrop.virtual.reference import RunReference
from tests.conftest import wait_until
from tests.faults import judge
from tests.faults.cases import PATIENT_SECONDS, Case, case_of
from tests.faults.disturbed import CLEANER, FORK_SERVERS, Disturbed, disturbed
from tests.faults.ended import Ended
from tests.faults.hosts import (
    CONNECTION,
    HOST_CLEANER,
    HOST_FORK_SERVER,
    PARTS,
    PROGRAM,
    SESSION,
    SSH,
    host_of,
    part_of,
    target_on,
)
from tests.faults.kinds import KILLING, NETWORK, SIGNALS, Fault
from tests.faults.moments import PHASES, Moment
from tests.faults.variants import HOSTED
from tests.privileged import CannotRun, skip
from tests.processes import words_of
from tests.sshd import sshd

LOST = "evedrop: naive was lost: the connection with host beta ended: ssh ended with status 255\n"


def fault(kind: str, part: str, host: str = "beta", seconds: float | None = None, phase: str = "run") -> Fault:
    """A fault that disturbs a part of a host."""
    return Fault(kind, target_on(part, host), Moment(phase, 0.5), seconds=seconds)


KILL = fault("kill", SSH)
HANGS = fault("stop", PROGRAM)
INTERRUPT = Fault("interrupt", "launcher", Moment("run", 0.5))


@pytest.fixture
def spread(ended: Ended) -> Ended:
    """A run over ssh that ended as if nothing had happened."""
    ended.spread(HOSTED["hosts"])
    return ended


@pytest.fixture
def cut_short(early: Ended) -> Ended:
    """A run over ssh that ended early, as its connection with beta did."""
    early.spread(HOSTED["hosts"])
    (early.folder / "stderr").write_text(LOST)
    return early


def says(words: str, misses: list[str]) -> None:
    """The judge says this, and nothing else."""
    assert len(misses) == 1, misses
    assert words in misses[0], misses


def test_the_judge_has_nothing_to_say_of_a_run_over_ssh_that_is_complete(
    spread: Ended, reference: RunReference
) -> None:
    """Whatever struck it: it may have struck late."""
    assert spread.misses(reference, KILL, HANGS) == []


def test_the_judge_has_nothing_to_say_of_a_run_that_its_connection_ended(
    cut_short: Ended, reference: RunReference
) -> None:
    """Its first line names the host and a process there."""
    assert cut_short.misses(reference, KILL) == []


@pytest.mark.parametrize(
    ("told", "hits", "words"),
    [
        ("naive was ended by signal 9", [KILL], "the failure names none of host beta"),
        ("the connection with host beta ended", [KILL], "the failure names host beta and no process on it"),
        (LOST.replace("naive", "legitimate"), [KILL], "the failure names host beta and no process on it"),
        (
            LOST.replace("naive", "legitimate").replace("beta", "alpha"),
            [KILL, Fault("kill", "legitimate", Moment("run", 0.5))],
            "the failure names host alpha, which nothing disturbed",
        ),
        pytest.param(
            LOST,
            [fault("stop", SESSION, seconds=1.0)],
            "although nothing of this may end a run",
            marks=pytest.mark.long,
        ),
        (LOST, [fault("silence", CONNECTION, seconds=1.0)], "although nothing of this may end a run"),
        pytest.param(LOST, [HANGS], "although nothing of this may end a run", marks=pytest.mark.long),
        pytest.param(LOST, [fault("stop", SSH)], "although nothing of this may end a run", marks=pytest.mark.long),
        (LOST, [fault("kill", HOST_CLEANER)], "although nothing of this may end a run"),
    ],
)
def test_the_wrong_name_of_a_failure_is_seen(
    told: str, hits: list[Fault], words: str, cut_short: Ended, reference: RunReference
) -> None:
    """The host whose connection ended and a process on it are named, and only where something ended it."""
    (cut_short.folder / "stderr").write_text(told if told.startswith("evedrop: ") else f"evedrop: {told}\n")
    says(words, cut_short.misses(reference, *hits))


@pytest.mark.parametrize("part", [fault("cut", CONNECTION, seconds=0.1), fault("flap", CONNECTION, seconds=0.1)])
def test_a_connection_that_is_closed_may_end_a_run(part: Fault, cut_short: Ended, reference: RunReference) -> None:
    """Ssh does not connect again, however short the cut is."""
    assert cut_short.misses(reference, part) == []


def test_a_host_that_is_used_no_more_at_the_start_is_named(
    spread: Ended, tmp_path: Path, reference: RunReference
) -> None:
    """With status 2, in the first line; and there are no results of a run that was not started."""
    (spread.folder / "stderr").write_text("evedrop: host beta: ssh ended with status 255; try `ssh ...`\n")
    spread.launcher.returncode = judge.UNUSABLE
    spread.told = []
    killed = fault("kill", PROGRAM, phase="start")
    assert [line for line in spread.misses(reference, killed) if "status 2, and there are results in run" in line]
    spread.out.rename(tmp_path / "elsewhere")
    assert spread.misses(reference, killed) == []
    says("the first line names none of host alpha", spread.misses(reference, fault("kill", PROGRAM, "alpha")))
    says("status 2", spread.misses(reference, Fault("kill", "smart", Moment("start", 0.5))))


@pytest.mark.thorough
def test_a_run_whose_host_hangs_and_that_ends_late_is_seen(spread: Ended, reference: RunReference) -> None:
    """Half a minute is promised, after the last slot and after a signal."""
    spread.told = [{"event": "progress", "done": 400, "at": 2.0}]
    spread.ended = 20.0
    assert spread.misses(reference, HANGS) == []
    spread.ended = 60.0
    says("ended 58 s after its last slot or a signal", spread.misses(reference, HANGS))
    assert spread.misses(reference, fault("stop", PROGRAM, seconds=1.0)) == []
    spread.told = []
    assert [line for line in spread.misses(reference, HANGS, INTERRUPT) if "ended 59 s after" in line]


@pytest.mark.thorough
def test_a_private_folder_on_a_host_is_seen(spread: Ended, reference: RunReference) -> None:
    """Only where the program and its cleaner were killed, the next run there removes it."""
    (spread.folder / "beta" / "evedrop-x").mkdir()
    program, cleaner = fault("kill", PROGRAM), fault("kill", HOST_CLEANER)
    says("beta/evedrop-x is left", spread.misses(reference, program))
    says("beta/evedrop-x is left", spread.misses(reference, fault("kill", PROGRAM, "alpha"), cleaner))
    assert spread.misses(reference, program, cleaner) == []


def test_a_traceback_on_a_host_is_seen(spread: Ended, reference: RunReference) -> None:
    """What ssh brings of its standard error."""
    (spread.folder / "beta.stderr").write_text("Traceback (most recent call last):\n  boom")
    says("beta.stderr has a traceback", spread.misses(reference))


def test_nobody_interrupts_a_run_by_a_signal_to_a_host(cut_short: Ended, reference: RunReference) -> None:
    """The launcher was told nothing."""
    cut_short.launcher.returncode = judge.INTERRUPTED
    says("no signal asked for the end", cut_short.misses(reference, fault("terminate", PROGRAM)))


def test_a_connection_with_a_host_explains_no_outage(spread: Ended, reference: RunReference) -> None:
    """The processes there talk with their router directly."""
    outage = {"process": "router", "slot": 3, "until": 9, "seconds": 1.0}
    spread.edit(lambda summary: summary["outages"].append(outage))
    says("no fault caused one", spread.misses(reference, fault("stop", SESSION, seconds=1.0)))
    assert spread.misses(reference, KILL) == []


def test_cases_over_ssh_are_every_sixteenth_and_disturb_every_part() -> None:
    """By every kind that fits it, in every phase; a short interruption of each part that nobody gives up for it, too."""
    numbered = {seed: case for seed in range(4000) if isinstance(case := case_of(seed), Case) and case.variant.hosts}
    assert set(numbered) == set(range(15, 4000, 16))
    cases = numbered.values()
    assert all(case.needs == {"sshd"} for case in cases)
    assert {case.variant.name for case in cases} == set(HOSTED)
    hit = {(each.kind, part_of(each.target)) for case in cases for each in case.faults if host_of(each.target)}
    ends = {(kind, part) for kind in (*KILLING, *SIGNALS, "stop") for part in (SSH, PROGRAM, SESSION)}
    few = {(kind, part) for kind in ("kill", "stop") for part in (HOST_FORK_SERVER, HOST_CLEANER)}
    assert hit == ends | few | {(kind, CONNECTION) for kind in NETWORK}
    faults = [each for case in cases for each in case.faults]
    assert {host_of(each.target) for each in faults} == {"", "alpha", "beta"}
    assert {each.moment.phase for each in faults if host_of(each.target)} == set(PHASES)
    assert {part_of(each.target) for each in faults if each.is_ignored} == {SSH, PROGRAM}
    assert not [each for each in faults if host_of(each.target) and not each.seconds and each.moment.phase == "start"
                and each.kind in ("stop", "silence", "cut")]  # fmt: skip
    assert {each.target for each in faults if not host_of(each.target)} >= {"launcher", "router", "smart", "everybody"}


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Disturbed]:
    """A run over ssh that goes on."""
    place = tmp_path / "sshd"
    place.mkdir()
    try:
        with sshd(place) as server:
            variant = HOSTED["hosts"]
            slow = ["--set", f"longest_outage={PATIENT_SECONDS}", "--slots", "1000000"]
            with disturbed(variant, tmp_path / "run", slow, {"smart"}, server=server) as run:
                try:
                    wait_until(lambda: run.done or run.launcher.poll() is not None, "a run that goes on")
                    yield run
                finally:
                    run.launcher.terminate()
                    run.launcher.wait()
    except CannotRun as error:
        skip(error)


@pytest.mark.long
def test_each_part_of_each_host_is_found(run: Disturbed) -> None:
    """They are all different processes, and so are those of this machine; a host's connection, and a process's, have cables."""
    assert run.launcher.poll() is None, run.text("stderr")
    names = [target_on(part, host) for host in run.variant.hosts for part in PARTS if part != CONNECTION]
    pids = {name: run.pids(name) for name in (*names, *run.variant.processes, "launcher", CLEANER, *FORK_SERVERS)}
    assert {name for name, ids in pids.items() if not ids or (len(ids) > 1 and part_of(name) != SESSION)} == set()
    every = [pid for ids in pids.values() for pid in ids]
    assert len(set(every)) == len(every)
    for host, processes in run.variant.hosts.items():
        (cable,) = run.wires(target_on(CONNECTION, host))
        assert cable.connections == 1
        briefs = [Path(words_of(pids[name][0])[-1]) for name in processes]
        assert {brief.parent.parent for brief in briefs} == {run.temporaries[host]}
    assert len(run.wires("smart")) == 1

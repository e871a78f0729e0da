"""However a run ends, the process at fault is named, its measurements are on disk, and no process is left."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from evedrop.results.crash_proof_tables import last_round
from tests.conftest import Evedrop, Live, cause_of, wait_until, with_mark
from tests.examples import mostly_long
from tests.rogue import with_rogue
from tests.steps import stepping

ENDLESS = ("--slots", "1000000")


def ended_by_fault(live: Live) -> str:
    """Check a run that a fault has just ended; returns its message."""
    done = live.end()
    assert done.status == 3, done.err
    live.nothing_left()
    assert cause_of(live.results.summary["ended"]) in done.err
    return done.err


def tables_whole(live: Live) -> int:
    """Check that the tables are readable and agree with the summary; the slots on disk."""
    results = live.results
    slots: int = results.summary["slots"]
    receivers = len(results.summary["peers"])
    assert results.slots.num_rows == results.journal.num_rows == slots * receivers
    assert results.trials.num_rows == slots * receivers
    return slots


@pytest.mark.thorough
def test_a_killed_process_is_named_and_the_results_are_kept(evedrop: Evedrop) -> None:
    """Kill -9 of any process but router and recorder ends the run at once, and costs no slot that was scored."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    live.kill("smart")
    ending = ended_by_fault(live)
    assert "smart was ended by signal 9" in ending
    assert "logs/smart.log" in ending
    tables_whole(live)


@pytest.mark.thorough
def test_a_killed_recorder_is_named_and_what_it_wrote_is_kept(evedrop: Evedrop) -> None:
    """The launcher makes whole tables of what the recorder had written; the summary says why."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    wait_until(lambda: last_round(live.folder).slots > 0, "slots on disk")
    live.kill("recorder")
    assert "recorder was ended by signal 9" in ended_by_fault(live)
    assert tables_whole(live) > 0
    assert not (live.folder / "unfinished").exists()


ROGUES = {
    "NaN estimate": ("smart", "change(lambda self: dict(x_hat=self.slots.x_hat * float('nan')))", "NaN"),
    "skipped slot": ("sensor", "packets(lambda slots: dataclasses.replace(slots, first=slots.first + 2))", "gap on"),
    "journal without a link": ("router", "Journal.pack = lambda self: pack({'k': 0, 'c': 1, 'links': {}})", "a map"),
    "wrong progress": ("suspicious", "reporting.Progress.pack = lambda notice: b''", "not msgpack"),
}
"""What is wrong → the process at fault, how, and the expected message: for each pair of a sender and a process that notices."""


@pytest.mark.parametrize("case", mostly_long(ROGUES, ["NaN estimate", "skipped slot", "journal without a link"]))
def test_a_process_that_breaks_the_protocol_is_named(evedrop: Evedrop, case: str) -> None:
    """Whichever process notices it, the sender is named, with the mistake and the last lines of its log."""
    name, does, message = ROGUES[case]
    rogue = with_rogue(evedrop, name, does)
    live = evedrop.live("eavesdroppers", *ENDLESS, "--set", "longest_outage=1", env=rogue)
    done = live.end()
    assert done.status == 3
    assert done.err.startswith(f"evedrop: {name} broke the protocol: ")
    assert message in done.err.splitlines()[0]
    assert f"logs/{name}.log" in done.err
    live.nothing_left()
    tables_whole(live)


@pytest.mark.parametrize(
    ("does", "message"),
    [
        ("def fail(self):\n    raise RuntimeError('no such luck')\nReport.pack = fail", "no such luck"),
        ("import os\nReport.pack = lambda self: os._exit(0)", "smart left before the run ended"),
        ("import os\nos._exit(7)", "smart ended with status 7"),
        (
            "import threading\ndef fail():\n    raise MemoryError\nthreading.Thread(target=fail).start()",
            "there is not enough memory",
        ),
    ],
    ids=["exception", "leaves early", "does not start", "exception in a thread"],
)
def test_a_process_that_fails_is_named(evedrop: Evedrop, does: str, message: str) -> None:
    """An exception, on any thread, an early leave and a failed start all end the run, with the log."""
    live = evedrop.live("eavesdroppers", *ENDLESS, env=with_rogue(evedrop, "smart", does))
    done = live.end()
    assert done.status == 3
    assert done.err.startswith("evedrop: smart ")
    assert message in done.err
    live.nothing_left()


def test_a_router_that_lies_is_found_out(evedrop: Evedrop) -> None:
    """Packets that are delivered by the journal, but were not received, end the run; the message names slot and processes."""
    lie = (
        "import evedrop.live.network.router as router\nhonest = router.delivery\n"
        "def lie(slots, arrivals):\n"
        "    gamma = [[flag and k != 7 for flag in row] for k, row in zip(slots, arrivals.gamma)]\n"
        "    return honest(slots, arrivals._replace(gamma=arrivals.gamma & gamma))\n"
        "router.delivery = lie"
    )
    live = evedrop.live("eavesdroppers", "--slots", "40", env=with_rogue(evedrop, "router", lie))
    done = live.end()
    assert done.status == 3
    assert " contradicts router: in slot 7, trial 0, it says that it received nothing" in done.err
    assert "logs/router.log" in done.err
    assert live.results.summary["slots"] <= 7


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("when", "number"),
    [
        pytest.param("folder", signal.SIGTERM, marks=pytest.mark.long),
        ("first child", signal.SIGHUP),
        ("running", signal.SIGINT),
    ],
)
def test_an_interrupted_run_leaves_results_and_no_process(evedrop: Evedrop, when: str, number: signal.Signals) -> None:
    """Ctrl-C, SIGTERM and SIGHUP at any moment: exit 130, what was measured is readable, nothing is left."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    moments: dict[str, Callable[[], object]] = {
        "folder": lambda: wait_until(live.folder.exists, "a results folder"),
        "first child": lambda: wait_until(live.children, "a child"),
        "running": live.running,
    }
    moments[when]()
    live.process.send_signal(number)
    done = live.end()
    assert done.status == 130
    assert done.err.splitlines() == ["evedrop: interrupted; the results so far are in run"]
    live.nothing_left()
    assert live.results.summary["ended"] == "interrupted"
    again = evedrop("montecarlo", "run", "--slots", "20", "--trials", "1", "--out", "again")
    assert (again.status, again.err) == (0, "")
    slots = tables_whole(live)
    if when == "running":
        assert slots > 0


@pytest.mark.long
def test_an_interrupted_run_has_no_digest(evedrop: Evedrop) -> None:
    """A digest is of a whole run or null, and --json prints the summary of an interrupted run too."""
    live = evedrop.live("eavesdroppers", *ENDLESS, "--json")
    live.running()
    live.process.terminate()
    summary = live.end().summary
    assert {peer["digest"] for peer in summary["peers"].values()} == {None}
    assert {link["unexplained"] for link in summary["links"].values()} == {0}
    assert all("too few" in verdict["relative"] for verdict in summary["secrecy"].values())


@pytest.mark.thorough
def test_nothing_outlives_a_killed_launcher(evedrop: Evedrop) -> None:
    """Children notice that their launcher is gone; the recorder still writes what there is."""
    live = evedrop.live("eavesdroppers", *ENDLESS)
    live.running()
    live.process.kill()
    live.end()
    wait_until(lambda: not live.left(), "no process left")
    live.nothing_left()
    assert live.results.summary["ended"] == "interrupted"
    assert tables_whole(live) > 0


@pytest.mark.long
def test_a_paused_process_does_not_outlive_its_launcher(evedrop: Evedrop) -> None:
    """Paused by an event, it cannot notice that the launcher is killed: the system continues it, and it ends."""
    pause = "event.0={from = 5, to = 900000, pause = 'smart'}"
    live = evedrop.live("eavesdroppers", *ENDLESS, "--set", pause)
    wait_until(lambda: "T" in _state(live.child("smart")), "a paused process")
    live.process.kill()
    live.process.communicate()
    wait_until(lambda: not live.left(), "no process left")


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.mark.thorough
def test_a_process_deletes_its_brief_when_it_has_read_it(evedrop: Evedrop) -> None:
    """Its keys do not stay on disk: from the first slot on no brief is left, and none after a process was started again."""
    live = evedrop.live("restart", "--pace", "0", "--paused")
    live.held()
    assert live.briefs() == {}
    assert evedrop("resume", str(live.folder)).status == 0
    done = live.end()
    assert done.status == 0, done.err
    live.nothing_left()


@pytest.mark.parametrize("when", ["folder", "first child"])
def test_keys_of_a_killed_launcher_do_not_stay(evedrop: Evedrop, when: str) -> None:
    """Killed before its processes have read their briefs: no brief, key or password is left, and no process."""
    live = evedrop.live("eavesdroppers", *ENDLESS)

    def private() -> list[Path]:
        # Python also writes an empty file there, to see whether it can, and removes it.
        return list(live.temporary.glob("evedrop-*"))

    moments: dict[str, Callable[[], object]] = {
        "folder": lambda: wait_until(private, "a private folder"),
        "first child": lambda: wait_until(live.children, "a child"),
    }
    moments[when]()
    live.process.kill()
    live.process.communicate()
    wait_until(lambda: not live.left(), "no process left")
    assert private() == []


def test_a_private_folder_is_removed_with_its_launcher_or_by_the_next(tmp_path: Path) -> None:
    """With the launcher if it is killed alone, by the next run if its guard is killed too; those in use are kept."""
    code = (
        "import sys\nfrom evedrop.live.launch.private_folder import private_folder\n"
        "with private_folder() as folder:\n    print(folder, flush=True)\n    sys.stdin.read()\n"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}

    def begun() -> tuple[subprocess.Popen[str], Path]:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            text=True,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert process.stdout is not None
        return process, Path(process.stdout.readline().strip())

    first, folder = begun()
    assert folder.stat().st_mode & 0o777 == 0o700
    first.kill()
    first.communicate()
    wait_until(lambda: not folder.exists(), "no folder of a killed launcher")
    second, two = begun()
    for guard in (pid for pid, command in with_mark(str(two)).items() if pid != second.pid):
        os.kill(guard, signal.SIGKILL)
    second.kill()
    second.communicate()
    assert two.exists()
    third, three = begun()
    fourth, four = begun()
    assert {folder.exists(), two.exists()} == {False}
    assert {three.exists(), four.exists()} == {True}
    for process in (third, fourth):
        process.communicate()
        assert process.returncode == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_a_stopped_process_only_slows_the_run(evedrop: Evedrop) -> None:
    """A receiver that stands still loses nothing: everybody waits."""
    live = evedrop.live("eavesdroppers", "--slots", "3000", "--json", "--paused")
    live.held()
    assert evedrop("step", str(live.folder), "100").status == 0
    smart, sensor = live.child("smart"), live.child("sensor")
    os.kill(smart, signal.SIGSTOP)  # while the run is held: however slow this test is, no slot has passed since
    with stepping(evedrop, live.folder, 2800):
        stillness = Stillness(sensor)
        wait_until(lambda: stillness.looks >= 20, "a sensor that waits for it")
        slot = evedrop("status", str(live.folder), "--json").summary["slot"]
        os.kill(smart, signal.SIGCONT)
        assert slot < 1800, "the sensor must wait for the receiver, and not at the end of the step"
    assert evedrop("resume", str(live.folder)).status == 0
    done = live.end()
    assert done.status == 0
    assert {link["unexplained"] for link in done.summary["links"].values()} == {0}
    assert all(peer["digest"] for peer in done.summary["peers"].values())


class Stillness:
    """A process as it is looked at: how often in a row it slept, without having computed since the look before."""

    def __init__(self, pid: int) -> None:
        self._stat = Path(f"/proc/{pid}/stat")
        self._before: list[str] = []
        self._looks = 0

    @property
    def looks(self) -> int:
        """So often by now."""
        fields = self._stat.read_text().rpartition(")")[2].split()
        now = [fields[0], *fields[11:13]]
        self._looks = self._looks + 1 if now == self._before and now[0] == "S" else 0
        self._before = now
        return self._looks


@pytest.mark.thorough
def test_a_receiver_that_stops_reading_for_some_seconds_costs_no_other_a_connection(evedrop: Evedrop) -> None:
    """Its queue at the router is full, and its lease expires; nobody else is cut off, and the run goes on when it is back."""
    live = evedrop.live("eavesdroppers", "--slots", "3000", "--trials", "300", "--set", "expect=[]")
    live.running()
    live.kill("smart", signal.SIGSTOP)
    wait_until(
        lambda: not evedrop("status", str(live.folder), "--json").summary["processes"]["smart"],
        "the loss of its connection",
    )
    live.kill("smart", signal.SIGCONT)
    done = live.end()
    assert done.status == 0, done.err
    assert {outage["process"] for outage in live.results.summary["outages"]} == {"smart"}


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "trials"), [("naive", 1), ("naive", 200), ("router", 1)])
def test_a_process_that_stays_stopped_ends_the_run(evedrop: Evedrop, name: str, trials: int) -> None:
    """When its connection is lost and does not come back for as long as the scenario waits, it is named, not its victims.

    With many trials its queue at the router is full at once, and with one trial after the first messages were sent again.
    """
    live = evedrop.live("eavesdroppers", *ENDLESS, "--set", "longest_outage=2", "--trials", str(trials))
    live.running()
    live.kill(name, signal.SIGSTOP)
    done = live.end()
    assert done.status == 3
    # Zenoh only notices that a process is lost while it can send to it: a full socket leaves this to the recorder.
    message = r"( stopped responding: hung, suspended or cut off|: alive, and silent for \d+ s while the run waits)"
    assert re.search(f"^evedrop: {name}{message}", done.err, re.MULTILINE), done.err
    live.nothing_left()
    tables_whole(live)


@pytest.mark.thorough
def test_results_that_cannot_be_written_end_the_run(evedrop: Evedrop) -> None:
    """A full disk, played by a limit on the size of files: one clear line, exit 3, nothing left."""
    live = evedrop.live("eavesdroppers", "--slots", "1000000", "--pace", "0.0005", largest_file=200_000)
    done = live.end()
    assert done.status == 3
    assert "the results cannot be written" in done.err.splitlines()[0]
    live.nothing_left()
    assert "cannot be written" in live.results.summary["ended"]
    assert 0 < live.results.slots.num_rows == live.results.journal.num_rows


@pytest.mark.thorough
def test_nobody_has_what_is_sent_to_others_in_its_memory(evedrop: Evedrop) -> None:
    """Large batches too go to each receiver alone: no process maps memory that it shares with another."""
    live = evedrop.live("eavesdroppers", "--trials", "2000", "--slots", "100000")
    live.running()
    shared = {
        name: [line for line in Path(f"/proc/{pid}/maps").read_text().splitlines() if "shm" in line or ".zenoh" in line]
        for name, pid in live.children().items()
    }
    live.process.terminate()
    live.end()
    assert len(shared) == 7
    assert {name for name, lines in shared.items() if lines} == set()

"""The command line: exit statuses, what is printed, and what is refused before anything is started."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest

from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenarios import shipped
from tests.conftest import Done, Evedrop
from tests.examples import mostly_long

QUICK = ("--slots", "40", "--view", "off")


@contextlib.contextmanager
def taken_port() -> Iterator[int]:
    """A loopback port on which somebody listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield int(listener.getsockname()[1])


def refused(done: Done, message: str = "") -> None:
    """Check a command that was refused: exit 2 and one line."""
    assert done.status == 2
    assert done.out == ""
    (line,) = done.err.splitlines()
    assert line.startswith("evedrop: ")
    assert message in line


def test_a_run_prints_its_results_and_passes(evedrop: Evedrop) -> None:
    """A table with every receiver, the verdict on every eavesdropper, and where the results are."""
    done = evedrop("run", "eavesdroppers", *QUICK, "--out", "here")
    assert (done.status, done.err) == (0, "")
    for words in (
        "legitimate",
        "cannot tell yet  smart",
        "cannot tell yet  naive",
        "suspicious",
        "expected legitimate.mean_squared_error",
        "here",
    ):
        assert words in done.out
    assert done.out.splitlines()[-1] == "report: here/report.html"
    files = {path.name for path in (evedrop.folder / "here").iterdir()}
    assert files == {
        "scenario.toml", "summary.json", "slots.parquet", "trials.parquet", "journal.parquet", "digests.parquet", "logs",
        "report.html",
    }  # fmt: skip


@pytest.mark.thorough
def test_the_closing_report_can_be_printed_again(evedrop: Evedrop) -> None:
    """`view --table` of a live run and of a study prints what they ended with; a broken summary is refused."""
    for words in (("run", "--view", "off"), ("montecarlo", "--trials", "12")):
        done = evedrop(words[0], "eavesdroppers", "--slots", "40", *words[1:], "--out", words[0])
        again = evedrop("view", words[0], "--table")
        assert (again.status, again.err) == (0, "")
        assert again.out == done.out
    summary = evedrop.folder / "run" / "summary.json"
    summary.write_text(summary.read_text().replace('"slots_per_second"', '"other"'))
    refused(evedrop("view", "run", "--table"), "summary.json is not a run summary of this version")


@pytest.mark.thorough
@pytest.mark.parametrize(("command", "below", "status"), [("run", "1e-9", 1), ("montecarlo", "0.01", 0)])
def test_json_is_one_object_and_nothing_else(evedrop: Evedrop, command: str, below: str, status: int) -> None:
    """Standard output is the summary of summary.json; standard error is silent; the status tells of expectations."""
    view = ("--view", "off") if command == "run" else ()
    expected = ("--set", f"expect.0.below={below}")
    done = evedrop(
        command, "eavesdroppers", "--slots", "40", "--trials", "2", *view, *expected, "--json", "--out", "here"
    )
    assert (done.status, done.err) == (status, "")
    assert done.out.count("\n") == 1
    assert done.summary == Results.read(evedrop.folder / "here").summary
    assert done.summary["trials"] == 2
    assert done.summary["expectations"][0]["held"] is (status == 0)


def test_a_failed_expectation_is_exit_1(evedrop: Evedrop) -> None:
    """The study is whole, and what did not hold is printed with what was found."""
    changes = ("--slots", "40", "--trials", "1", "--set", "expect.0.below=1e-9")
    done = evedrop("montecarlo", "eavesdroppers", *changes, "--out", "here")
    assert (done.status, done.err) == (1, "")
    assert "expected legitimate.mean_squared_error below 1e-09: FAILED, found" in done.out
    assert Results.read(evedrop.folder / "here").summary["expectations"][0]["held"] is False


def test_an_unbounded_estimator_is_warned_of_and_run(evedrop: Evedrop) -> None:
    """The warning goes to standard error with bound and value; the run is a run."""
    done = evedrop("montecarlo", "numerical", "--trials", "1", "--set", "legitimate.link.quality=0.2", "--out", "x")
    assert done.status == 0
    assert re.search(r"warning: .*without bound: .*0\.56.*0\.2.*must exceed 2\.4", done.err)


def test_a_taken_port_is_refused(evedrop: Evedrop) -> None:
    """--listen with a port that somebody has: one line, no folder."""
    with taken_port() as port:
        done = evedrop("run", "eavesdroppers", *QUICK, "--listen", f"tcp/127.0.0.1:{port}", "--out", "x")
    refused(done, "Address already in use")
    assert not (evedrop.folder / "x").exists()


def test_a_results_folder_must_be_new_or_empty(evedrop: Evedrop) -> None:
    """A folder with something in it, a file, and a place under a file are refused; an empty folder is taken."""
    (evedrop.folder / "full").mkdir()
    (evedrop.folder / "full" / "file").touch()
    (evedrop.folder / "empty").mkdir()
    montecarlo = ("montecarlo", "eavesdroppers", "--slots", "9", "--trials", "1", "--out")
    refused(evedrop(*montecarlo, "full"))
    refused(evedrop(*montecarlo, "full/file"))
    refused(evedrop(*montecarlo, "full/file/x"))
    assert evedrop(*montecarlo, "empty").status == 0
    assert [path.name for path in (evedrop.folder / "full").iterdir()] == ["file"]


def unwritable(folder: Path) -> str:
    """A folder in which no file can be created: one without permission, or for root one of the kernel's."""
    if os.geteuid() == 0:
        return "/proc"
    (folder / "locked").mkdir(mode=0o500)
    return str(folder / "locked")


def test_without_permission_nothing_is_started(evedrop: Evedrop) -> None:
    """One line that names the folder."""
    where = unwritable(evedrop.folder)
    refused(evedrop("run", "eavesdroppers", *QUICK, "--out", f"{where}/x"), f"{where}/x cannot be written (")


@pytest.mark.thorough
def test_a_folder_that_may_only_be_read_can_be_worked_in(evedrop: Evedrop) -> None:
    """The current folder is written to only where no --out is given, and then the refusal is one line."""
    where = unwritable(evedrop.folder)
    done = evedrop.process("run", "eavesdroppers", *QUICK, "--out", str(evedrop.folder / "x"), cwd=where)
    assert done.status == 0
    refused(evedrop.process("run", "eavesdroppers", *QUICK, cwd=where), "cannot be written (")


@pytest.mark.thorough
def test_two_runs_at_once_do_not_meet(evedrop: Evedrop) -> None:
    """Ports, keys and folders are a run's own."""
    runs = [evedrop.live("eavesdroppers", "--slots", "600", "--seed", str(seed), out=f"run{seed}") for seed in (1, 2)]
    assert [live.end().status for live in runs] == [0, 0]
    for seed, live in zip((1, 2), runs, strict=True):
        alone = evedrop("montecarlo", "eavesdroppers", "--slots", "600", "--trials", "1", "--seed", str(seed), "--json",
                        "--out", f"alone{seed}")  # fmt: skip
        digests = {name: peer["digest"] for name, peer in live.results.summary["peers"].items()}
        assert digests == {name: peer["digest"] for name, peer in alone.summary["peers"].items()}


def test_a_secret_of_its_own_changes_the_schedule_alone(evedrop: Evedrop) -> None:
    """The same file gives the same run; another one other packets of the same process; a short one is refused."""
    for name, secret in (("one", b"1" * 32), ("two", b"2" * 32), ("short", b"3" * 31)):
        (evedrop.folder / name).write_bytes(secret)
    base = ("montecarlo", "eavesdroppers", "--slots", "60", "--trials", "1", "--json", "--out")
    runs = {
        "none": evedrop(*base, "a").summary,
        "one": evedrop(*base, "b", "--secret", "one").summary,
        "one again": evedrop("montecarlo", "b", "--trials", "1", "--json", "--out", "c").summary,
        "two": evedrop(*base, "d", "--secret", "two").summary,
    }
    digests = {name: {peer["digest"] for peer in summary["peers"].values()} for name, summary in runs.items()}
    assert digests["one"] == digests["one again"]
    assert digests["one"].isdisjoint(digests["two"] | digests["none"])
    schedules = {name: Results.read(evedrop.folder / name).trials["sent"].to_pylist() for name in "abd"}
    assert len({tuple(schedule) for schedule in schedules.values()}) == 3
    truths = [Results.read(evedrop.folder / name).trials["x"].to_pylist() for name in "abd"]
    assert truths[0] == truths[1] == truths[2]
    done = evedrop(*base, "e", "--secret", "short")
    assert done.status == 2
    assert "secret_file: " in done.err


def test_a_scenario_names_a_secret_in_its_own_folder(evedrop: Evedrop) -> None:
    """A relative path is seen from the scenario, in a change from the current folder; results run again from anywhere."""
    inner, elsewhere = evedrop.folder / "inner", evedrop.folder / "elsewhere"
    for folder, secret in ((inner, b"1" * 32), (elsewhere, b"2" * 32)):
        folder.mkdir()
        (folder / "secret.bin").write_bytes(secret)
    text = (Path(str(resources.files("evedrop.scenarios"))) / "eavesdroppers.toml").read_text()
    (inner / "mine.toml").write_text(f'secret_file = "secret.bin"\n{text}')
    base = ("montecarlo", "inner/mine.toml", "--slots", "20", "--trials", "1", "--json", "--out")
    first = evedrop(*base, "a").summary
    stored = tomllib.loads((evedrop.folder / "a" / "scenario.toml").read_text())
    assert stored["secret_file"] == str(inner / "secret.bin")
    again = Evedrop(elsewhere)("montecarlo", "../a", "--trials", "1", "--json", "--out", "again").summary
    changed = evedrop(*base, "b", "--set", "secret_file=elsewhere/secret.bin").summary
    digests = [{peer["digest"] for peer in summary["peers"].values()} for summary in (first, again, changed)]
    assert digests[0] == digests[1]
    assert digests[0].isdisjoint(digests[2])


def test_diff_says_where_and_tells_by_its_status(evedrop: Evedrop) -> None:
    """0 for equal runs, 1 for a difference, 2 for a folder that is not a run."""
    base = ("montecarlo", "eavesdroppers", "--slots", "30", "--trials", "1", "--out")
    for name, more in (("a", ()), ("b", ()), ("c", ("--seed", "3"))):
        assert evedrop(*base, name, *more).status == 0
    assert evedrop("diff", "a", "b").status == 0
    different = evedrop("diff", "a", "c")
    assert (different.status, different.err) == (1, "")
    assert different.out.startswith("first difference: slot 0, trial 0, legitimate: ")
    refused(evedrop("diff", "a", "nowhere"))


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(["acknowledged", "heated-room", "late"], id="three"),
        pytest.param(sorted(shipped()), id="all", marks=pytest.mark.long),
    ],
)
def test_check_reports_every_scenario(evedrop: Evedrop, names: list[str]) -> None:
    """All shipped ones are right; a wrong one among right ones is exit 2."""
    done = evedrop("check", *names)
    assert (done.status, done.err) == (0, "")
    assert done.out.count("no mistakes") == len(names)
    done = evedrop("check", "numerical", "nothing", "eavesdroppers")
    assert done.status == 2
    assert done.out.count("no mistakes") == 2
    assert "no scenario nothing" in done.err


def test_list_new_check_and_run_lead_from_nothing_to_a_run(evedrop: Evedrop) -> None:
    """The way of a new user."""
    listed = evedrop("list")
    assert [line.split()[0] for line in listed.out.splitlines()] == sorted(shipped())
    assert evedrop("new", "mine.toml").status == 0
    assert evedrop("check", "mine.toml").status == 0
    assert evedrop("run", "mine.toml", *QUICK).status == 0
    (folder,) = (evedrop.folder / "runs").iterdir()
    assert folder.name.startswith("mine-")
    refused(evedrop("new", "mine.toml"), "mine.toml exists already")


def test_the_selftest_passes(evedrop: Evedrop) -> None:
    """The machine computes the golden digests, and says what it is."""
    done = evedrop("selftest")
    assert (done.status, done.err) == (0, "")
    assert done.out.count("golden") == 4
    assert "numpy" in done.out


def test_a_wrong_golden_digest_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit 3, and the receiver whose digest is not the golden one is marked."""
    from evedrop.cli import main as cli
    from evedrop.cli import selftest

    monkeypatch.setattr(selftest, "GOLDEN", {**selftest.GOLDEN, "smart": "0" * 64})
    assert cli.main(["selftest"]) == 3
    told = capsys.readouterr()
    assert [line.split()[0] for line in told.out.splitlines() if "NOT the golden digest" in line] == ["smart"]
    assert "does not compute the golden digests" in told.err


@pytest.mark.parametrize(
    "arguments",
    [("nonsense",), ("run",), ("run", "numerical", "--slots", "many"), ("run", "numerical", "--view", "sideways")],
)
def test_a_command_line_that_is_none_is_exit_2(evedrop: Evedrop, arguments: tuple[str, ...]) -> None:
    """Argparse says what it expected."""
    done = evedrop(*arguments)
    assert (done.status, done.out) == (2, "")
    assert "try: evedrop" in done.err


def test_a_brief_of_another_role_is_refused(evedrop: Evedrop) -> None:
    """Briefs are written for starting by hand; each fits its own role, and is private."""
    assert evedrop("brief", "numerical", "--out", "briefs").status == 0
    briefs = sorted((evedrop.folder / "briefs").iterdir())
    assert [path.name for path in briefs] == [
        f"{name}.json" for name in sorted({"recorder", "router", "sensor", *load("numerical").receivers})
    ]
    assert {path.stat().st_mode & 0o777 for path in briefs} == {0o600}
    refused(evedrop.process("sensor", "briefs/smart.json"), "is the brief of a eavesdropper; expected one of a sensor")
    refused(evedrop.process("sensor", "briefs/nobody.json"), "No such file")
    (evedrop.folder / "briefs" / "smart.json").chmod(0o644)
    refused(evedrop.process("eavesdropper", "briefs/smart.json"), "readable by others")


def test_a_recorder_that_cannot_write_says_so(evedrop: Evedrop) -> None:
    """Started by hand, with a file where its results should go: one line with the place, exit 2."""
    assert evedrop("brief", "numerical", "--out", "briefs", "--results", "results").status == 0
    (evedrop.folder / "results").touch()
    refused(evedrop.process("recorder", "briefs/recorder.json"), "results is a file; give another folder")


def test_a_reader_that_leaves_does_no_harm(evedrop: Evedrop) -> None:
    """`evedrop list | head -1`: no traceback."""
    with subprocess.Popen(["head", "-c", "1"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as reader:
        done = evedrop.process("list", stdout=reader.stdin)
        assert reader.stdin is not None
        reader.stdin.close()
    assert (done.status, done.err) == (0, "")


def test_an_output_that_cannot_be_written_is_named(evedrop: Evedrop) -> None:
    """A full disk behind standard output: one line that says so, exit 2."""
    with Path("/dev/full").open("w") as full:
        done = evedrop.process("list", stdout=full)
    assert (done.status, done.err.count("\n")) == (2, 1)
    assert done.err.startswith("evedrop: standard output: No space left on device; ")


def test_other_errors_of_the_system_are_not_blamed_on_the_output(
    evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error within a study is reported as it is, exit 3."""
    from evedrop.simulate import finished_tasks

    def fail(_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(finished_tasks, "new_folder", fail)
    done = evedrop("sweep", "eavesdroppers", "--over", "seed=1,2", "--trials", "2", "--slots", "5", "--out", "x")
    assert (done.status, done.out) == (3, "")
    assert done.err == "evedrop: [Errno 37] No locks available; free system resources and try again\n"


@pytest.mark.thorough
@pytest.mark.parametrize("reader", mostly_long(["/dev/full", "gone"], ["gone"]))
def test_an_interrupt_stays_one_for_every_reader(evedrop: Evedrop, reader: str) -> None:
    """Ctrl-C also ends the reader of the pipe; that our closing table cannot be written changes nothing."""
    ends = os.pipe()
    os.close(ends[0])
    with Path("/dev/full").open("w") if reader == "/dev/full" else os.fdopen(ends[1], "w") as output:
        study = ("montecarlo", "eavesdroppers", "--slots", "400000", "--trials", "500", "--workers", "1")
        live = evedrop.started(*study, stdout=output)
        live.running()
        live.process.terminate()
        done = live.end()
    assert done.status == 130
    assert done.err == "evedrop: interrupted; the results so far are in run\n"


def test_a_title_is_text(evedrop: Evedrop) -> None:
    """Brackets in a title or a folder's name are printed as they stand, and break nothing."""
    arguments = ("--slots", "5", "--trials", "2", "--set", "title=[/red] a [bold]title", "--out", "o[bold]x[y]")
    done = evedrop("montecarlo", "eavesdroppers", *arguments)
    assert (done.status, done.err) == (0, "")
    assert "[/red] a [bold]title" in done.out
    assert "o[bold]x[y]" in done.out


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "eavesdroppers", "--set", f"seed={'9' * 5000}"),
        ("check", "eavesdroppers", "--set", f"seed={'[' * 20000}"),
        ("run", "eavesdroppers", "--listen", f"tcp/127.0.0.1:{'1' * 5000}"),
        ("design", "numerical", "--max-trace", "inf"),
        ("check", "/dev/zero"),
    ],
)
def test_absurd_arguments_are_refused(evedrop: Evedrop, arguments: tuple[str, ...]) -> None:
    """Numbers of thousands of digits, lists without end, devices: a message and exit 2, no traceback."""
    done = evedrop(*arguments)
    assert done.status == 2
    assert "Traceback" not in done.err


ENDING = """
import atexit, sys, threading
from evedrop.__main__ import program
atexit.register(lambda: print("callbacks have run"))
if sys.argv.pop() == "thread":
    threading.Thread(target=lambda: [threading.main_thread().join(), print("the thread has ended")]).start()
program()
"""


@pytest.mark.parametrize(("last", "lines"), [("alone", []), ("thread", ["the thread has ended"])])
def test_a_command_leaves_nothing_undone(last: str, lines: list[str]) -> None:
    """It exits without freeing its modules, after its threads have ended and all callbacks have run; its output is complete."""
    words = [sys.executable, "-u", "-c", ENDING, "docs", "--nothing", last]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout.splitlines() == [*lines, "callbacks have run"]

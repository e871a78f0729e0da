"""Scenarios as tests: by `evedrop test` and by pytest, what passes, the messages about the rest, and what CI reads."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from evedrop.cli import main as cli
from evedrop.errors import RunError
from evedrop.results.reading import Results
from evedrop.results.summary_file import write_summary
from evedrop.scenario.loading import load
from evedrop.scenarios import shipped
from evedrop.studies import scenario_tests as testing
from evedrop.studies.junit import junit_of
from evedrop.studies.scenario_tests import Finding, Manner, Outcome
from tests.conftest import Done, Evedrop, Live, wait_until, with_mark
from tests.pages import checked

SCENARIO = (
    shipped()["eavesdroppers"]
    .read_text(encoding="utf-8")
    .partition("[[expect]]")[0]
    .replace("slots = ", "slots = 60 #")
)
HOLDS = SCENARIO + '[[expect]]\nmetric = "legitimate.mean_squared_error"\nbelow = 0.1\n'
ENDLESS = HOLDS.replace("slots = 60", "slots = 1000000").replace("pace = 0.0", "pace = 0.01")
FAILS = HOLDS + '[[expect]]\nmetric = "smart.received_fraction"\nslots = [10, 60]\nabove = 2\n'
WRONG = SCENARIO.replace("slots = ", "sluts = ").replace("seed = ", "seed = -")


def written(folder: Path, **texts: str) -> None:
    """Scenarios in a folder, by name."""
    folder.mkdir(exist_ok=True)
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")


def pytest_in(evedrop: Evedrop, *arguments: str) -> Done:
    """Run pytest with the plugin, found as it is in an environment with it, and with warnings as errors."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "evedrop.cli.pytest_plugin",
        "-W",
        "error",
        "--color=no",
        *arguments,
    ]
    environment = {**evedrop.environment, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=evedrop.folder, env=environment, capture_output=True, text=True, check=False)
    return Done(done.returncode, done.stdout, done.stderr)


def test_a_folder_of_scenarios_is_tested_in_memory(evedrop: Evedrop) -> None:
    """A line each, reasons and the results of what did not pass, a sum; the worst status; a report that says the same."""
    written(evedrop.folder / "cases", fails=FAILS, holds=HOLDS, wrong=WRONG)
    done = evedrop("test", "cases", "--in-memory", "--trials", "3", "--out", "kept", "--junit", "reports/junit.xml")
    assert (done.status, done.err) == (2, "")
    lines = done.out.splitlines()
    assert re.fullmatch(r"FAILED    +\d+\.\d s  cases/fails.toml", lines[0])
    failed = "expected smart.received_fraction over slots 10 to 59 above 2: FAILED, found 0."
    assert lines[1].startswith(f"    {failed}")
    assert lines[1].endswith(f"; see it again: evedrop montecarlo {evedrop.folder}/kept/fails --trials 3")
    assert lines[2:4] == ["    results: kept/fails", "    report: kept/fails/report.html"]
    assert re.fullmatch(r"passed    +\d+\.\d s  cases/holds.toml", lines[4])
    assert re.fullmatch(r"MISTAKES  +\d+\.\d s  cases/wrong.toml", lines[5])
    assert [line.split()[0] for line in lines[6:-2]] == ["slots:", "seed:", "sluts:"]
    assert re.fullmatch(r"1 passed, 1 FAILED, 1 MISTAKES, in \d+\.\d s", lines[-2])
    assert lines[-1] == "report: kept/tests.html"
    assert Results.read(evedrop.folder / "kept" / "holds").summary["trials"] == 3
    assert sorted(path.name for path in (evedrop.folder / "kept").iterdir()) == ["fails", "holds", "tests.html"]

    suites = ET.parse(evedrop.folder / "reports" / "junit.xml").getroot()  # noqa: S314 - our own
    (suite,) = suites
    assert (suites.tag, suite.tag, suite.get("name")) == ("testsuites", "testsuite", "evedrop")
    for element in (suites, suite):
        assert [element.get(count) for count in ("tests", "failures", "errors", "skipped")] == ["3", "1", "1", "0"]
    assert [(case.get("classname"), case.get("name")) for case in suite] == [
        ("cases", "fails"), ("cases", "holds"), ("cases", "wrong"),
    ]  # fmt: skip
    times = [float(str(case.get("time"))) for case in suite]
    assert float(str(suite.get("time"))) == pytest.approx(sum(times), abs=0.01)
    assert [[part.tag for part in case] for case in suite] == [["properties", "failure"], ["properties"], ["error"]]
    properties = {element.get("name"): element.get("value") for element in suite[0][0]}
    seed = str(Results.read(evedrop.folder / "kept/fails").summary["seed"])
    verdict = Results.read(evedrop.folder / "kept/fails").typed_summary.verdict
    assert verdict is not None
    assert properties == {
        "seed": seed, "results": "kept/fails", "report": "kept/fails/report.html", "verdict": verdict.sentence,
    }  # fmt: skip
    assert f"{verdict.sentence}. 1 of 2 expectations FAILED" in checked(evedrop.folder / "kept/fails").texts
    assert str(suite[0][1].get("message")).startswith(failed)
    assert str(suite[2][0].text).splitlines() == [line.strip() for line in lines[6:-2]]


@pytest.mark.long
def test_a_live_test_that_fails_says_how_to_see_it_again(evedrop: Evedrop) -> None:
    """Two at a time, live: one passes, one fails with exit 1, and its command gives the same failure; nothing is left."""
    written(evedrop.folder / "cases", fails=FAILS, holds=HOLDS)
    done = evedrop("test", "cases", "--jobs", "2")
    assert (done.status, done.err) == (1, "")
    assert [line.split()[0] for line in done.out.splitlines() if "cases/" in line and " s " in line] == [
        "FAILED",
        "passed",
    ]
    reason = next(line for line in done.out.splitlines() if "see it again: " in line)
    words = shlex.split(reason.partition("see it again: ")[2])
    assert words[:2] == ["evedrop", "run"]
    again = evedrop(*words[1:], "--view", "off", "--out", "again")
    assert (again.status, again.err) == (1, "")
    assert reason.partition("; ")[0].strip() in [line.strip() for line in again.out.splitlines()]
    left = sorted(path.name.partition("-")[0] for path in (evedrop.folder / "runs").iterdir())
    assert left == ["fails", "holds", "tests.html"]
    assert list(evedrop.temporary.iterdir()) == []


def test_shipped_names_and_losses_for_a_reason_that_did_not_occur(evedrop: Evedrop) -> None:
    """A shipped scenario by its name. A reason that did not occur counts 0."""
    written(evedrop.folder, never=SCENARIO + '[[expect]]\nmetric = "links.smart.lost_by.down"\nbelow = 1\n')
    done = evedrop("test", "stable-mode", "never.toml", "--in-memory", "--trials", "2")
    assert done.status == 0
    assert re.findall(r"^passed .* (\S+)$", done.out, re.MULTILINE) == ["stable-mode", "never.toml"]


def test_where_there_is_no_scenario_there_is_no_test(evedrop: Evedrop) -> None:
    """Exit 2 for a folder without one; a file that was named is tried, and its mistakes told."""
    (evedrop.folder / "pyproject.toml").write_text("[project]\n")
    done = evedrop("test", ".")
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("evedrop: no scenario in .; a scenario is a TOML file with [process]")
    for named in ("pyproject.toml", "nowhere.toml"):
        done = evedrop("test", named)
        assert (done.status, done.err) == (2, "")
        assert done.out.startswith("MISTAKES")
    assert evedrop("test", "vehicle", "--jobs", "0").status == 2


def test_a_run_that_fails_is_neither_passed_nor_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Exit 3, the story in lines, an error in the report; the next scenario is tested all the same."""
    written(tmp_path, one=HOLDS, two=FAILS)

    def launch(*_: object) -> None:
        raise RunError("smart was ended by signal 9\nlogs/smart.log: the last lines")

    monkeypatch.setattr(testing, "launch", launch)
    report = tmp_path / "report.xml"
    assert cli.main(["test", str(tmp_path), "--out", str(tmp_path / "runs"), "--junit", str(report)]) == 3
    told = capsys.readouterr().out.splitlines()
    assert told[1:4] == [
        "    smart was ended by signal 9", "    logs/smart.log: the last lines", f"    results: {tmp_path}/runs/one",
    ]  # fmt: skip
    assert told[-2].startswith("2 BROKEN, in ")
    assert [case[1].get("type") for case in ET.parse(report).getroot()[0]] == ["broken", "broken"]  # noqa: S314 - our own


def test_tests_of_one_name_keep_their_results_apart(tmp_path: Path) -> None:
    """A second run into the same place gets a number, and nothing is overwritten."""
    written(tmp_path, one=HOLDS)
    manner = Manner(in_memory=True, out=tmp_path / "out")
    folders = [testing.carry_out(str(tmp_path / "one.toml"), manner).folder for _ in range(3)]
    assert folders == [tmp_path / "out" / name for name in ("one", "one-2", "one-3")]
    blocked = testing.carry_out(str(tmp_path / "one.toml"), Manner(in_memory=True, out=tmp_path / "one.toml"))
    assert (blocked.outcome, blocked.folder) == (Outcome.MISTAKES, None)
    assert "cannot be written (Not a directory)" in blocked.reasons[0]


def test_a_report_that_cannot_be_written_is_refused_at_the_start(
    evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is run. One that cannot be written at the end does not hide what was found."""
    written(evedrop.folder, one=HOLDS)
    words = ("test", "one.toml", "--in-memory", "--trials", "2", "--out", "out", "--junit")
    done = evedrop(*words, "one.toml/report.xml")
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("evedrop: one.toml/report.xml cannot be written (")
    assert not (evedrop.folder / "out").exists()
    report = evedrop.folder / "late.xml"

    def late(*_: object) -> None:
        report.mkdir()

    monkeypatch.setattr("evedrop.studies.tests_page.write_tests_page", late)
    done = evedrop(*words, "late.xml")
    assert done.status == 2
    assert "1 passed, in " in done.out
    assert "late.xml cannot be written (Is a directory)" in done.err


def test_a_report_holds_what_xml_cannot() -> None:
    """Markup is escaped, and characters that no XML may have are replaced."""
    strange = '<a> & "b" ]]> \x00\x1b[31m \ud800 \U0001f512'
    finding = Finding(f"a{strange}b.toml", Outcome.BROKEN, 1.25, (strange, "second"), 7, Path(f"runs/{strange}"))
    (case,) = ET.fromstring(junit_of([finding], 0.0).decode())[0]  # noqa: S314 - our own
    text = '<a> & "b" ]]> \ufffd\ufffd[31m \ufffd \U0001f512'
    assert case.get("name") == f"a{text}b"
    assert case.get("time") == "1.250"
    assert case[0][1].get("value") == f"runs/{text}"
    assert (case[1].tag, case[1].get("message"), case[1].text) == ("error", text, f"{text}\nsecond")


@pytest.mark.parametrize(
    ("ended", "mode"), [("a metric failed", "exact"), ("interrupted", "exact"), ("complete", "live")]
)
def test_resumed_tests_keep_only_complete_results_in_memory(ended: str, mode: str, tmp_path: Path) -> None:
    """The results of a live run, and of one that failed or did not end, say nothing: the test is run again, beside them."""
    written(tmp_path, one=HOLDS)
    manner = Manner(in_memory=True, changes={"trials": 3}, out=tmp_path / "out", resume=True)
    first = testing.carry_out(str(tmp_path / "one.toml"), manner)
    assert first.folder is not None
    assert testing.carry_out(str(tmp_path / "one.toml"), manner).folder == first.folder
    write_summary(first.folder, replace(Results.read(first.folder).typed_summary, ended=ended, mode=mode))
    again = testing.carry_out(str(tmp_path / "one.toml"), manner)
    assert (again.outcome, again.folder) == (Outcome.PASSED, tmp_path / "out" / "one-2")


def test_resumed_tests_are_run_again_if_a_file_of_the_scenario_has_changed(tmp_path: Path) -> None:
    """The scenario is the same to the letter, but its states are others."""
    process = HOLDS[HOLDS.index("[process]") : HOLDS.index("[encoding]")]
    given = f'{process}states = ["x", "y"]\nsource = "file"\nstate_file = "path.csv"\n'
    written(tmp_path, one=HOLDS.replace(process, given).replace("slots = 60", "slots = 50"))
    manner = Manner(in_memory=True, changes={"trials": 3}, out=tmp_path / "out", resume=True)
    folders = []
    for speed in (0.0, 0.0, 1.0):
        (tmp_path / "path.csv").write_text("x,y\n" + "".join(f"{speed * k},0.0\n" for k in range(60)))
        folders.append(testing.carry_out(str(tmp_path / "one.toml"), manner).folder)
    assert folders == [tmp_path / "out" / name for name in ("one", "one", "one-2")]


def test_resumed_tests_with_a_secret_from_a_file_are_run_again(tmp_path: Path) -> None:
    """The scenario names only the file of the secret, and the results of a complete run do not record the secret."""
    key = tmp_path / "key"
    written(tmp_path, one=HOLDS.replace("[process]", f'secret_file = "{key}"\n\n[process]', 1))
    manner, folders = Manner(in_memory=True, changes={"trials": 3}, out=tmp_path / "out", resume=True), []
    for number in range(2):
        key.write_bytes(bytes([number]) * 32)
        key.chmod(0o600)
        folders.append(testing.carry_out(str(tmp_path / "one.toml"), manner).folder)
    assert folders == [tmp_path / "out" / name for name in ("one", "one-2")]


TALKS = """
import numpy as np
from evedrop.extend import PacketTaker

class Talks(PacketTaker):
    def uses(self, k):
        print("a word")
        return np.full(self.trials, k % 3 == 0)

    @classmethod
    def use_probabilities(cls, parameters):
        return 1 / 3, 1 / 3
"""


def test_what_a_class_prints_does_not_disturb_tests_side_by_side(evedrop: Evedrop) -> None:
    """It goes to standard error."""
    written(evedrop.folder / "cases", a=HOLDS, b=HOLDS.replace('strategy = "naive"', 'strategy = "own:Talks"'))
    (evedrop.folder / "cases" / "own.py").write_text(TALKS)
    done = evedrop.process("test", "cases", "--in-memory", "--trials", "2", "--jobs", "2")
    assert done.status == 0, done
    assert [line.split()[0] for line in done.out.splitlines()[:2]] == ["passed", "passed"]
    assert "a word" in done.err


def test_a_process_without_a_result_is_broken(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the others are carried out."""
    written(evedrop.folder / "cases", a=HOLDS)
    monkeypatch.setattr(testing, "_WORK", "print('half a {')")
    done = evedrop("test", "cases", "--in-memory", "--jobs", "2")
    assert done.status == 3
    assert "its process ended with status 0 and without a result" in done.out


def test_every_scenario_is_changed(evedrop: Evedrop) -> None:
    """By `--set`, also in processes of their own."""
    written(evedrop.folder / "cases", holds=HOLDS, other=HOLDS)
    changes = ("--set", "slots=20", "--set", "title=A 'changed' one", "--trials", "2")
    for jobs in ("1", "2"):
        done = evedrop.process("test", "cases", "--in-memory", *changes, "--jobs", jobs, "--out", f"kept{jobs}")
        assert done.status == 0, done
        for name in ("holds", "other"):
            scenario = load(str(evedrop.folder / f"kept{jobs}" / name))
            assert (scenario.title, scenario.slots, scenario.trials) == ("A 'changed' one", 20, 2)
    wrong = evedrop("test", "cases", "--in-memory", "--set", "sluts=20")
    assert wrong.status == 2
    assert wrong.out.count("sluts: is not an entry of this table; did you mean slots?") == 2


def in_the_second(*words: str, evedrop: Evedrop) -> Live:
    """`evedrop test cases` once its first scenario has passed and a later one is running."""
    process = subprocess.Popen(
        [sys.executable, "-m", "evedrop", "test", "cases", *words],
        cwd=evedrop.folder,
        env=evedrop.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    live = Live(process, evedrop.temporary, evedrop.folder)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("passed")
    live.child("sensor")
    return live


@pytest.mark.thorough
@pytest.mark.parametrize("jobs", [pytest.param("1", marks=pytest.mark.long), "2"])
def test_an_interrupt_ends_the_tests_and_leaves_no_process(evedrop: Evedrop, jobs: str) -> None:
    """Ctrl-C in the middle of a live run: exit 130, a report of what was done, no process and no brief left."""
    written(evedrop.folder / "cases", a=HOLDS, b=ENDLESS)
    live = in_the_second("--jobs", jobs, "--junit", "report.xml", evedrop=evedrop)
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    assert done.status == 130
    assert "interrupted" in done.err
    live.nothing_left()
    (case,) = ET.parse(evedrop.folder / "report.xml").getroot()[0]  # noqa: S314 - our own
    assert case.get("name") == "a"


@pytest.mark.long
def test_an_interrupt_ends_tests_whose_processes_are_suspended(evedrop: Evedrop) -> None:
    """They are continued, so that they end their runs."""
    written(evedrop.folder / "cases", a=HOLDS, b=ENDLESS)
    live = in_the_second("--jobs", "2", evedrop=evedrop)
    jobs = [pid for pid, command in live.left().items() if "scenario_tests import work" in command]
    assert jobs
    for pid in jobs:
        os.kill(pid, signal.SIGSTOP)
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130
    live.nothing_left()


@pytest.mark.long
def test_a_test_whose_process_stays_suspended_is_broken(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """And named; the others are carried out."""
    monkeypatch.setattr("evedrop.system.processes.SUSPENDED_SECONDS", 3.0)
    written(evedrop.folder / "cases", a=ENDLESS, b=HOLDS)
    over = threading.Event()
    suspended: list[int] = []

    def suspend() -> None:
        while not suspended and not over.wait(0.1):
            left = with_mark(str(evedrop.temporary)).items()
            jobs = [pid for pid, command in left if "scenario_tests import work" in command and "a.toml" in command]
            if jobs and any("sensor" in command for _, command in left):
                os.kill(jobs[0], signal.SIGSTOP)
                suspended.append(jobs[0])

    thread = threading.Thread(target=suspend, daemon=True)
    thread.start()
    done = evedrop("test", "cases", "--jobs", "2")
    over.set()
    thread.join()
    assert suspended
    assert done.status == 3
    assert "its process was suspended for " in done.out + done.err
    wait_until(lambda: not with_mark(str(evedrop.temporary)), "no process left")


@pytest.mark.long
def test_tests_end_with_the_process_that_started_them(evedrop: Evedrop) -> None:
    """Kill -9 of `evedrop test` while two run: their processes end too."""
    written(evedrop.folder / "cases", a=ENDLESS, b=HOLDS)
    process = subprocess.Popen(
        [sys.executable, "-m", "evedrop", "test", "cases", "--jobs", "2"],
        cwd=evedrop.folder,
        env=evedrop.environment,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    live = Live(process, evedrop.temporary, evedrop.folder)
    live.child("sensor")
    process.kill()
    process.wait()
    wait_until(lambda: not live.left(), "no process left")


@pytest.mark.thorough
def test_pytest_collects_scenarios_as_tests(evedrop: Evedrop) -> None:
    """One test a file; files that are not scenarios are left alone; failures say found, wanted and command, and no traceback."""
    written(evedrop.folder, fails=FAILS, holds=HOLDS, wrong=WRONG, _not=HOLDS)
    (evedrop.folder / "pyproject.toml").write_text("[project]\n")
    done = pytest_in(
        evedrop, ".", "--evedrop-in-memory", "--evedrop-trials", "3", "--evedrop-out", "kept", "--junitxml", "r.xml"
    )
    assert done.status == 1
    assert "1 passed" in done.out
    assert "2 failed" in done.out
    assert "Traceback" not in done.out + done.err
    assert "emulator/" not in done.out.replace("emulator/evedrop/cli/pytest_plugin", "")
    kept = evedrop.folder / "kept" / "fails"
    failed = next(line for line in done.out.splitlines() if line.startswith("expected smart.received_fraction"))
    assert "over slots 10 to 59 above 2: FAILED, found 0." in failed
    assert failed.endswith(f"see it again: evedrop montecarlo {kept} --trials 3")
    assert "results: kept/fails" in done.out
    assert "sluts: is not an entry of this table; did you mean slots?" in done.out
    assert Results.read(kept).summary["mode"] == "exact"
    for text in ('name="evedrop_results" value="kept/holds"', 'name="evedrop_report" value="kept/holds/report.html"'):
        assert text in (evedrop.folder / "r.xml").read_text()


@pytest.mark.long
def test_pytest_runs_a_named_scenario_live(evedrop: Evedrop) -> None:
    """Without options: live, with the trials of the file, results below runs/."""
    written(evedrop.folder, holds=HOLDS.replace("slots = 60", "trials = 2\nslots = 60"))
    began = time.time()
    done = pytest_in(evedrop, "holds.toml", "-q")
    assert done.status == 0, done.out
    (folder,) = (evedrop.folder / "runs").iterdir()
    summary = Results.read(folder).summary
    assert (summary["mode"], summary["trials"]) == ("live", 2)
    assert folder.stat().st_mtime >= began - 1
    done = pytest_in(evedrop, "--collect-only", "-q")
    assert "holds.toml::holds" in done.out
    assert "1 test collected" in done.out

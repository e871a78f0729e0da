"""A study that is interrupted or killed goes on where it stopped, and ends with the files of an uninterrupted one."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shlex
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from evedrop.cli.api import montecarlo
from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.results.reading import Results
from evedrop.results.shard_score import packed, unpacked
from evedrop.scenario.loading import load
from evedrop.simulate import finished_tasks
from evedrop.simulate.finished_tasks import FinishedTasks, study_of
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import tasks_of
from evedrop.system.signals import stop_on_signals
from tests.conftest import LIMIT, Evedrop
from tests.examples import mostly_long
from tests.pages import checked

STUDY = (
    *("montecarlo", "eavesdroppers", "--trials", "4700", "--slots", "8"),
    *("--record-trials", "2100", "--workers", "1", "--set", "expect=[]"),
)
"""Three tasks."""
SMALL: dict[str, Any] = {"trials": 20, "slots": 20}
_TIMES = re.compile(
    r'"(wall_seconds|slots_per_second)": [^,\n]*|[0-9,]+ trial-slots/s|<td>[0-9.]+ s</td>|[0-9-]+ [0-9:]+ UTC'
)


def files(folder: Path, name: str = "") -> dict[str, bytes | str]:
    """The files of a results folder; texts without times and without where it is.

    name: of the folder, by default its last two parts.
    """
    contents: dict[str, bytes | str] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix in {".json", ".html", ".toml"}:
            text = _TIMES.sub("", path.read_text())
            text = text.replace(name or f"{folder.parent.name}/{folder.name}", "FOLDER")
            contents[str(path.relative_to(folder))] = text.replace(str(folder.parents[1]), "ROOT")
        elif path.is_file():
            contents[str(path.relative_to(folder))] = path.read_bytes()
    return contents


def interrupted_after(monkeypatch: pytest.MonkeyPatch, tasks: int) -> None:
    """Press Ctrl-C when so many tasks are kept."""
    keep: Callable[..., None] = FinishedTasks.keep
    stops: list[threading.Event] = []

    @contextlib.contextmanager
    def told() -> Iterator[threading.Event]:
        with stop_on_signals() as stop:
            stops.append(stop)
            yield stop

    def then(finished: FinishedTasks, *given: Any) -> None:
        keep(finished, *given)
        if finished.count == tasks:
            os.kill(os.getpid(), signal.SIGINT)
            assert stops[-1].wait(LIMIT)

    monkeypatch.setattr(FinishedTasks, "keep", then)
    for module in ("simulate.montecarlo", "studies.sweep", "studies.compare", "studies.parts"):
        monkeypatch.setattr(f"evedrop.{module}.stop_on_signals", told)


Whole = Callable[[tuple[str, ...]], dict[str, bytes | str]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """The files of a study that nothing interrupted, by the words of its command; each is run once for all tests."""

    @cache
    def made(study: tuple[str, ...]) -> dict[str, bytes | str]:
        folder = tmp_path_factory.mktemp("study")
        assert Evedrop(folder)(*study, "--out", "whole/run").status == 0
        return files(folder / "whole/run")

    return made


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the study `cut/run`, which was interrupted when one task was kept."""
    folder = tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patched:
        interrupted_after(patched, 1)
        assert Evedrop(folder)(*STUDY, "--out", "cut/run").status == 130
    return folder


@pytest.fixture
def cut(interrupted: Path, evedrop: Evedrop) -> Path:
    """A copy of the folder of a study that was interrupted when one task was kept."""
    return Path(shutil.copytree(interrupted / "cut/run", evedrop.folder / "cut/run"))


def task_files(folder: Path) -> list[Path]:
    """The files of kept tasks."""
    return sorted(path for path in (folder / "finished_tasks").glob("*") if path.suffix != ".json")


MODES = {"exact": (), "cov": ("--covariance-only",), "err": ("--error-coordinates",)}


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "workers"), mostly_long(itertools.product(MODES, "12"), [("exact", "2")]))
def test_an_interrupted_study_ends_like_a_whole_one(
    name: str, workers: str, evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch, whole: Whole
) -> None:
    """Every file is the same to the byte but for times, with another number of workers too, and nothing is left of the parts."""
    mode = MODES[name]
    study = (*STUDY, "--record-trials", "1", *mode) if mode else STUDY
    with monkeypatch.context() as patched:
        interrupted_after(patched, 1)
        done = evedrop(*study, "--out", "cut/run")
    assert done.status == 130
    assert Results.read(evedrop.folder / "cut/run").summary["ended"] == "interrupted"
    assert len(task_files(evedrop.folder / "cut/run")) == 1
    (command,) = (line for line in done.err.splitlines() if "go on with: " in line)
    words = shlex.split(command.partition("go on with: ")[2])
    assert words == ["evedrop", *study, "--out", "cut/run", "--resume"]
    assert evedrop(*words[1:], "--workers", workers).status == 0
    assert files(evedrop.folder / "cut/run") == whole(study)


KILLED = """
import os, signal, sys
from evedrop.cli.main import main
from evedrop.simulate.finished_tasks import FinishedTasks, study_of
keep = FinishedTasks.keep
def then(finished, *given):
    keep(finished, *given)
    os.kill(os.getpid(), signal.SIGKILL)
FinishedTasks.keep = then
main(sys.argv[1:])
"""
"""A command that is killed when the first task is kept."""


@pytest.mark.thorough
def test_a_killed_study_goes_on(evedrop: Evedrop, whole: Whole) -> None:
    """After kill -9, which leaves no summary, the study goes on from the tasks that were finished."""
    live = evedrop.start(["-c", KILLED], (*STUDY, "--out", "cut/run"), {})
    assert (live.wait(LIMIT), live.communicate()[1]) == (-signal.SIGKILL, "")
    folder = evedrop.folder / "cut/run"
    assert len(task_files(folder)) == 1
    assert not (folder / "summary.json").exists()
    assert evedrop(*STUDY, "--out", "cut/run", "--resume").status == 0
    assert files(folder) == whole(STUDY)


def test_only_what_is_missing_is_computed(cut: Path, evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trials of the kept task are not simulated again; the time of both parts is that of the study."""
    simulated: list[range] = []
    carry_out = tasks_of(load("eavesdroppers"), Mode.EXACT, 1)[0].__class__.carry_out

    def told(task: Any, *given: Any) -> Any:
        simulated.append(range(task.start, task.stop))
        return carry_out(task, *given)

    monkeypatch.setattr("evedrop.simulate.trials.TrialsTask.carry_out", told)
    (file,) = task_files(cut)
    start, stop = map(int, file.name.split("-")[1:])
    before = json.loads((cut / "finished_tasks" / "seconds.json").read_text())
    assert evedrop(*STUDY, "--out", "cut/run", "--resume").status == 0
    assert start == 0
    assert simulated[0].start == stop
    assert sum(map(len, simulated)) == 4700 - stop
    assert Results.read(cut).summary["wall_seconds"] > before > 0


def flip(path: Path) -> None:
    """Change one bit in the middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def cut_short(path: Path) -> None:
    """Keep the first half, as a power failure may."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def earlier(path: Path) -> None:
    """Make it a file in the first format, intact."""
    magic = finished_tasks._MAGIC
    path.write_bytes(path.read_bytes().replace(magic, b"evedrop finished task 1\n", 1))


def renamed(path: Path) -> None:
    """Give it the name of other trials."""
    path.rename(path.with_name(path.name.replace("-0-", "-2000-").replace("-2000-2000", "-2000-4000")))


@pytest.mark.parametrize("damage", [flip, cut_short, earlier, renamed])
def test_a_damaged_part_is_not_used(damage: Callable[[Path], None], cut: Path, evedrop: Evedrop, whole: Whole) -> None:
    """Its trials are computed again, which a line on standard error says."""
    damage(task_files(cut)[0])
    done = evedrop(*STUDY, "--out", "cut/run", "--resume")
    assert done.status == 0
    assert "is damaged; its trials are computed again" in done.err
    assert files(cut) == whole(STUDY)


@pytest.mark.thorough
def test_a_part_of_another_study_is_not_used(cut: Path, evedrop: Evedrop, whole: Whole) -> None:
    """A file with the right name from a study with another seed is as good as damaged."""
    other = evedrop.folder / "other/run"
    with pytest.MonkeyPatch.context() as patched:
        interrupted_after(patched, 1)
        assert evedrop(*STUDY, "--seed", "5", "--out", "other/run").status == 130
    task_files(cut)[0].write_bytes(task_files(other)[0].read_bytes())
    assert "is damaged" in evedrop(*STUDY, "--out", "cut/run", "--resume").err
    assert files(cut) == whole(STUDY)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--seed", "7"), "seed is 11 there and 7 here"),
        (("--trials", "5000"), "trials is 4700 there and 5000 here"),
        (("--rare",), "rare is false there and true here"),
        (("--set", "eavesdroppers.smart.link.quality=0.5"), "quality is"),
    ],
)
def test_another_study_is_refused(more: tuple[str, ...], message: str, cut: Path, evedrop: Evedrop) -> None:
    """The message names the difference; the folder stays as it was."""
    before = files(cut)
    done = evedrop(*STUDY, *more, "--out", "cut/run", "--resume")
    assert (done.status, "cut/run has another study: " in done.err, message in done.err) == (2, True, True), done.err
    assert files(cut) == before


def test_a_secret_of_another_content_is_another_study(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The path of the file says nothing: its content does."""
    secret = evedrop.folder / "secret"
    secret.write_bytes(bytes(range(32)))
    secret.chmod(0o600)
    with monkeypatch.context() as patched:
        interrupted_after(patched, 1)
        assert evedrop(*STUDY, "--secret", "secret", "--out", "cut/run").status == 130
    secret.write_bytes(bytes(range(1, 33)))
    done = evedrop(*STUDY, "--secret", "secret", "--out", "cut/run", "--resume")
    assert (done.status, "secrets is " in done.err) == (2, True), done.err


def test_a_new_folder_is_that_of_a_study_that_has_not_begun(evedrop: Evedrop) -> None:
    """A script may always give --resume; a complete study is refused, and so is --resume without a folder."""
    short = ("montecarlo", "eavesdroppers", "--trials", "2", "--slots", "5")
    assert evedrop(*short, "--out", "new", "--resume").status == 0
    again = evedrop(*short, "--out", "new", "--resume")
    assert (again.status, "has no interrupted study" in again.err) == (2, True), again.err
    alone = evedrop(*short, "--resume")
    assert (alone.status, "give the folder with --out DIR" in alone.err) == (2, True), alone.err


def test_two_cannot_resume_at_once(cut: Path, evedrop: Evedrop) -> None:
    """While one process goes on with a study, another is refused, and changes nothing."""
    before = files(cut)
    study = json.loads((cut / "finished_tasks" / "study.json").read_text())
    with finished_tasks.finished_tasks(cut, study, resume=True):
        files_then = files(cut)
        done = evedrop(*STUDY, "--out", "cut/run", "--resume")
        assert files(cut) == files_then
    assert (done.status, "study in progress" in done.err) == (2, True), done.err
    assert before.keys() - files_then.keys() == {"digests.parquet", "journal.parquet", "report.html", "slots.parquet",
                                                 "summary.json", "trials.parquet"}  # fmt: skip


def test_python_resumes_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`resume=True` with the folder; the error of the interruption says so."""
    case: dict[str, Any] = {"trials": 2600, "slots": 20, "plan": Plan(workers=1)}
    montecarlo("eavesdroppers", out=tmp_path / "whole/run", **case)
    with monkeypatch.context() as patched:
        interrupted_after(patched, 1)
        with pytest.raises(Interrupted) as error:
            montecarlo("eavesdroppers", out=tmp_path / "cut/run", **case)
    assert "resume=True goes on where it stopped" in error.value.__notes__[0]
    montecarlo("eavesdroppers", out=tmp_path / "cut/run", resume=True, **case)
    whole, cut = files(tmp_path / "whole/run"), files(tmp_path / "cut/run")
    assert cut == whole
    with pytest.raises(UsageError, match="give the folder as out"):
        montecarlo("eavesdroppers", resume=True, **case)


@pytest.mark.parametrize("trials", [501, 1])
def test_a_block_of_a_single_trial_can_be_read_again(trials: int) -> None:
    """The last block of a study, or the only one."""
    (task,) = tasks_of(load("eavesdroppers", {"trials": trials, "slots": 10}), Mode.EXACT, 1)
    result = packed(task.carry_out(lambda _: None, lambda: False))
    assert packed(unpacked(result, task.example())) == result


def interrupted_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Press Ctrl-C before any slot."""

    @contextlib.contextmanager
    def told() -> Iterator[threading.Event]:
        stop = threading.Event()
        stop.set()
        yield stop

    monkeypatch.setattr("evedrop.simulate.montecarlo.stop_on_signals", told)


@pytest.mark.parametrize("there", [True, False])
def test_a_study_that_keeps_nothing_leaves_its_folder_as_it_was(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that was there stays, which may be the current one."""
    monkeypatch.chdir(tmp_path)
    interrupted_at_once(monkeypatch)
    with pytest.raises(Interrupted, match="nothing was kept"):
        montecarlo("eavesdroppers", out="." if there else "run", trials=20, slots=20, plan=Plan(workers=1))
    assert [*tmp_path.iterdir()] == []


def test_a_resumed_study_that_keeps_nothing_leaves_what_was_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of the user, and what the study needs to go on, are still there."""
    study = study_of("montecarlo", {"mode": "exact", "rare": False}, [load("eavesdroppers", SMALL)])
    with finished_tasks.finished_tasks(tmp_path / "run", study, resume=False):
        pass
    (tmp_path / "run" / "notes.txt").write_text("mine")
    with monkeypatch.context() as patched:
        interrupted_at_once(patched)
        with pytest.raises(Interrupted, match="nothing was kept"):
            montecarlo("eavesdroppers", out=tmp_path / "run", resume=True, plan=Plan(workers=1), **SMALL)
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"
    montecarlo("eavesdroppers", out=tmp_path / "run", resume=True, plan=Plan(workers=1), **SMALL)
    assert (tmp_path / "run" / "summary.json").exists()


def test_a_folder_that_is_removed_ends_the_study_with_its_own_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with the traceback of an attempt to name it."""
    keep: Callable[..., None] = FinishedTasks.keep

    def then(finished: FinishedTasks, *given: Any) -> None:
        keep(finished, *given)
        shutil.rmtree(tmp_path / "run", ignore_errors=True)

    monkeypatch.setattr(FinishedTasks, "keep", then)
    with pytest.raises(RunError, match="was removed while the run went on"):
        montecarlo("eavesdroppers", out=tmp_path / "run", plan=Plan(workers=1), trials=4700, slots=8)


def test_a_class_of_any_scenario_is_part_of_the_study(tmp_path: Path) -> None:
    """Results of another version of it must not be mixed with those of this one."""
    plain = load("eavesdroppers", SMALL)
    own = plain.eavesdroppers["smart"].model_copy(update={"strategy": "a_module_of_mine:Mine"})
    other = plain.model_copy(update={"modules": str(tmp_path), "eavesdroppers": {"smart": own}})
    studies = []
    for text in ("class Mine: pass\n", "class Mine: x = 1\n"):
        (tmp_path / "a_module_of_mine.py").write_text(text)
        studies.append(study_of("sweep", {}, [plain, other]))
    assert studies[0] != studies[1]


@pytest.mark.thorough
def test_order_of_recorded_rows_does_not_depend_on_the_tasks(tmp_path: Path) -> None:
    """With more recorded trials than a block has, the tables are the same for any number of workers."""
    case: dict[str, Any] = {"trials": 1100, "slots": 4, "record_trials": 1100}
    single, two = (
        montecarlo("eavesdroppers", workers=workers, out=tmp_path / str(workers), **case) for workers in (1, 2)
    )
    assert single.trials.equals(two.trials)


STUDIES = {
    "sweep": (
        *("sweep", "eavesdroppers", "--over", "encoding.state_probability=0.3,0.5,0.7", "--slots", "8"),
        *("--trials", "600", "--workers", "1", "--set", "expect=[]"),
    ),
    "compare": (
        *("compare", "eavesdroppers", "--schemes", "plain,innovation,withholding", "--adversaries", "naive,smart"),
        *("--trials", "60", "--slots", "20", "--workers", "1", "--set", "expect=[]"),
    ),
    "learned": (*("learned", "learning", "--trials", "220", "--slots", "8", "--workers", "1", "--set", "expect=[]"),),
    "cost": ("cost", "microgrid", "--trials", "120", "--slots", "4", "--workers", "1", "--set", "expect=[]"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("tasks", mostly_long([1, 2], [2]))
@pytest.mark.parametrize("name", STUDIES)
def test_other_studies_go_on_too(
    name: str, tasks: int, evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch, whole: Whole
) -> None:
    """Interrupted after one and after two tasks; tables and pictures are the same too."""
    study = STUDIES[name]
    with monkeypatch.context() as patched:
        interrupted_after(patched, tasks)
        done = evedrop(*study, "--out", "cut/run")
    assert done.status == 130
    assert f"go on with: evedrop {name} " in done.err
    assert evedrop(*study, "--out", "cut/run", "--resume", "--workers", "2").status == 0
    cut, uninterrupted = (
        {path: data for path, data in every.items() if not path.endswith(".pdf")}
        for every in (files(evedrop.folder / "cut/run"), whole(study))
    )
    assert cut == uninterrupted


@pytest.mark.parametrize(("name", "of"), [("sweep", "points"), ("compare", "schemes")])
def test_a_part_of_a_study_says_so(name: str, of: str, evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """On its page, and when it is exported; the whole has no such words."""
    with monkeypatch.context() as patched:
        interrupted_after(patched, 2)
        assert evedrop(*STUDIES[name], "--out", "cut/run").status == 130
    part = f"2 of 3 {of} were done"
    for file in ("some.csv", "some.tex", "some.png"):
        assert evedrop("export", "cut/run", file).out.endswith(f"\ncut/run: {part}\n")
    assert evedrop("report", "cut/run").status == 0
    assert part in " ".join(checked(evedrop.folder / "cut/run").texts)
    assert evedrop(*STUDIES[name], "--out", "cut/run", "--resume").status == 0
    assert evedrop("export", "cut/run", "all.tex").out == "all.tex\n"
    assert "were done" not in " ".join(checked(evedrop.folder / "cut/run").texts).replace(f"All 3 {of} were done", "")


@pytest.mark.usefixtures("cut")
def test_what_is_exported_of_some_trials_says_so(evedrop: Evedrop) -> None:
    """As the other commands that read an interrupted study do."""
    assert evedrop("export", "cut/run", "some.csv").out == "some.csv\ncut/run: interrupted\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("sweep", ("--over", "seed=1,2"), "over.seed is missing there and [1, 2] here"),
        ("sweep", ("--covariance-only",), "mode is "),
        ("compare", ("--with", "innovation.state_probability=0.9"), "a scenario differs"),
    ],
)
def test_another_sweep_or_comparison_is_refused(
    name: str, more: tuple[str, ...], message: str, evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message names the difference."""
    with monkeypatch.context() as patched:
        interrupted_after(patched, 1)
        assert evedrop(*STUDIES[name], "--out", "cut/run").status == 130
    done = evedrop(*STUDIES[name], *more, "--out", "cut/run", "--resume")
    assert (done.status, "has another study: " in done.err, message in done.err) == (2, True, True), done.err


@pytest.mark.long
def test_tests_go_on_too(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two scenarios that are tested in memory, one has ended when the other is interrupted: it is not run again."""
    text = evedrop("show", "eavesdroppers").out.replace("slots = 5000", "slots = 30")
    for name in ("first", "second"):
        (evedrop.folder / f"{name}.toml").write_text(text.replace("seed = 11", f"seed = {len(name)}"))
    manner = ("--in-memory", "--trials", "4700")
    both = ("test", "first.toml", "second.toml", *manner)
    whole = evedrop(*both, "--out", "whole/run")
    evedrop("test", "first.toml", *manner, "--out", "cut/run")
    with monkeypatch.context() as patched:
        interrupted_after(patched, 1)
        done = evedrop("test", "second.toml", *manner, "--out", "cut/run")
    assert done.status == 130
    assert "go on with: evedrop test second.toml --in-memory --trials 4700 --out cut/run --resume" in done.err
    before = (evedrop.folder / "cut/run/first/summary.json").read_bytes()
    assert evedrop(*both, "--out", "cut/run", "--resume").status == whole.status
    assert (evedrop.folder / "cut/run/first/summary.json").read_bytes() == before
    for name in ("first", "second"):
        ours, theirs = (files(evedrop.folder / place / "run" / name, f"{place}/run") for place in ("cut", "whole"))
        assert ours == theirs
    refused = evedrop("test", "first.toml", "--out", "cut/run", "--resume")
    assert (refused.status, "add --in-memory" in refused.err) == (2, True)

"""The functions of the Python API: where results are, what they contain, and how progress is reported."""

from __future__ import annotations

import errno
import fcntl
import gc
import json
import math
import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import numpy as np
import pyarrow as pa
import pytest

from evedrop import Scenario, compare, load_results, montecarlo, run, sweep
from evedrop.cli.api import RunResults
from evedrop.cli.api.running import results_of
from evedrop.cli.main import parser_of
from evedrop.cli.options import changes_of
from evedrop.errors import EvedropError, Gap, MissingProcesses, RunError, ScenarioError, TraceError, UsageError
from evedrop.model.metrics import all_metrics
from evedrop.results.reading import ByName
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import OnEvent, ProgressEvent, RunProgress, ViewOpened
from evedrop.score.summary import PeerSummary
from evedrop.show.report import closing
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from evedrop.studies.sweep import grid_of
from tests.builders import GOOD, digests_of
from tests.conftest import LIMIT
from tests.examples import mostly_long
from tests.pages import checked

SMALL = Scenario(GOOD).replace(slots=12)


@pytest.fixture(scope="module")
def results() -> RunResults:
    """A small study without a folder of its own."""
    return montecarlo(SMALL.replace(title="<Small> & quick"), trials=4)


def test_results_without_out_live_as_long_as_their_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without `out`, results are in a private temporary folder, not in the current one."""
    monkeypatch.chdir(tmp_path)
    result = montecarlo(SMALL, trials=2)
    folder = result.folder
    assert (folder.stat().st_mode & 0o777, [*tmp_path.iterdir()]) == (0o700, [])
    assert result.slots.num_rows == 24
    del result
    gc.collect()
    assert not folder.exists()


def test_a_program_may_import_the_scenario_alone() -> None:
    """Without a function that would import what checks a scenario."""
    code = "from evedrop import Scenario; print(Scenario.load('vehicle').slots)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "3000\n"


@pytest.mark.thorough
def test_a_live_run_has_the_digests_of_memory_and_leaves_nothing_behind(tmp_path: Path) -> None:
    """Without `out`, in a program of its own that keeps its results until it exits."""
    (tmp_path / "s.toml").write_text(SMALL.to_toml())
    code = (
        "from evedrop import Scenario, run; kept = run(Scenario.load('s.toml')); import json; "
        "print(json.dumps([str(kept.folder), kept.folder.exists(), {n: p.digest for n, p in kept.peers.items()}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    folder, existed, digests = json.loads(done.stdout)
    assert existed
    assert not Path(folder).exists()
    assert [path.name for path in tmp_path.iterdir()] == ["s.toml"]
    assert digests == digests_of(montecarlo(SMALL, trials=1))


def test_out_that_is_in_use_is_only_replaced_when_asked(tmp_path: Path) -> None:
    """`overwrite` leaves none of the earlier results; the scenario is checked first."""
    out = tmp_path / "out"
    first = montecarlo(SMALL, trials=2, out=out)
    (out / "extra.txt").write_text("mine")
    for call in (montecarlo, run, compare):
        with pytest.raises(UsageError, match=r"out is not empty; give another out, or overwrite=True"):
            call(SMALL, out=out)
    with pytest.raises(ScenarioError):
        montecarlo(SMALL, trials=2, out=out, overwrite=True, slots=0)
    assert load_results(out).summary == first.summary
    again = montecarlo(out, trials=3, out=out, overwrite=True)
    assert (again.typed_summary.trials, (out / "extra.txt").exists()) == (3, False)


def test_overwrite_never_removes_what_is_not_results(tmp_path: Path) -> None:
    """Nor are results overwritten that a run still writes."""
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match="is not a results folder, and overwrite=True replaces only those"):
        montecarlo(SMALL, out=tmp_path, overwrite=True)
    assert (tmp_path / "thesis.tex").exists()
    going = tmp_path / "going"
    (going / "unfinished").mkdir(parents=True)
    held = os.open(going / "unfinished", os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(UsageError, match="belongs to a run in progress"):
        montecarlo(SMALL, out=going, overwrite=True)
    os.close(held)


@pytest.fixture
def at_exit(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is to be done when this program ends; it is not done."""
    calls: list[Any] = []
    monkeypatch.setattr("evedrop.cli.api.running.atexit.register", lambda *given, **_: calls.append(given))
    return calls


def failed(error: BaseException, *files: str) -> tuple[Path, list[str]]:
    """A call that fails after it has written these files: its folder, and the notes of the error."""
    folders: list[Path] = []

    def study(folder: Path, _: OnEvent) -> RunResults:
        folders.append(folder)
        for name in files:
            (folder / name).write_text("{}")
        raise error

    with pytest.raises(type(error)):
        results_of(study, None, False, None, 0)
    return folders[0], getattr(error, "__notes__", [])


def test_results_so_far_of_a_failed_call_stay_until_the_program_ends(at_exit: list[Any]) -> None:
    """The error says where the results so far are; an empty folder is removed."""
    folder, message = failed(RunError("a process died"), "summary.json")
    assert (folder.exists(), message) == (
        True,
        [f"Until this program ends, load_results('{folder}') reads the results so far."],
    )
    assert at_exit == [(shutil.rmtree, folder)]
    shutil.rmtree(folder)
    for error in (RunError("at once"), KeyboardInterrupt()):
        folder, message = failed(error)
        assert (folder.exists(), message) == (False, [])


def test_metrics_are_attributes_with_types(results: RunResults) -> None:
    """Every built-in metric, with the number of the summary; an editor knows their names."""
    assert list(results.peers) == ["legitimate", "smart"]
    for name, entry in results.summary["peers"].items():
        peer = results.peers[name]
        assert isinstance(peer, PeerSummary)
        assert peer.mean_squared_error == entry["mean_squared_error"] > 0.0
        for metric in all_metrics():
            assert getattr(peer, metric) == peer.metric(metric)
    written = {name for name, member in vars(PeerSummary).items() if isinstance(member, property)}
    assert written - {"all_metrics"} == set(all_metrics())
    assert results.links["smart"].offered == 48
    assert results.secrecy["smart"].sentence
    assert results.expectations == []


def test_results_are_short_when_printed_and_a_table_in_a_notebook(results: RunResults) -> None:
    """Texts of the scenario are escaped."""
    verdict, facts = " ".join(repr(results).split()).split(" RunResults of ")
    assert results.verdict is not None
    assert verdict == results.verdict.sentence
    assert facts.startswith("'<Small> & quick': 12 slots, 4 trials, in memory (exact); mean error: legitimate 0.")
    assert max(map(len, repr(results).splitlines())) <= 100
    html = results._repr_html_()
    assert html.startswith(f"<div><h3>{results.verdict.sentence}</h3>")
    assert "&lt;Small&gt; &amp; quick" in html
    assert "<Small>" not in html
    assert html.count("<tr>") == 3
    for sentence in closing.details(results.typed_summary):
        assert sentence.split(";")[0] in html


def test_a_table_in_a_notebook_has_the_cautions_of_the_terminal(results: RunResults) -> None:
    """An incomplete run says so first; a mean that rare events carry is doubted."""
    rare = {"fraction": 0.5, "trials": 1e6}
    changed = json.loads(json.dumps(results.summary))
    changed["ended"] = "a process died"
    changed["peers"]["smart"]["rare_events"] = rare
    html = RunResults(results.folder, changed)._repr_html_()
    assert f"{results.folder}: a process died" in html
    assert (
        "smart: 50 % of its expected error is carried by events that are expected fewer than 20 times in 4 trials"
        in html
    )


def test_an_unknown_name_is_named_with_the_known_ones(results: RunResults) -> None:
    """The error is a KeyError, and its text is a sentence without quotes around it."""
    with pytest.raises(KeyError) as caught:
        results.peers["antena"]
    assert str(caught.value) == "there is no receiver 'antena'; expected one of legitimate, smart"
    with pytest.raises(KeyError, match=r"there is no verdict on 'legitimate'; expected one of smart"):
        results.secrecy["legitimate"]
    with pytest.raises(KeyError, match="there is no link 'smrt'"):
        results.links["smrt"]
    assert results.peers.get("antena") is None
    with pytest.raises(KeyError, match=r"^there is no verdict on 'smart'; these results have none$"):
        ByName("verdict on", {})["smart"]
    copy = pickle.loads(pickle.dumps(caught.value))  # noqa: S301 - as it comes from another process
    assert (type(copy), str(copy)) == (type(caught.value), str(caught.value))


@pytest.mark.thorough
def test_workers_change_no_digest() -> None:
    """As with the option of the command; 0 is refused."""
    tiny = SMALL.replace(slots=2, eavesdroppers=None)
    assert digests_of(montecarlo(tiny, trials=501, workers=2)) == digests_of(montecarlo(tiny, trials=501, workers=1))
    with pytest.raises(UsageError, match="workers=0: expected 1 or more"):
        montecarlo(tiny, workers=0)


@pytest.mark.parametrize("given", [{"rare": "no"}, {"patience": "x"}, {"patience": 0}, {"patience": math.nan}])
def test_a_plan_of_another_type_is_refused(given: dict[str, Any]) -> None:
    """By the name of the argument."""
    with pytest.raises(UsageError, match=f"{next(iter(given))}=.*: expected "):
        Plan(**given)


def test_errors_alone_can_be_followed_for_any_number_of_slots() -> None:
    """States grow beyond double precision; the mode that does not follow them takes the scenario."""
    fast = SMALL.replace(process={"A": [[2.0]], "Q": [[0.1]], "initial_covariance": [[1.0]]}, slots=200)
    with pytest.raises(ScenarioError, match="slots"):
        montecarlo(fast, trials=1)
    assert montecarlo(fast, trials=1, plan=Plan(Mode.ERROR_COORDINATES)).typed_summary.slots == 200


@pytest.mark.thorough
def test_a_sweep_takes_arrays_and_gives_a_table() -> None:
    """A row for each point and receiver, with the numbers of the point's own study; the page has the command that repeats it."""
    over = {"encoding.state_probability": np.array([0.2, 0.6]), "slots": range(5, 8, 2), "title": ["1:2"]}
    link = {"quality": 0.7}
    result = sweep(SMALL, over, trials=3, legitimate={"link": link})
    assert (result.points, result.table.num_rows, result.keys) == (4, 8, tuple(over))
    row = result.table.to_pylist()[-1]
    same = montecarlo(SMALL, trials=3, slots=7, encoding__state_probability=0.6, legitimate__link=link)
    assert (row["peer"], row["mean_squared_error"]) == ("smart", same.peers["smart"].mean_squared_error)
    lines = repr(result).splitlines()
    assert lines[0] == f"SweepResults over {', '.join(over)}: 4 points"
    assert sum("smart" in line for line in lines) == 4
    assert max(map(len, lines)) <= 100
    html = result._repr_html_()
    assert ("4 points" in html, html.count("<tr>"), "more:" in html) == (True, 9, False)
    wide = replace(result, table=pa.concat_tables([result.table] * 6))
    for text in (wide._repr_html_(), repr(wide)):
        assert "and 8 more rows: .table has all of them" in text
    result.report()
    (command,) = (text for text in checked(result.folder).texts if text.startswith("evedrop sweep"))
    options = parser_of("sweep").parse_whole(shlex.split(command)[1:])
    assert grid_of(options.over) == {"encoding.state_probability": [0.2, 0.6], "slots": [5, 7], "title": ["1:2"]}
    assert options.scenario == "scenario.toml"  # which the page carries
    assert load(result.folder / options.scenario, changes_of(options)) == SMALL.replace(trials=3, legitimate__link=link)


@pytest.mark.parametrize(
    ("over", "message"),
    [
        ({}, "expected 1 to 10000 points"),
        ({"slots": 5}, "slots is 5; expected a list of values"),
        ({"slots": []}, "slots is "),
        ({"slots": range(10_001)}, "expected 1 to 10000 points"),
    ],
)
def test_a_sweep_over_no_values_is_refused(over: dict[str, Any], message: str) -> None:
    """The message has the key and what is expected."""
    with pytest.raises(UsageError, match=message):
        sweep(SMALL, over)


@pytest.mark.long
def test_a_comparison_takes_a_scenario_of_python() -> None:
    """A comparison needs no folder."""
    result = compare(SMALL, schemes=["innovation"], adversaries=["naive"], trials=2)
    assert result.cell("innovation", "naive").eavesdropper is not None


@pytest.fixture
def cells(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Makes this program the kernel of a notebook, and collects what its cells show."""
    shown: list[str] = []

    def display(text: str, display_id: bool = False) -> SimpleNamespace:
        shown.append(text)
        return SimpleNamespace(update=shown.append)

    monkeypatch.setitem(sys.modules, "IPython", _module(get_ipython=lambda: SimpleNamespace(kernel=None)))
    monkeypatch.setitem(sys.modules, "IPython.display", _module(HTML=str, display=display))
    return shown


def test_a_notebook_shows_progress_and_takes_it_away(cells: list[str]) -> None:
    """Only the kernel of a notebook shows a bar, and only if no function takes the events; the kernel is a stand-in."""
    event: list[ProgressEvent] = []
    montecarlo(SMALL, trials=1, on_event=event.append)
    assert cells == []
    montecarlo(SMALL, trials=1)
    assert (cells[0], cells[-1]) == ('<progress max="1" value="0.0000"></progress> 0% · starting', "")
    from evedrop.cli.api.notebook import progress

    with progress(None, 50) as on_event:
        on_event(RunProgress(25, 1000.0, "slots/s", {}))
    assert cells[-2] == '<progress max="1" value="0.5000"></progress> 50% · 1,000 slots/s'


@pytest.mark.thorough
@pytest.mark.parametrize("mode", mostly_long(["auto", "web", "notebook"], ["auto"]))
def test_a_live_run_is_shown_in_the_cell(mode: str, cells: list[str]) -> None:
    """While it goes on; its page stays when it has ended."""
    kept = run(SMALL, view=mode)
    (frame,) = (text for text in cells if text.startswith("<iframe"))
    assert data_at(address_in(frame)) == (kept.folder / "recording.rrd").read_bytes()


@pytest.mark.thorough
def test_without_a_notebook_the_address_of_a_live_run_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """With a function that takes events, it is for that function; and there is no cell to show a view in."""
    events: list[ProgressEvent] = []
    run(SMALL, view="web", on_event=events.append)
    assert capsys.readouterr().out == ""
    (address,) = (event.address for event in events if isinstance(event, ViewOpened))
    assert str(address).startswith("http://127.0.0.1:")
    run(SMALL, view="web")
    words, address, _ = capsys.readouterr().out.split("\n")
    assert words == "the view is open to anybody who has this address:"
    assert address.startswith("http://127.0.0.1:")
    with pytest.raises(UsageError, match="view='notebook': expected \"web\" in a program that is not a notebook"):
        run(SMALL, view="notebook")


def test_results_have_a_view(results: RunResults, tmp_path: Path) -> None:
    """A frame in a notebook, elsewhere an address; it outlives the results, and ends when it is closed."""
    shutil.copytree(results.folder, tmp_path / "copy")
    view = load_results(tmp_path / "copy").view()
    shutil.rmtree(tmp_path / "copy")
    assert repr(view).split("\n") == ["the view is open to anybody who has this address:", view.address]
    assert address_in(view._repr_html_()) == view.address
    assert data_at(view.address).startswith(b"RRF2")
    view.close()
    assert repr(view) == view._repr_html_() == "a closed view"
    with pytest.raises(OSError, match="refused"):
        data_at(view.address)
    assert not (results.folder / "recording.rrd").exists()


def address_in(frame: str) -> str:
    """The address of the page in a frame."""
    (address,) = set(re.findall(r'(?:src|href)="([^"]+)"', frame))
    return unescape(address)


def data_at(address: str) -> bytes:
    """The recording that a page shows."""
    (data,) = parse_qs(urlsplit(address).query)["url"]
    with urlopen(data, timeout=LIMIT) as reply:  # noqa: S310 - our own address
        return bytes(reply.read())


def _module(**names: Any) -> ModuleType:
    module = ModuleType("IPython")
    vars(module).update(names)
    return module


@pytest.mark.parametrize("name", ["summary.json", "shards"])
def test_overwrite_never_removes_what_only_looks_like_results(tmp_path: Path, name: str) -> None:
    """Other programs write a summary.json, or a folder of shards, too."""
    (tmp_path / "thesis.tex").write_text("years of work")
    if name == "shards":
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text('{"accuracy": 0.93}')
    with pytest.raises(UsageError, match="is not a results folder, and overwrite=True replaces only those"):
        montecarlo(SMALL, out=tmp_path, overwrite=True)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize(
    "again",
    [
        lambda out: sweep(SMALL, {"slots": [-1]}, trials=2, out=out, overwrite=True),
        lambda out: sweep(SMALL, {"slots": [3]}, trials=2, out=out, overwrite=True, workers=0),
        lambda out: montecarlo("late", trials=2, out=out, overwrite=True, plan=Plan(mode=Mode.COVARIANCE_ONLY)),
        lambda out: montecarlo(SMALL, trials=2, out=out, overwrite=True, on_event="x"),  # type: ignore[arg-type]
        lambda out: run(SMALL, out=out, overwrite=True, listen="bad"),
    ],
    ids=["mistake", "workers", "mode", "events", "listen"],
)
def test_a_call_that_is_refused_leaves_the_earlier_results(tmp_path: Path, again: Any) -> None:
    """All of them, and nothing beside them."""
    out = tmp_path / "out"
    first = montecarlo(SMALL, trials=2, out=out)
    with pytest.raises(UsageError):
        again(out)
    assert load_results(out).summary == first.summary
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_results_that_cannot_be_set_aside_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the folder is a disk of its own, say, or one file of it may not be moved."""
    out = tmp_path / "out"
    first, rename = montecarlo(SMALL, trials=2, out=out), Path.rename

    def refused(path: Path, target: Path) -> Path:
        if path == out / "slots.parquet":
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(UsageError, match=r"its results cannot be set aside \(Invalid cross-device link\)"):
        montecarlo(SMALL, trials=2, out=out, overwrite=True)
    assert load_results(out).summary == first.summary
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    "error",
    [
        ScenarioError("s", ["a: b"]),
        TraceError("walk.csv", "file", "is empty"),
        Gap("k", 1, 2),
        MissingProcesses("sensor", ("smart",), "in 3 s"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_comes_from_another_process_as_it_was_raised(error: EvedropError) -> None:
    """Or a pool of processes would wait for it for ever."""
    error.add_note("a note")
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - as it comes from another process
    assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))


@pytest.mark.parametrize(
    "call", [lambda plan: sweep(SMALL, {"slots": [3]}, plan=plan), lambda plan: compare(SMALL, plan=plan)]
)
def test_only_trials_of_one_scenario_are_split(call: Any) -> None:
    """An option that does nothing would be taken for one that works."""
    with pytest.raises(UsageError, match="rare=True is for montecarlo"):
        call(Plan(rare=True))

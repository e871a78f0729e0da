"""The same work on a real Dask cluster of this machine: one scheduler and two workers, processes of their own."""

from __future__ import annotations

import importlib.metadata
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pyarrow.parquet as pq
import pytest

from evedrop.cli.api import compare, cost, learned, montecarlo, sweep
from evedrop.errors import RunError, UsageError
from evedrop.results.reading import Results
from evedrop.scenarios import shipped
from evedrop.simulate.cluster import Cluster, _result
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.tasks import Task
from evedrop.system.ports import free_port
from tests.conftest import LIMIT, Evedrop, Live, wait_until


@pytest.fixture(scope="module", autouse=True)
def dask() -> None:
    """Skip these tests without the extra `cluster`; imported only by the process that runs them, since it takes long."""
    pytest.importorskip("distributed")


def answers(port: int) -> bool:
    """Whether somebody listens."""
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


class Dask:
    """A Dask scheduler of this machine, and its workers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._log = folder / "log"
        self._processes: list[subprocess.Popen[bytes]] = []
        port = free_port()
        self.address = f"tcp://127.0.0.1:{port}"
        self._start("scheduler", "--port", str(port))
        wait_until(lambda: answers(port), "a scheduler that listens")

    def _start(self, program: str, *options: str, path: Sequence[Path] = ()) -> None:
        paths = os.pathsep.join(map(str, (*path, Path(__file__).parents[2])))
        with self._log.open("ab") as log:
            started = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    f"distributed.cli.dask_{program}",
                    "--host",
                    "127.0.0.1",
                    "--no-dashboard",
                    *options,
                ],
                env={**os.environ, "PYTHONPATH": paths, "DASK_TEMPORARY_DIRECTORY": str(self._folder)},
                cwd=self._folder,
                stdout=log,
                stderr=log,
            )
        self._processes.append(started)

    def add_worker(self, *path: Path) -> None:
        """Start a worker, which finds packages in these folders first, and wait until the scheduler knows it."""
        before = self._workers()
        self._start("worker", self.address, "--no-nanny", "--nworkers", "1", "--nthreads", "1", path=path)
        wait_until(lambda: self._workers() > before, "a worker at the scheduler")

    def _workers(self) -> int:
        return self._log.read_text().count("Registered to:")

    def suspend(self) -> None:
        """Suspend the scheduler."""
        self._processes[0].send_signal(signal.SIGSTOP)

    def end(self) -> None:
        """End all processes."""
        for process in reversed(self._processes):
            process.send_signal(signal.SIGCONT)
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def first_line(live: Live) -> str:
    """The first line of a command on standard error, as soon as it is there."""
    assert isinstance(live.process, subprocess.Popen)
    assert live.process.stderr is not None
    return str(live.process.stderr.readline())


@pytest.fixture
def lonely(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dask]:
    """A scheduler without workers."""
    dask = Dask(tmp_path_factory.mktemp("lonely"))
    try:
        yield dask
    finally:
        dask.end()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler with two workers."""
    dask = Dask(tmp_path_factory.mktemp("dask"))
    try:
        dask.add_worker()
        dask.add_worker()
        yield dask.address
    finally:
        dask.end()


@pytest.mark.thorough
def test_a_study_on_the_cluster_is_the_local_one(evedrop: Evedrop, scheduler: str) -> None:
    """Digests, tables and summary of `montecarlo --scheduler` are those of one worker here."""
    base = (
        "montecarlo",
        "eavesdroppers",
        "--slots",
        "60",
        "--trials",
        "1200",
        "--record-trials",
        "2",
        "--json",
        "--out",
    )
    here, there = evedrop(*base, "here", "--workers", "1"), evedrop.process(*base, "there", "--scheduler", scheduler)
    assert (here.status, there.status, there.err) == (0, 0, "")
    for key in ("peers", "links", "secrecy", "surprising", "trials", "ended"):
        assert here.summary[key] == there.summary[key]
    ours, theirs = (Results.read(evedrop.folder / name) for name in ("here", "there"))
    for table in ("slots", "trials", "digests"):
        assert getattr(ours, table).equals(getattr(theirs, table)), table


@pytest.mark.long
def test_a_sweep_on_the_cluster_is_the_local_one(evedrop: Evedrop, scheduler: str) -> None:
    """The same table, bit by bit."""
    base = (
        "sweep",
        "eavesdroppers",
        "--slots",
        "9",
        "--trials",
        "600",
        "--over",
        "encoding.state_probability=0.2:0.8:0.2",
    )
    here, there = evedrop(*base, "--out", "here"), evedrop(*base, "--out", "there", "--scheduler", scheduler)
    assert (here.status, there.status, there.err) == (0, 0, "")
    ours, theirs = (pq.read_table(evedrop.folder / name / "sweep.parquet") for name in ("here", "there"))
    assert ours.num_rows == 4 * 4
    assert ours.equals(theirs)


@pytest.mark.long
def test_a_comparison_on_the_cluster_is_the_local_one(evedrop: Evedrop, scheduler: str) -> None:
    """The same compare.json, byte for byte."""
    schemes = ("--schemes", "plain,innovation", "--adversaries", "naive,smart")
    base = ("compare", "eavesdroppers", "--slots", "20", "--trials", "30", *schemes)
    here, there = evedrop(*base, "--out", "here"), evedrop(*base, "--out", "there", "--scheduler", scheduler)
    assert (here.status, there.status, there.err) == (0, 0, "")
    ours, theirs = ((evedrop.folder / name / "compare.json").read_text() for name in ("here", "there"))
    assert ours == theirs
    assert len(json.loads(ours)["schemes"]) == 2


@pytest.mark.long
@pytest.mark.parametrize(
    "study",
    [
        pytest.param(("cost", "microgrid", "--trials", "51", "--slots", "4"), id="cost", marks=pytest.mark.long),
        pytest.param(("learned", "learning", "--trials", "101", "--slots", "9", "--set", "expect=[]"), id="learned"),
    ],
)
def test_a_table_on_the_cluster_is_the_local_one(evedrop: Evedrop, scheduler: str, study: tuple[str, ...]) -> None:
    """The same JSON from two tasks, and from two processes of this machine."""
    here, there = evedrop(*study, "--json"), evedrop(*study, "--json", "--scheduler", scheduler)
    assert (here.status, there.status, there.err) == (0, 0, "")
    assert json.loads(here.out) == json.loads(there.out)
    assert here.out == evedrop(*study, "--json", "--workers", "2").out


def write_short(file: Path) -> None:
    """A scenario of a few slots whose expectation holds."""
    text = shipped()["eavesdroppers"].read_text(encoding="utf-8")
    file.write_text(text.replace("slots = 5000", "slots = 20").replace("below = 0.01", "below = 1e9"), encoding="utf-8")


@pytest.mark.thorough
def test_a_test_in_memory_on_the_cluster_is_the_local_one(evedrop: Evedrop, scheduler: str) -> None:
    """Both pass, with the same digests; live, a scheduler is refused."""
    write_short(evedrop.folder / "mine.toml")
    base = ("test", "mine.toml", "--in-memory", "--trials", "600", "--out")
    here, there = evedrop(*base, "here"), evedrop(*base, "there", "--scheduler", scheduler)
    assert (here.status, there.status) == (0, 0)
    ours, theirs = (Results.read(evedrop.folder / name / "mine") for name in ("here", "there"))
    assert ours.digests.num_rows > 0
    assert ours.digests.equals(theirs.digests)
    live = evedrop("test", "mine.toml", "--scheduler", scheduler)
    assert (live.status, live.err) == (
        2,
        "evedrop: --scheduler computes trials in memory; add --in-memory, or leave it out\n",
    )


@pytest.mark.long
def test_pytest_computes_in_memory_on_the_cluster(evedrop: Evedrop, scheduler: str) -> None:
    """A scenario passes as a test of pytest; live, a scheduler is refused."""
    write_short(evedrop.folder / "mine.toml")
    (evedrop.folder / "pyproject.toml").write_text("[project]\n", encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "evedrop.cli.pytest_plugin",
        "mine.toml",
        "--evedrop-scheduler",
        scheduler,
    ]
    environment = {**evedrop.environment, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done, live = (
        subprocess.run(
            [*command, *more], cwd=evedrop.folder, env=environment, capture_output=True, text=True, check=False
        )
        for more in (("--evedrop-in-memory", "--evedrop-trials", "20"), ())
    )
    assert done.returncode == 0
    assert "1 passed" in done.stdout
    assert live.returncode == pytest.ExitCode.USAGE_ERROR
    assert "--evedrop-scheduler computes trials in memory; add --evedrop-in-memory, or leave it out" in live.stderr


@pytest.mark.long
def test_python_takes_a_scheduler_by_its_address(scheduler: str) -> None:
    """Every function that simulates in memory gives what it gives here."""
    small: dict[str, Any] = {"slots": 20, "trials": 30}
    results = [montecarlo("eavesdroppers", scheduler=where, **small) for where in (None, scheduler)]
    assert results[0].digests == results[1].digests
    over = {"encoding.state_probability": [0.3, 0.6]}
    tables = [sweep("eavesdroppers", over, scheduler=where, **small).table for where in (None, scheduler)]
    assert tables[0] == tables[1]
    two = {"schemes": ["plain", "innovation"], "adversaries": ["smart"], **small}
    assert compare("vehicle", scheduler=scheduler, **two).table == compare("vehicle", **two).table
    short: dict[str, Any] = {"slots": 12, "trials": 3, "expect": []}
    day: dict[str, Any] = {"slots": 130, "trials": 3}
    assert cost("microgrid", scheduler=scheduler, **day) == cost("microgrid", **day)
    assert learned("learning", scheduler=scheduler, **short) == learned("learning", **short)


def test_a_scheduler_that_is_no_address_is_refused() -> None:
    """A cluster in place of its address: the message has the attribute to give."""
    with pytest.raises(UsageError, match=r"expected the address .* a LocalCluster is its scheduler_address"):
        montecarlo("eavesdroppers", slots=9, trials=5, scheduler=cast(str, object()))


def test_an_error_of_a_worker_is_said_by_its_first_line() -> None:
    """As text."""
    future: Future[object] = Future()
    future.set_exception(ValueError("no such file\nmore of it"))
    with pytest.raises(RunError, match="failed: ValueError: no such file; look at"):
        _result(future)


@pytest.mark.long
def test_a_scheduler_without_workers_is_said_and_its_first_worker_begins(evedrop: Evedrop, lonely: Dask) -> None:
    """One line that has the command which starts a worker, and once there is one, the study runs to its end."""
    study = ("montecarlo", "eavesdroppers", "--slots", "9", "--trials", "5")
    live = evedrop.started(*study, "--scheduler", lonely.address, interpreter=True)
    line = first_line(live)
    assert line.startswith(f"evedrop: the scheduler {lonely.address} has no workers; waiting for one: start it with ")
    assert f"`dask worker {lonely.address} --nthreads 1`" in line
    lonely.add_worker()
    done = live.end()
    assert (done.status, done.err) == (0, "")


@pytest.mark.long
def test_waiting_for_workers_ends_upon_ctrl_c(evedrop: Evedrop, lonely: Dask) -> None:
    """Status 130, and no folder."""
    study = ("montecarlo", "eavesdroppers", "--slots", "9", "--trials", "5")
    live = evedrop.started(*study, "--scheduler", lonely.address, interpreter=True)
    assert "has no workers" in first_line(live)
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130
    assert not live.folder.exists()


def test_a_stop_ends_the_wait_for_workers() -> None:
    """Also of a scheduler that answers and has none. No task is sent."""
    looks: list[str] = []

    def nobody() -> dict[str, int]:
        looks.append("again")
        return {}

    cluster = Cluster("tcp://scheduler", SimpleNamespace(nthreads=nobody))
    assert list(cluster.results(cast(list[Task[Any]], [None]), lambda: bool(looks))) == []
    assert looks


def test_a_lack_of_workers_is_said_and_the_first_worker_begins(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line with the command that starts a worker, once; the task waits for it."""
    for name in ("LONELY", "WORKERS", "POLL"):
        monkeypatch.setattr(f"evedrop.simulate.cluster._{name}_SECONDS", 0.01)
    told: list[str] = []

    def workers() -> dict[str, int]:
        told.append(capsys.readouterr().err)
        return {"tcp://worker": 1} if sum(map(bool, told)) and not told[-1] else {}

    future = SimpleNamespace(done=lambda: True, result=lambda: "result")
    client = SimpleNamespace(
        nthreads=workers,
        get_versions=lambda **_: {"workers": {}},
        submit=lambda *_, **__: future,
        cancel=lambda _: None,
    )
    cluster = Cluster("tcp://scheduler", client)
    assert list(cluster.results(cast(list[Task[Any]], [None]), lambda: False)) == [(0, "result")]
    assert "".join(told) == (
        "evedrop: the scheduler tcp://scheduler has no workers; waiting for one: start it with "
        "`dask worker tcp://scheduler --nthreads 1`\n"
    )


@pytest.mark.parametrize("silent", ["nthreads", "get_versions"])
@pytest.mark.parametrize("stopping", [True, False])
def test_a_scheduler_that_does_not_answer_keeps_nothing_waiting(
    monkeypatch: pytest.MonkeyPatch, silent: str, stopping: bool
) -> None:
    """As a suspended one: a stop ends the study, and otherwise the scheduler is named after a while. No task is sent."""
    asked = threading.Event()

    def never(**_: object) -> None:
        asked.set()
        threading.Event().wait()

    client = SimpleNamespace(**{"nthreads": lambda: {"tcp://worker": 1}, "get_versions": never, silent: never})
    monkeypatch.setattr("evedrop.simulate.cluster._ANSWER_SECONDS", LIMIT if stopping else 0.5)
    results: Iterator[tuple[int, Any]] = Cluster("tcp://scheduler", client).results(
        [], lambda: stopping and asked.is_set()
    )
    if stopping:
        assert list(results) == []
    else:
        with pytest.raises(RunError, match=r"^the scheduler tcp://scheduler has not answered for 0\.5 s"):
            list(results)
    assert asked.is_set()


@pytest.mark.long
def test_a_suspended_scheduler_keeps_no_study_from_ending(evedrop: Evedrop, lonely: Dask) -> None:
    """Ctrl-C ends it, with status 130."""
    study = ("montecarlo", "eavesdroppers", "--slots", "9", "--trials", "5")
    live = evedrop.started(*study, "--scheduler", lonely.address, interpreter=True)
    assert "has no workers" in first_line(live)
    lonely.suspend()
    live.process.send_signal(signal.SIGINT)
    assert live.end().status == 130


@pytest.mark.long
def test_a_worker_of_another_version_is_said(evedrop: Evedrop, lonely: Dask, tmp_path: Path) -> None:
    """The worker's address, its version, ours, and what to do; nothing is kept."""
    folder = tmp_path / "other" / "evedrop-0.0.1.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: evedrop\nVersion: 0.0.1\n")
    lonely.add_worker(tmp_path / "other")
    done = evedrop(
        "montecarlo", "eavesdroppers", "--slots", "9", "--trials", "5", "--scheduler", lonely.address, "--out", "run"
    )
    assert done.status == 3
    (line,) = done.err.splitlines()
    assert line.startswith("evedrop: the worker tcp://127.0.0.1:")
    ours = importlib.metadata.version("evedrop")
    assert f"has evedrop 0.0.1; expected evedrop {ours}, as here: install this version there" in line
    assert not (evedrop.folder / "run").exists()


def test_a_folder_that_is_not_empty_is_refused_there_too(evedrop: Evedrop, scheduler: str) -> None:
    """One line, and the connection is closed."""
    (evedrop.folder / "full").mkdir()
    (evedrop.folder / "full" / "file").touch()
    done = evedrop(
        "montecarlo", "eavesdroppers", "--slots", "9", "--trials", "5", "--scheduler", scheduler, "--out", "full"
    )
    assert (done.status, done.err) == (2, "evedrop: full is not empty; give another folder, or empty it\n")


@pytest.mark.long
@pytest.mark.parametrize("command", ["montecarlo", "sweep"])
def test_an_unreachable_scheduler_is_refused(evedrop: Evedrop, command: str) -> None:
    """Nobody listens: one line, exit 2, nothing left on disk."""
    over = ("--over", "seed=1,2") if command == "sweep" else ()
    address = f"tcp://127.0.0.1:{free_port()}"
    done = evedrop(
        command, "eavesdroppers", "--slots", "9", "--trials", "5", *over, "--scheduler", address, "--out", "run"
    )
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert line.startswith(f"evedrop: the scheduler {address}: no Dask scheduler answers there")
    assert not (evedrop.folder / "run").exists()


@pytest.mark.parametrize("address", ["nonsense", "foo://127.0.0.1:8786", ""])
def test_an_address_that_is_none_is_refused(tmp_path: Path, address: str) -> None:
    """Without a port, of an unknown protocol, or where nobody listens; nothing is left on disk."""
    address = address or f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(UsageError, match=f"the scheduler {address}: no Dask scheduler answers there"):
        montecarlo("eavesdroppers", slots=9, trials=5, plan=Plan(scheduler=address, patience=0.5), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_somebody_else_on_the_port_is_no_scheduler(tmp_path: Path) -> None:
    """A listener that never speaks is given up on after a few seconds."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(UsageError, match="no Dask scheduler answers there"):
            montecarlo(
                "eavesdroppers", slots=9, trials=5, plan=Plan(scheduler=address, patience=0.5), out=tmp_path / "run"
            )
    assert not (tmp_path / "run").exists()

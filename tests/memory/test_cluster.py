"""The same work on a real Dask cluster of this machine: one scheduler and two workers, processes of their own."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from evedrop.api import montecarlo
from evedrop.errors import UsageError
from evedrop.memory.montecarlo import Plan
from evedrop.ports import free_port
from evedrop.results.writer import load_results
from tests.conftest import Evedrop, wait_until


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


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler with two workers."""
    folder = tmp_path_factory.mktemp("dask")
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "DASK_TEMPORARY_DIRECTORY": str(folder)}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard"]
    worker = [
        sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        address,
        "--host",
        "127.0.0.1",
        "--no-dashboard",
        "--no-nanny",
    ]
    processes = []
    log = (folder / "log").open("wb")
    try:
        for one in ([*command, "--port", str(port)], *([[*worker, "--nworkers", "1", "--nthreads", "1"]] * 2)):
            processes.append(subprocess.Popen(one, env=environment, cwd=folder, stdout=log, stderr=log))
            wait_until(lambda: answers(port), "a scheduler that listens")
        wait_until(lambda: (folder / "log").read_text().count("Registered to:") >= 2, "two workers at the scheduler")
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        log.close()


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
    ours, theirs = (load_results(evedrop.folder / name) for name in ("here", "there"))
    for table in ("slots", "trials", "digests"):
        assert getattr(ours, table).equals(getattr(theirs, table)), table


def test_a_sweep_on_the_cluster_is_the_local_one(evedrop: Evedrop, scheduler: str) -> None:
    """The same table, bit by bit."""
    base = (
        "sweep",
        "eavesdroppers",
        "--slots",
        "30",
        "--trials",
        "600",
        "--over",
        "encoding.state_probability=0.2:0.8:0.2",
    )
    here, there = evedrop(*base, "--out", "here"), evedrop.process(*base, "--out", "there", "--scheduler", scheduler)
    assert (here.status, there.status, there.err) == (0, 0, "")
    ours, theirs = (pq.read_table(evedrop.folder / name / "sweep.parquet") for name in ("here", "there"))
    assert ours.num_rows == 4 * 4
    assert ours.equals(theirs)


def test_a_folder_that_is_not_empty_is_refused_there_too(evedrop: Evedrop, scheduler: str) -> None:
    """One line, and the connection is closed."""
    (evedrop.folder / "full").mkdir()
    (evedrop.folder / "full" / "file").touch()
    done = evedrop.process(
        "montecarlo", "eavesdroppers", "--slots", "9", "--trials", "5", "--scheduler", scheduler, "--out", "full"
    )
    assert (done.status, done.err) == (2, "evedrop: full is not empty; give another folder, or empty it\n")


@pytest.mark.parametrize("command", ["montecarlo", pytest.param("sweep", marks=pytest.mark.long)])
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


@pytest.mark.parametrize("address", ["nonsense", "foo://127.0.0.1:8786"])
def test_an_address_that_is_none_is_refused(tmp_path: Path, address: str) -> None:
    """Without a port, of an unknown protocol."""
    with pytest.raises(UsageError, match="no Dask scheduler answers there"):
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

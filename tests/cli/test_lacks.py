"""A machine that lacks memory, threads or processes: one sentence and exit status 3, of every command and in every process."""

from __future__ import annotations

import errno
import os
import resource
import sys
import threading
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pyarrow as pa
import pytest

from evedrop.simulate import montecarlo, workers
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.tasks import OnProgress, Result, Stopped, Task
from evedrop.system.lacks import lack_of, preload_within_limit, refuse_scipy_without_room
from tests.conftest import Evedrop
from tests.examples import mostly_long


class PanicException(BaseException):
    """It cannot be imported."""


LACKS: list[tuple[BaseException, str]] = [
    (
        PanicException("OS can't spawn worker thread: Resource temporarily unavailable (os error 11)"),
        "no further process or thread can be started; ",
    ),
    (MemoryError(), "there is not enough memory; "),
    (OSError(errno.ENOMEM, "Cannot allocate memory"), "there is not enough memory; "),
    (
        BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"),
        "no further process or thread can be started; ",
    ),
    (
        pa.ArrowException("Unknown error: Failed to launch worker thread: Resource temporarily unavailable"),
        "no further process or thread can be started; ",
    ),
    (RuntimeError("can't start new thread"), "no further process or thread can be started; "),
    (
        ImportError("Original error was: libx.so: failed to map segment from shared object"),
        "there is not enough memory; ",
    ),
    (SystemError("error return without exception set"), "there is not enough memory; "),
    (OSError(errno.EMFILE, "Too many open files", "summary.json"), "this process may open no further file; "),
    (OSError(errno.ENFILE, "Too many open files in system"), "no further file can be opened; "),
    (PanicException("Failed to init net"), "this process may open no further file; "),
]
STUDY = ("montecarlo", "eavesdroppers", "--trials", "2", "--slots", "5")


@pytest.mark.parametrize(("error", "says"), LACKS, ids=lambda part: type(part).__name__)
def test_a_study_without_resources_is_no_failed_expectation(
    evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch, error: Exception, says: str
) -> None:
    """Status 1 would say that an expectation failed."""

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(montecarlo, "progress_counter", fail)
    done = evedrop(*STUDY, "--out", "x")
    assert (done.status, done.out) == (3, "")
    assert done.err.startswith(f"evedrop: {says}")
    assert done.err.count("\n") == 1


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("other"),
        RuntimeError("Failed to init by itself"),
        ImportError("no module named x"),
        OSError(errno.ENOSPC, "No space"),
        SystemError("other"),
        ValueError(),
    ],
)
def test_other_errors_are_no_lack(error: Exception) -> None:
    """A mistake in the program keeps its traceback."""
    assert lack_of(error) is None


def test_a_run_without_threads_ends_with_a_sentence(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """As under a container's limit of processes, which counts threads."""

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    starts = ("_start_joinable_thread", "_start_new_thread")  # since Python 3.13, and before
    monkeypatch.setattr(threading, next(name for name in starts if hasattr(threading, name)), fail)
    done = evedrop("run", "eavesdroppers", "--slots", "5", "--view", "off", "--out", "run")
    assert done.status == 3
    assert done.err.startswith("evedrop: no further process or thread can be started; ")


class Hungry(Task[Result]):
    """A task for which there is not enough memory."""

    def carry_out(self, on_progress: OnProgress, stopped: Stopped) -> Result:
        """Raises MemoryError."""
        del on_progress, stopped
        raise MemoryError

    def example(self) -> Result:
        """There is none."""
        raise NotImplementedError


def test_a_worker_without_memory_says_so() -> None:
    """And not in which line of numpy it happened."""
    task = Hungry({}, 0, 10)
    assert str(workers._outcome(task, lambda _: None, lambda: False)).startswith("there is not enough memory; ")


@pytest.mark.parametrize("megabytes", mostly_long([400, 500, 800], [500]))
def test_a_command_with_little_memory_never_ends_with_status_1(evedrop: Evedrop, megabytes: int) -> None:
    """Whatever fails first, our code or a library: it ends, and not with a failed expectation."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 10**6,) * 2)

    done = evedrop.process(*STUDY, "--set", "expect=[]", "--workers", "1", "--out", "x", preexec_fn=limit)
    assert done.status != 1, done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize("megabytes", mostly_long([450, 500], [450]))
def test_a_command_without_room_for_scipy_says_so(evedrop: Evedrop, megabytes: int) -> None:
    """It used to hang for ever, and no signal but SIGKILL ended it."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 10**6,) * 2)

    done = evedrop.process("design", "eavesdroppers", preexec_fn=limit)
    assert done.status == 3
    assert done.err.startswith("evedrop: there is not enough memory; ")
    assert done.err.count("\n") == 1


@pytest.fixture
def without_room(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A process that has no room for scipy, and has not imported it."""
    monkeypatch.delitem(sys.modules, "scipy.special", raising=False)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + 100_000_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.usefixtures("without_room")
def test_what_a_summary_needs_is_imported_while_there_is_room() -> None:
    """Without room a study of any kind fails before its first trial; OpenBLAS would try for ever."""
    with pytest.raises(MemoryError), Plan().crew([]):
        pytest.fail("it began")


@pytest.mark.usefixtures("without_room")
def test_scipy_is_not_even_looked_for_without_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor twice; other modules are."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "scipy"]:
        monkeypatch.delitem(sys.modules, name)
    before = len(sys.meta_path)
    refuse_scipy_without_room()
    refuse_scipy_without_room()
    assert len(sys.meta_path) == before + 1
    with pytest.raises(MemoryError):
        import_module("scipy.linalg")
    with pytest.raises(ModuleNotFoundError):
        import_module("no_such_module")


def test_without_a_limit_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """No module is imported early, and imports are as fast as before."""
    monkeypatch.delitem(sys.modules, "scipy.special", raising=False)
    before = [*sys.meta_path]
    refuse_scipy_without_room()
    preload_within_limit()
    assert sys.meta_path == before
    assert "scipy.special" not in sys.modules

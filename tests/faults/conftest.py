"""Runs that have ended, for the tests of the judge, and what they must come to."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop import montecarlo
from evedrop.virtual.reference import RunReference, in_memory
from tests.faults import judge
from tests.faults.ended import EARLY, Ended, copy_of, ended_run
from tests.faults.variants import VARIANTS


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the results of `reference` are."""
    return tmp_path_factory.mktemp("reference") / "memory"


@pytest.fixture(scope="module")
def reference(memory: Path) -> RunReference:
    """The variant `plain` in memory."""
    return in_memory(VARIANTS["plain"].scenario(memory.parent), memory)


@pytest.fixture(scope="module")
def first_ended(tmp_path_factory: pytest.TempPathFactory, memory: Path, reference: RunReference) -> Ended:
    """A run for the judge, which ended as if nothing had happened; no test changes it."""
    del reference
    return ended_run(tmp_path_factory.mktemp("ended"), memory, 400, "complete")


@pytest.fixture
def ended(tmp_path: Path, first_ended: Ended) -> Ended:
    """One as that."""
    return copy_of(first_ended, tmp_path)


@pytest.fixture(scope="module")
def first_early(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """A run for the judge that a killed process ended early, as it should; no test changes it."""
    folder = tmp_path_factory.mktemp("early")
    scenario = VARIANTS["plain"].scenario(folder)
    montecarlo(scenario, trials=1, slots=EARLY, out=folder / "short")
    run = ended_run(folder, folder / "short", EARLY, "smart was ended by signal 9")
    run.change("digests", lambda table: table.slice(0, 0))  # its only block was cut short
    run.edit(lambda summary: [peer.update(digest=None) for peer in summary["peers"].values()])
    (folder / "stderr").write_text("evedrop: smart was ended by signal 9\n")
    run.launcher.returncode = judge.FAILED
    return run


@pytest.fixture
def early(tmp_path: Path, first_early: Ended) -> Ended:
    """One as that."""
    return copy_of(first_early, tmp_path)

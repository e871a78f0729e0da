"""Which fresh machines are tried, and how long everything took there."""

from __future__ import annotations

import pytest

from tests.fresh.machine import COMMANDS, MACHINES, PACKAGES, Machine, Outcome, chosen
from tests.privileged import CannotRun, prepare, skip

OUTCOMES = pytest.StashKey[dict[str, Outcome]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--machine`: by default all."""
    parser.addoption(
        "--machine", default="all", help=f"one of {', '.join(MACHINES)}; all; in-turn: one, by the last commit"
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test of a machine is one of each that is asked for."""
    if "machine" in metafunc.fixturenames:
        try:
            machines = chosen(metafunc.config.getoption("--machine", default="all"))
        except (ValueError, CannotRun) as error:
            raise pytest.UsageError(str(error)) from error
        metafunc.parametrize("machine", machines, ids=lambda machine: machine.name)


@pytest.fixture(scope="session")
def outcomes(request: pytest.FixtureRequest) -> dict[str, Outcome]:
    """What became of each machine; shown in the summary. Skips where no machine can be made."""
    try:
        prepare(PACKAGES)
    except CannotRun as error:
        skip(error)
    request.config.stash[OUTCOMES] = {}
    return request.config.stash[OUTCOMES]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """A line for each command on each machine, and what is wrong."""
    for name, outcome in config.stash.get(OUTCOMES, {}).items():
        machine: Machine = MACHINES[name]
        for command, (status, seconds) in outcome.ended.items():
            terminalreporter.write_line(f"{name}, as {machine.user}: `{command}` ended with {status} after {seconds} s")
        terminalreporter.write_line(f"{name}: {outcome.used_kilobytes // 1000} MB of files")
        for mistake in outcome.mistakes(COMMANDS):
            terminalreporter.write_line(f"{name}: {mistake}")

"""A pytest plugin that runs scenario files as tests: `pytest scenarios/`, `pytest my.toml`. One file is one test and one run.

Its fixtures `evedrop_wire` and `evedrop_simulated_wire` give a test wires between programs (docs/wire/python.md, from pytest).

pytest loads this plugin in every project of an environment that has Evedrop installed. So it imports nothing of Evedrop before it
finds a TOML file, and only what runs a scenario when a scenario is run.

Source: docs/testing.md.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, final

import pytest

if TYPE_CHECKING:
    from evedrop.studies.scenario_tests import Finding
    from evedrop.virtual.simulated_wire import SimulatedWire
    from evedrop.wire.running import RunningWire

_LONGEST_NAME = 100
_PRELOADED = pytest.StashKey[ExitStack]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of docs/testing.md."""
    group = parser.getgroup("evedrop", "scenarios of Evedrop")
    group.addoption("--evedrop-in-memory", action="store_true", help="run scenarios in memory instead of live")
    group.addoption("--evedrop-trials", type=int, metavar="N", help="number of trials; default the scenario's")
    group.addoption(
        "--evedrop-out",
        type=Path,
        metavar="DIR",
        help="folder for the results, a folder for each scenario or test with wires; default runs/, for wires tmp_path",
    )
    group.addoption(
        "--evedrop-scheduler",
        metavar="ADDRESS",
        help="with --evedrop-in-memory: let the workers of this Dask scheduler compute the trials, tcp://HOST:PORT",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse a scheduler for live runs."""
    if config.option.evedrop_scheduler is not None and not config.option.evedrop_in_memory:
        raise pytest.UsageError(
            "--evedrop-scheduler computes trials in memory; add --evedrop-in-memory, or leave it out"
        )


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """A collector for a scenario file; None for any other file."""
    if file_path.suffix != ".toml":
        return None
    from evedrop.scenario.discovery import is_scenario  # most projects have no scenario

    return ScenarioFile.from_parent(parent, path=file_path) if is_scenario(file_path) else None


@pytest.fixture
def evedrop_wire(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., RunningWire]]:
    """A function that opens a wire for this test: its arguments are those of `evedrop.wire`.

    Its results are in a folder of the test below that of `--evedrop-out`, or in `tmp_path`. The test fails if an expectation of
    a wire failed.
    """
    from evedrop.wire.running import wire  # needed only by tests that open a wire

    with ExitStack() as stack:
        yield _opening(
            request, tmp_path, lambda *arguments, **entries: stack.enter_context(wire(*arguments, **entries))
        )


@pytest.fixture
def evedrop_simulated_wire(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., SimulatedWire]]:
    """As `evedrop_wire`, but the wire and the programs that its `start` starts are in a simulated world, in virtual time.

    `zenoh.open` opens simulated sessions there, and the wire's `clock` is to be used in place of the module `time`.
    """
    if "evedrop_wire" in request.fixturenames:
        pytest.fail(
            "a test has either evedrop_wire or evedrop_simulated_wire: only one of them can be the world it is in"
        )
    from evedrop.cli.simulated import program  # needed only by tests that open a simulated wire
    from evedrop.virtual.simulated_wire import SimulatedWires  # the same

    with SimulatedWires(program) as wires:
        yield _opening(request, tmp_path, wires.open)


_Wire = TypeVar("_Wire", "RunningWire", "SimulatedWire")


def _opening(request: pytest.FixtureRequest, tmp_path: Path, open_wire: Callable[..., _Wire]) -> Callable[..., _Wire]:
    """The same function, with results folders of the test, which its report names."""
    from evedrop.results.folder import claimed  # needed only by tests that open a wire

    out: Path | None = request.config.option.evedrop_out
    name = re.sub(r"\W", "_", request.node.name)[:_LONGEST_NAME]
    # The test may have another folder by now.
    place = tmp_path if out is None else claimed(request.config.invocation_params.dir / out / name)
    folders = (place / f"wire-{number}" for number in count(1))

    def opened(*arguments: Any, **entries: Any) -> _Wire:
        running = open_wire(*arguments, **{"out": next(folders), **entries})
        request.node.user_properties.append(("evedrop_results", str(running.folder)))
        return running

    return opened


@final
class ScenarioFile(pytest.File):
    """A scenario file."""

    def collect(self) -> Iterator[pytest.Item]:
        """Its one test."""
        yield ScenarioItem.from_parent(self, name=self.path.stem)


@final
class ScenarioItem(pytest.Item):
    """A scenario as a test."""

    def runtest(self) -> None:
        """Run the scenario. Raises ScenarioFailed if it does not pass."""
        from evedrop.errors import Interrupted  # needed only to run a scenario
        from evedrop.studies.scenario_tests import Manner, Outcome, carry_out  # the same

        self._imports_once()
        options = self.config.option
        manner = Manner(
            options.evedrop_in_memory,
            {} if options.evedrop_trials is None else {"trials": options.evedrop_trials},
            options.evedrop_out,
            scheduler=options.evedrop_scheduler,
        )
        try:
            tested = carry_out(str(self.path), manner)
        except Interrupted:
            raise KeyboardInterrupt from None
        for name, value in (
            ("evedrop_seed", tested.seed),
            ("evedrop_results", tested.folder),
            ("evedrop_report", tested.report),
            ("evedrop_verdict", tested.verdict),
        ):
            if value is not None:
                self.user_properties.append((name, str(value)))
        if tested.outcome is not Outcome.PASSED:
            raise ScenarioFailed(tested)

    def _imports_once(self) -> None:
        """Let the live runs of all scenarios share their imports."""
        from evedrop.live.launch.starter import preloaded  # needed only to run a scenario

        if _PRELOADED not in self.config.stash and not self.config.option.evedrop_in_memory:
            stack = self.config.stash[_PRELOADED] = ExitStack()
            stack.enter_context(preloaded())
            self.config.add_cleanup(stack.close)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], *more: Any) -> Any:
        """The reasons, one line each; a traceback only for a bug of Evedrop."""
        if isinstance(excinfo.value, ScenarioFailed):
            return str(excinfo.value)
        return super().repr_failure(excinfo, *more)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """The file, and the test's heading in the report."""
        return self.path, None, f"scenario {self.name}"


class ScenarioFailed(Exception):
    """A scenario that did not pass, with the reasons."""

    def __init__(self, tested: Finding) -> None:
        super().__init__("\n".join(tested.lines))

"""`evedrop test`: runs scenarios as tests, by their expectations."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import command, flag, option, together
from evedrop.cli.in_memory import check_resuming, resuming, scheduler
from evedrop.cli.options import changes, changes_of
from evedrop.errors import UsageError
from evedrop.system.output import tell, warn

if TYPE_CHECKING:
    from evedrop.studies.simulated_tests import SeedsToPlay

_PROGRAM = "evedrop.cli.simulated:program"


_PLACES = option(
    "places", "PATH", "a scenario, a folder that contains scenarios, or the name of a built-in one", nargs="+"
)


_TESTS = together(
    flag("--in-memory", "in memory instead of live"),
    flag("--simulated", "in the simulated world, disturbed by faults that seeds decide"),
    option("--seeds", "N", "with --simulated: how many seeds of each scenario; default 100", type=int),
    option("--seed", "FIRST", "with --simulated: the first seed; default 1", type=int, dest="first_seed"),
    changes,
    option("--trials", "N", "number of trials; default the scenario's", type=int),
    option("--junit", "FILE", "write a report in JUnit XML", type=Path),
    option("--out", "DIR", "folder for the results, with a folder for each scenario; default runs/", type=Path),
    option("--jobs", "N", "how many to run at the same time; default 1", type=int, default=1),
)


@command(
    (_PLACES, _TESTS, resuming, scheduler), section="run", example="test scenarios/ --junit report.xml", page="testing"
)
def test(options: argparse.Namespace) -> int:
    """Run scenarios as tests, with a report for CI."""
    from evedrop.studies.junit import check_junit, write_junit
    from evedrop.studies.scenario_tests import Finding, Manner, results, scenarios_of
    from evedrop.studies.tests_page import write_tests_page

    if options.jobs < 1:
        raise UsageError(f"--jobs {options.jobs}: expected 1 or more")
    if options.scheduler is not None and not options.in_memory:
        raise UsageError("--scheduler computes trials in memory; add --in-memory, or leave it out")
    if options.resume and not options.in_memory:
        raise UsageError("--resume goes on with tests in memory; add --in-memory, or leave it out")
    check_resuming(options)
    simulation = _simulation(options)
    scenarios = scenarios_of(options.places)
    if options.junit is not None:
        check_junit(options.junit)
    manner = Manner(
        options.in_memory,
        changes_of(options),
        options.out,
        scheduler=options.scheduler,
        resume=options.resume,
        simulation=simulation,
    )
    started, began, tested = time.time(), time.monotonic(), list[Finding]()
    try:
        for finding in results(scenarios, manner, options.jobs):
            tested.append(finding)
            tell(f"{finding.outcome.word:<9}{finding.seconds:7.1f} s  {finding.scenario}", alarm="FAILED")
            for line in finding.lines:
                tell(f"    {line}")
            sys.stdout.flush()
    except BaseException:
        write_tests_page(manner.folder, tested, started)
        try:
            write_junit(options.junit, tested, started)
        except UsageError as error:
            warn(str(error))
        raise
    page = write_tests_page(manner.folder, tested, started)
    counts = Counter(finding.outcome for finding in tested)
    printed = ", ".join(
        f"{count} {outcome.word}" for outcome, count in sorted(counts.items(), key=lambda at: at[0].value)
    )
    tell(f"{printed}, in {time.monotonic() - began:.1f} s", alarm="FAILED")
    if page is not None:
        tell(f"report: {page}")
    write_junit(options.junit, tested, started)
    return max(outcome.value for outcome in counts)


def _simulation(options: argparse.Namespace) -> SeedsToPlay | None:
    """How the scenarios are run in the simulated world, or None. Raises UsageError."""
    from evedrop.studies.simulated_tests import SeedsToPlay

    if not options.simulated:
        for name, value in (("seeds", options.seeds), ("seed", options.first_seed)):
            if value is not None:
                raise UsageError(f"--{name} is of runs in the simulated world; add --simulated, or leave it out")
        return None
    if options.in_memory:
        raise UsageError("--in-memory and --simulated are two ways to run a scenario; give one of them")
    seeds = 100 if options.seeds is None else options.seeds
    first = 1 if options.first_seed is None else options.first_seed
    if seeds < 1:
        raise UsageError(f"--seeds {seeds}: expected 1 or more")
    return SeedsToPlay(first, seeds, _PROGRAM)


COMMANDS = (test,)

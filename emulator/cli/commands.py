"""The commands: each reads its options, calls the module that does the work, and prints the result.

Slow imports are made only by the command that needs them, so that `evedrop --help` and a peer start quickly.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evedrop.errors import Interrupted, RunError, UsageError

if TYPE_CHECKING:
    from evedrop.memory.montecarlo import Plan
    from evedrop.scenario import Scenario
    from evedrop.view.viewer import Viewer


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    from evedrop.loading import value_of

    changes: dict[str, Any] = {}
    for change in options.changes:
        key, equals, value = change.partition("=")
        if not equals or not key:
            raise UsageError(f"--set {change}: expected KEY=VALUE, such as --set legitimate.link.quality=0.8")
        changes[key] = value_of(value)
    for name in ("seed", "slots", "trials", "first_trial", "record_trials", "pace"):
        value = getattr(options, name, None)
        if value is not None:
            changes[name] = value
    if getattr(options, "secret", None) is not None:
        changes["secret_file"] = str(options.secret.absolute())
    return changes


def list_scenarios(_: argparse.Namespace) -> int:
    """Print a line for each shipped scenario, even if it needs an extra that is not installed."""
    import tomllib

    from evedrop.loading import shipped

    scenarios = shipped()
    width = max(map(len, scenarios)) + 2
    for name, path in scenarios.items():
        print(f"{name:<{width}}{tomllib.loads(path.read_text(encoding='utf-8'))['title']}")
    return 0


def new(options: argparse.Namespace) -> int:
    """Write the commented scenario."""
    from evedrop.loading import write_new

    write_new(options.file)
    print(f"{options.file} written; change it, then: evedrop run {options.file}")
    return 0


def demo(options: argparse.Namespace) -> int:
    """Run `vehicle` live."""
    options.scenario = "vehicle"
    return run(options)


def run(options: argparse.Namespace) -> int:
    """Run a scenario live."""
    from evedrop.cli.report import ProgressLine
    from evedrop.live.launch.launcher import launch
    from evedrop.results.folder import results_folder

    scenario = loaded(options)
    with results_folder(options.out, options.scenario) as folder:
        with ProgressLine(scenario.slots, "slots", options.json) as line:
            try:
                ended = launch(scenario, folder, options.view, options.listen, line.tell, options.relay)
            except (RunError, Interrupted):
                with contextlib.suppress(OSError):  # the reader of the output may have got the same Ctrl-C
                    _print_results(line.moved or folder, options.json)
                raise
        _print_results(ended.folder, options.json)
    if ended.viewer is not None:
        _keep_open(ended.viewer)
    return ended.status


def loaded(options: argparse.Namespace, beyond_horizon: bool = False) -> Scenario:
    """Load the scenario of a command, with its changes; prints warnings."""
    from evedrop.expected.estimates import warnings_of
    from evedrop.loading import load

    scenario = load(options.scenario, _changes(options), beyond_horizon=beyond_horizon)
    for warning in warnings_of(scenario):
        print(f"evedrop: warning: {warning}", file=sys.stderr)
    return scenario


def _print_results(folder: Path, as_json: bool) -> None:
    """Print the closing report of a run, if it has results."""
    from evedrop.cli.closing_report import print_results

    with contextlib.suppress(UsageError):
        print_results(folder, as_json)


def _keep_open(viewer: Viewer) -> None:
    """Keep the view open until it is closed or Ctrl-C, if started from a terminal; otherwise end it with the command."""
    if sys.stdin.isatty() and sys.stderr.isatty() and viewer.alive():
        where = f" at {viewer.address}" if viewer.address else ""
        print(f"the view stays open{where}; Ctrl-C ends it", file=sys.stderr)
        _hold(viewer)
    else:
        viewer.stop()


def _hold(viewer: Viewer) -> None:
    """Wait until the view is closed, or until Ctrl-C or SIGTERM ends it."""
    from evedrop.signals import stop_on_signals

    with stop_on_signals() as stop:
        while viewer.alive() and not stop.wait(0.1):
            pass
    viewer.stop()


def montecarlo(options: argparse.Namespace) -> int:
    """Run the trials of a scenario in memory."""
    from evedrop.cli.report import ProgressLine
    from evedrop.memory.montecarlo import simulate
    from evedrop.results.folder import results_folder

    options.trials = 1000 if options.trials is None else options.trials
    plan = _plan(options)
    scenario = loaded(options, beyond_horizon=options.mode != "exact")
    with results_folder(options.out, options.scenario) as folder:
        with ProgressLine(scenario.trials * scenario.slots, "trial-slots", options.json) as line:
            try:
                status = simulate(scenario, folder, line.tell, plan)
            except Interrupted:
                with contextlib.suppress(OSError):  # as above
                    _print_results(line.moved or folder, options.json)
                raise
        _print_results(line.moved or folder, options.json)
    return status


def _plan(options: argparse.Namespace) -> Plan:
    from evedrop.memory.montecarlo import Plan
    from evedrop.memory.simulation import Mode

    return Plan(Mode(options.mode), options.workers, options.scheduler)


def sweep(options: argparse.Namespace) -> int:
    """Run Monte Carlo over a grid."""
    from evedrop.cli.report import ProgressLine, print_sweep
    from evedrop.results.folder import results_folder
    from evedrop.studies.sweep import grid_of, sweep_over

    options.trials = 1000 if options.trials is None else options.trials
    grid = grid_of(options.over)
    plan = _plan(options)
    with (
        results_folder(options.out, f"{Path(options.scenario).stem}-sweep") as folder,
        ProgressLine(0, "trial-slots", options.json) as line,
    ):
        table = sweep_over(options.scenario, _changes(options), grid, folder, line.tell, plan)
    if options.json:
        print(json.dumps(table.to_pylist(), ensure_ascii=False))
    else:
        print_sweep(table, tuple(grid), str(folder))
    return 0


def compare(options: argparse.Namespace) -> int:
    """Compare schemes and adversaries."""
    from evedrop.api import compare as compare_all
    from evedrop.cli.comparison_report import print_comparison
    from evedrop.cli.report import ProgressLine
    from evedrop.loading import value_of
    from evedrop.memory.montecarlo import Plan
    from evedrop.results.folder import results_folder

    changes = _changes(options)
    parameters = {}
    for text in options.parameters:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(
                f"--with {text}: expected SCHEME.PARAMETER=VALUE, such as innovation.state_probability=0.7"
            )
        parameters[key] = value_of(value)
    with (
        results_folder(options.out, f"compare-{Path(options.scenario).name}") as folder,
        ProgressLine(0, "trial-slots", options.json) as line,
    ):
        found = compare_all(
            options.scenario,
            schemes=_names(options.schemes),
            adversaries=_names(options.adversaries),
            parameters=parameters,
            out=folder,
            plan=Plan(workers=options.workers),
            tell=line.tell,
            **{"trials": 200, **changes},
        )
    if options.json:
        print(found.as_json(indent=None))
    else:
        print_comparison(found, str(folder))
    return 0


def _names(listed: str | None) -> list[str] | None:
    return None if listed is None else [name.strip() for name in listed.split(",")]


def design(options: argparse.Namespace) -> int:
    """Print the admissible μ_d, and the cost and secrecy of each choice."""
    from evedrop.api import design as design_of
    from evedrop.cli.report import print_design

    found = design_of(options.scenario, max_trace=options.max_trace, changes=_changes(options))
    if options.json:
        print(json.dumps(found.as_dict(), ensure_ascii=False))
    else:
        print_design(found)
    return 0


def figures(options: argparse.Namespace) -> int:
    """Draw the paper's figures."""
    from evedrop.paper.figures import Size
    from evedrop.paper.figures import figures as draw

    try:
        report = draw(
            options.folder,
            lambda text: print(text, file=sys.stderr),
            Size(microgrid_trials=1000) if options.full else Size(),
        )
    except OSError as error:
        raise UsageError(f"{options.folder} cannot be written ({error.strerror}); give another folder") from error
    print(report)
    return 0


def view(options: argparse.Namespace) -> int:
    """Open a finished run, draw it, or print its closing report again."""
    if options.table:
        from evedrop.cli.closing_report import print_results

        print_results(options.run)
        return 0
    from evedrop.results.writer import load_results
    from evedrop.signals import raise_on_signals
    from evedrop.view.viewer import WebAddress, open_run

    stand = None if options.serve is None else WebAddress.of(options.serve)
    results = load_results(options.run) if not (options.run / "summary.json").is_file() else None
    if results is not None:
        print(f"evedrop: {results.remark}", file=sys.stderr)
    with raise_on_signals(), tempfile.TemporaryDirectory(prefix="evedrop-view-") as temporary:
        recording = options.run / "recording.rrd"
        if results is not None or not recording.is_file():
            from evedrop.view.replay import replay
        if results is not None:  # a run in progress, or a killed one, has no complete recording
            recording = replay(options.run, Path(temporary) / "recording.rrd")
        elif not recording.is_file():
            recording = replay(options.run)
        if options.picture is None:
            viewer = open_run(options.run, options.view, stand, recording)
            where = f" at {viewer.address}, to anybody who has this address" if viewer.address else ""
            print(f"the run is shown{where}; Ctrl-C ends it", flush=True)
            if viewer.warning is not None:
                print(f"evedrop: warning: {viewer.warning}", file=sys.stderr)
            _hold(viewer)
            return 0
        from evedrop.view.picture import picture_apart

        for complaint in picture_apart(recording, options.picture, options.slot):
            print(complaint, file=sys.stderr)
    return 0


def diff(options: argparse.Namespace) -> int:
    """Compare two runs."""
    from evedrop.results.diff import difference
    from evedrop.results.writer import load_results

    runs = [load_results(run) for run in options.runs]
    found = difference(*runs)
    print(found.text)
    for remark in filter(None, (run.remark for run in runs)):
        print(remark)
    return 0 if found.same else 1


def test(options: argparse.Namespace) -> int:
    """Run scenarios as tests; returns the worst of their exit statuses."""
    from evedrop.studies.junit import write_junit
    from evedrop.studies.scenario_test_jobs import results
    from evedrop.studies.scenario_tests import Finding, Manner, scenarios_of

    if options.jobs < 1:
        raise UsageError(f"--jobs {options.jobs}: expected 1 or more")
    scenarios = scenarios_of(options.places)
    started, tested = time.time(), list[Finding]()
    try:
        for one in results(scenarios, Manner(options.in_memory, options.trials, options.out), options.jobs):
            tested.append(one)
            print(f"{one.outcome.word:<9}{one.seconds:7.1f} s  {one.scenario}", flush=True)
            for line in one.lines:
                print(f"    {line}", flush=True)
    finally:
        if options.junit is not None:
            write_junit(options.junit, tested, started)
    counts = Counter(one.outcome for one in tested)
    said = ", ".join(f"{count} {outcome.word}" for outcome, count in sorted(counts.items(), key=lambda at: at[0].value))
    print(f"{said}, in {time.time() - started:.1f} s")
    return max(outcome.value for outcome in counts)


def check(options: argparse.Namespace) -> int:
    """Validate scenarios, or classes."""
    from evedrop.expected.estimates import warnings_of
    from evedrop.loading import load

    names = {kind: name for kind in ("scheme", "eavesdropper", "link", "delay") if (name := getattr(options, kind))}
    if bool(names) == bool(options.scenarios):
        raise UsageError("check: expected scenarios, or classes by --scheme, --eavesdropper, --link or --delay")
    if names:
        return _check_classes(names, _changes(options))
    status = 0
    for name in options.scenarios:
        try:
            scenario = load(name, _changes(options))
        except UsageError as error:
            print(error, file=sys.stderr)
            status = error.exit_status
            continue
        print(f"{name}: {scenario.title}: {scenario.slots} slots, {', '.join(scenario.receivers)}: no mistakes")
        for warning in warnings_of(scenario):
            print(f"  warning: {warning}")
    return status


def _check_classes(names: dict[str, str], parameters: dict[str, Any]) -> int:
    from evedrop.conformance.examine import examined

    status = 0
    for one in examined(names, parameters):
        broken = [verdict for verdict in one.verdicts if verdict.broken is not None]
        print(
            f"{one.title}: {f'{len(broken)} broken' if broken else 'all'} of {len(one.verdicts)} rules"
            + ("" if broken else " kept")
        )
        for verdict in one.verdicts:
            print(f"  {'ok' if verdict.broken is None else 'BROKEN':<8}{verdict.rule}")
            if verdict.broken is not None:
                print(f"          {verdict.broken}")
        status = UsageError.exit_status if broken else status
    return status


def selftest(_: argparse.Namespace) -> int:
    """Check that this machine computes the golden digests."""
    from evedrop.cli.selftest import GOLDEN, selftest

    check = selftest()
    for name, value in check.machine.items():
        print(f"{name:<16}{value}")
    for name, digest in check.digests.items():
        print(f"{name:<16}{digest}  {'golden' if GOLDEN.get(name) == digest else 'NOT the golden digest'}")
    if not check.passed:
        raise RunError("this machine does not compute the golden digests; please report the lines above")
    print("passed: this machine computes the expected digests")
    return 0


def fit_link(options: argparse.Namespace) -> int:
    """Fit loss and delay models to a recorded link."""
    from evedrop.fitting.fit import fit, lines

    found = fit(options.trace, options.column, options.delay_column)
    if options.json:
        print(json.dumps(found.as_dict(), ensure_ascii=False))
    else:
        print("\n".join(lines(found)))
    return 0

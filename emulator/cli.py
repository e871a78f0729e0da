"""The command line: parses, calls, prints. What a command does is in the module it calls; heavy imports wait for it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.errors import BriefError, EvedropError, Interrupted, RunError, UsageError

if TYPE_CHECKING:
    from emulator.run.viewer import Viewer
    from emulator.scenario import Scenario

Command = Callable[[argparse.Namespace], int]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; its exit status."""
    options = _parser().parse_args(arguments)
    command: Command = options.command
    try:
        return command(options)
    except EvedropError as error:
        print(f"evedrop: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return Interrupted.exit_status
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evedrop", description="A network emulator for secrecy in remote state estimation."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name: str, command: Command, does: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=does, description=f"{does[0].upper()}{does[1:]}.")
        one.set_defaults(command=command)
        return one

    add("list", _list, "the shipped scenarios, a line each")
    add("new", _new, "write a commented scenario to start from").add_argument("file", type=Path, metavar="FILE")
    _run_options(add("demo", _demo, "the shipped scenario `vehicle`, live, in real time, with the view"))
    live = add("run", _run, "a live run: processes, network, view, results")
    live.add_argument("scenario", metavar="SCENARIO", help="a shipped name, a file, or a results folder")
    _run_options(live)
    memory = add("montecarlo", _montecarlo, "the same trials in memory (default 1000)")
    memory.add_argument("scenario", metavar="SCENARIO")
    _scenario_options(memory)
    _output_options(memory)
    view = add("view", _view, "open a finished run")
    view.add_argument("run", type=Path, metavar="RUN", help="a results folder")
    view.add_argument("--view", choices=("auto", "native", "web"), default="auto")
    diff = add("diff", _diff, "first slot, trial and peer that differ, with both values")
    diff.add_argument("runs", nargs=2, type=Path, metavar="RUN")
    check = add("check", _check, "validate scenarios only")
    check.add_argument("scenarios", nargs="+", metavar="SCENARIO")
    check.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help=_SET_HELP)
    add("selftest", _selftest, "versions, processor, golden digest computed here")
    brief = add("brief", _brief, "write the briefs, to start the processes by hand")
    brief.add_argument("scenario", metavar="SCENARIO")
    _scenario_options(brief)
    brief.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the briefs go")
    brief.add_argument("--results", type=Path, default=Path("results"), metavar="DIR", help="the observer's folder")
    brief.add_argument("--listen", default="tcp/127.0.0.1:17447", metavar="ENDPOINT", help="the router's endpoint")
    for role in ("router", "sensor", "legitimate", "eavesdropper", "observer"):
        one = add(role, _process, f"one process of a run, the {role}")
        one.add_argument("brief", type=Path, metavar="BRIEF")
        one.set_defaults(role=role)
    return parser


_SET_HELP = "change an entry of the scenario by its dotted key; the value is read as TOML, else as a string; repeatable"


def _scenario_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help=_SET_HELP)
    for name, what in (
        ("seed", "seed of all random numbers"),
        ("slots", "number of slots"),
        ("trials", "number of trials"),
        ("first-trial", "number of the first trial"),
        ("record-trials", "how many trials are recorded in full"),
    ):
        parser.add_argument(f"--{name}", type=int, metavar="N", help=what)
    parser.add_argument("--pace", type=float, metavar="SECONDS", help="seconds a slot; 0 = as fast as it goes")
    parser.add_argument("--secret", type=Path, metavar="FILE", help="a secret that does not derive from the seed")


def _output_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, metavar="DIR", help="results folder, new or empty")
    parser.add_argument("--json", action="store_true", help="the summary alone on standard output")


def _run_options(parser: argparse.ArgumentParser) -> None:
    _scenario_options(parser)
    _output_options(parser)
    parser.add_argument("--view", choices=("auto", "native", "web", "off"), default="auto")
    parser.add_argument("--listen", metavar="ENDPOINT", help="the router's endpoint, such as tcp/127.0.0.1:17447")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"evedrop {version('evedrop')}")
        parser.exit()


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    from emulator.scenario import value_of

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


def _list(_: argparse.Namespace) -> int:
    from emulator.scenario import load, shipped

    for name in shipped():
        print(f"{name:<16}{load(name).title}")
    return 0


def _new(options: argparse.Namespace) -> int:
    from emulator.scenario import write_new

    write_new(options.file)
    print(f"{options.file} written; change it, then: evedrop run {options.file}")
    return 0


def _demo(options: argparse.Namespace) -> int:
    options.scenario = "vehicle"
    return _run(options)


def _run(options: argparse.Namespace) -> int:
    from emulator.api import default_folder
    from emulator.run.launcher import launch
    from emulator.run.report import ProgressLine

    scenario = _loaded(options)
    folder = options.out or default_folder(options.scenario)
    with ProgressLine(scenario.slots, "slots", options.json) as line:
        try:
            ended = launch(scenario, folder, options.view, options.listen, line.tell)
        except (RunError, Interrupted):
            _print_results(folder, options.json)
            raise
    _print_results(folder, options.json)
    if ended.viewer is not None:
        _keep_open(ended.viewer)
    return ended.status


def _loaded(options: argparse.Namespace) -> Scenario:
    from emulator.run.estimates import warnings_of
    from emulator.scenario import load

    scenario = load(options.scenario, _changes(options))
    for warning in warnings_of(scenario):
        print(f"evedrop: warning: {warning}", file=sys.stderr)
    return scenario


def _print_results(folder: Path, as_json: bool) -> None:
    from emulator.run.report import print_summary
    from emulator.run.results import load_results

    try:
        summary = load_results(folder).summary
    except UsageError:
        return
    if as_json:
        print(json.dumps(summary, ensure_ascii=False))
    else:
        print_summary(summary, str(folder))


def _keep_open(viewer: Viewer) -> None:
    """From a terminal the view stays until Ctrl-C or until it is closed; from a pipe it ends with the command."""
    try:
        if sys.stdin.isatty() and sys.stderr.isatty() and viewer.alive():
            where = f" at {viewer.address}" if viewer.address else ""
            print(f"the view stays open{where}; Ctrl-C ends it", file=sys.stderr)
            viewer.wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.stop()


def _montecarlo(options: argparse.Namespace) -> int:
    from emulator.api import default_folder
    from emulator.run.montecarlo import simulate
    from emulator.run.report import ProgressLine

    options.trials = 1000 if options.trials is None else options.trials
    scenario = _loaded(options)
    folder = options.out or default_folder(options.scenario)
    with ProgressLine(scenario.trials * scenario.slots, "trial-slots", options.json) as line:
        status = simulate(scenario, folder, line.tell)
    _print_results(folder, options.json)
    return status


def _view(options: argparse.Namespace) -> int:
    from emulator.run.viewer import open_run

    _keep_open(open_run(options.run, options.view))
    return 0


def _diff(options: argparse.Namespace) -> int:
    from emulator.run.diff import difference
    from emulator.run.results import load_results

    found = difference(*(load_results(run) for run in options.runs))
    print(found.text)
    return 0 if found.same else 1


def _check(options: argparse.Namespace) -> int:
    from emulator.run.estimates import warnings_of
    from emulator.scenario import load

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


def _selftest(_: argparse.Namespace) -> int:
    from emulator.run.selftest import GOLDEN, selftest

    check = selftest()
    for name, value in check.machine.items():
        print(f"{name:<16}{value}")
    for name, digest in check.digests.items():
        print(f"{name:<16}{digest}  {'golden' if GOLDEN.get(name) == digest else 'NOT the golden digest'}")
    if not check.passed:
        raise RunError("this machine does not compute the golden digests; please report the lines above")
    return 0


def _brief(options: argparse.Namespace) -> int:
    from emulator.run.briefs import write_briefs

    for path in write_briefs(_loaded(options), options.listen, options.results, options.out):
        print(path)
    return 0


def _process(options: argparse.Namespace) -> int:
    from emulator.brief import read_brief

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    brief = read_brief(options.brief, options.role)
    match options.role:
        case "router":
            from emulator.network.router import route as play
        case "sensor":
            from peers.sensor import sense as play
        case "legitimate":
            from peers.legitimate import estimate as play
        case "eavesdropper":
            from peers.eavesdropper import eavesdrop as play
        case "observer":
            from emulator.run.observer import observe

            return observe(brief)
        case _:
            raise BriefError(f"no role {options.role}; give one of those that `evedrop --help` lists")
    play(brief)
    return 0

"""The command line: what there is to type, and how errors end. What a command does is in commands.py."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from emulator import commands
from emulator.errors import EvedropError, Interrupted, UsageError

Command = Callable[[argparse.Namespace], int]

_SET_HELP = "change an entry of the scenario by its dotted key; the value is read as TOML, else as a string; repeatable"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; its exit status."""
    options = _parser().parse_args(arguments)
    command: Command = options.command
    try:
        status = command(options)
        if sys.stdout is not None:  # a shell may have closed it
            sys.stdout.flush()
        return status
    except EvedropError as error:
        print(f"evedrop: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return Interrupted.exit_status
    except BrokenPipeError:
        _silence()
        return 0
    except OSError as error:
        _silence()
        print(
            f"evedrop: {error.filename or 'standard output'}: {error.strerror}; free some room, or look at its rights",
            file=sys.stderr,
        )
        return UsageError.exit_status


def _silence() -> None:
    """Have nothing more written to standard output, not even at the interpreter's end."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Commands:
    """The commands as they are added. Final."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._group = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(self, name: str, command: Command, does: str, *options: Callable[[argparse.ArgumentParser], None]) -> None:
        """A command, what it does in some words, and its options."""
        one = self._group.add_parser(name, help=does, description=f"{does[0].upper()}{does[1:]}.")
        one.set_defaults(command=command)
        for option in options:
            option(one)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evedrop", description="A network emulator for secrecy in remote state estimation."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    add = _Commands(parser).add
    add("list", commands.list_scenarios, "the shipped scenarios, a line each")
    add("new", commands.new, "write a commented scenario to start from", _argument("file", "FILE"))
    add("demo", commands.demo, "the shipped scenario `vehicle`, live, in real time, with the view", *_LIVE)
    add("run", commands.run, "a live run: processes, network, view, results", _scenario, *_LIVE)
    add("montecarlo", commands.montecarlo, "the same trials in memory (default 1000)", _scenario, *_MEMORY)
    add("sweep", commands.sweep, "Monte Carlo over a grid of values of any entries", _scenario, _over, *_MEMORY)
    add("design", commands.design, "admissible μ_d, secrecy, optimum, per eavesdropper", _scenario, _set, _designs)
    add("figures", commands.figures, "the paper's figures and number table, ours beside the paper's", _figures)
    add("view", commands.view, "open a finished run", _argument("run", "RUN"), _finished_view)
    add("diff", commands.diff, "first slot, trial and peer that differ, with both values", _two_runs)
    add("test", commands.test, "scenarios as tests: a line each, a report for CI", _places, _tests)
    add("check", commands.check, "validate scenarios only", _scenarios, _set)
    add("selftest", commands.selftest, "versions, processor, golden digest computed here")
    add("brief", commands.brief, "write the briefs, to start the processes by hand", _scenario, _entries, _briefs)
    for role in ("router", "sensor", "legitimate", "eavesdropper", "observer"):
        add(role, commands.process, f"one process of a run, the {role}", _argument("brief", "BRIEF"), _role(role))
    return parser


def _argument(name: str, shown: str) -> Callable[[argparse.ArgumentParser], None]:
    return lambda parser: void(parser.add_argument(name, type=Path, metavar=shown))


def void(_: object) -> None:
    """Forget a value."""


def _role(role: str) -> Callable[[argparse.ArgumentParser], None]:
    return lambda parser: parser.set_defaults(role=role)


def _scenario(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", metavar="SCENARIO", help="a shipped name, a file, or a results folder")


def _scenarios(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenarios", nargs="+", metavar="SCENARIO")


def _places(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "places", nargs="+", metavar="PATH", help="a scenario, or a folder that has some; or a shipped name"
    )


def _tests(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--in-memory", action="store_true", help="in memory instead of live")
    parser.add_argument("--trials", type=int, metavar="N", help="number of trials; default the scenario's")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write a report in JUnit XML")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where results go, a folder each; default runs/")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="how many at a time; default 1")


def _two_runs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs=2, type=Path, metavar="RUN")


def _set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="KEY=VALUE", help=_SET_HELP)


def _entries(parser: argparse.ArgumentParser) -> None:
    _set(parser)
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


def _output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, metavar="DIR", help="results folder, new or empty")
    parser.add_argument("--json", action="store_true", help="the summary alone on standard output")


def _live(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=("auto", "native", "web", "off"), default="auto", help="default auto")
    parser.add_argument("--listen", metavar="ENDPOINT", help="the router's endpoint, such as tcp/127.0.0.1:17447")


def _finished_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=("auto", "native", "web"), default="auto", help="default auto")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw it into a file instead; needs no screen")
    parser.add_argument("--slot", type=int, metavar="K", help="the moment to draw; default the last")


def _memory(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--workers", type=int, metavar="N", help="worker processes; the results do not depend on them")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="let a Dask cluster do the work, tcp://HOST:PORT")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument(
        "--covariance-only",
        dest="mode",
        action="store_const",
        const="covariance-only",
        help="simulate covariances given the events; draws no noise",
    )
    mode.add_argument(
        "--error-coordinates",
        dest="mode",
        action="store_const",
        const="error-coordinates",
        help="simulate the errors themselves: any horizon, no digest",
    )
    parser.set_defaults(mode="exact")


_LIVE = (_entries, _output, _live)
_MEMORY = (_entries, _output, _memory)


def _over(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--over",
        action="append",
        required=True,
        metavar="KEY=VALUES",
        help="an entry and its values, first:last:step or a,b,c; repeatable",
    )


def _designs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--max-trace", type=float, metavar="Ω", help="least μ_d whose limiting trace stays below Ω")
    parser.add_argument("--json", action="store_true", help="for programs")


def _figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", type=Path, default=Path("figures"), metavar="DIR")
    parser.add_argument("--full", action="store_true", help="the paper's 1000 trials of a day; minutes, not seconds")


def _briefs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where the briefs go")
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="DIR", help="the observer's folder")
    parser.add_argument("--listen", default="tcp/127.0.0.1:17447", metavar="ENDPOINT", help="the router's endpoint")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"evedrop {version('evedrop')}")
        parser.exit()

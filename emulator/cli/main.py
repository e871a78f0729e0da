"""The command line: its commands and options, and the handling of errors. commands.py carries the commands out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, final

from evedrop.cli import commands
from evedrop.cli import process as roles
from evedrop.cli import steer as operate
from evedrop.errors import EvedropError, Interrupted, RunError, UsageError
from evedrop.files import shown
from evedrop.output import OUTPUT, finish, named_output, say, silence

__all__ = ["is_role", "main"]

Command = Callable[[argparse.Namespace], int]
_ROLES = ("router", "relay", "sensor", "legitimate", "eavesdropper", "controller", "observer")

_SET_HELP = "change an entry of the scenario by its dotted key; the value is read as TOML, else as a string; repeatable"


def is_role(arguments: Sequence[str]) -> bool:
    """Whether the arguments begin with the role of a process."""
    return bool(arguments) and arguments[0] in _ROLES


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns its exit status."""
    options = _parser().parse_args(arguments)
    command: Command = options.command
    try:
        _check_names(options)
        with named_output():
            status = command(options)
            if sys.stdout is not None:  # a shell may have closed it
                sys.stdout.flush()
        return status
    except EvedropError as error:
        finish()
        say(str(error))
        return error.exit_status
    except KeyboardInterrupt:
        finish()
        return Interrupted.exit_status
    except OSError as error:
        if error.filename == OUTPUT:
            silence()
        if isinstance(error, BrokenPipeError) and error.filename == OUTPUT:
            return 0
        if error.filename is None:
            say(f"{error}; free system resources and try again")
            return RunError.exit_status
        say(f"{error.filename}: {error.strerror}; free some space, or check its permissions")
        return UsageError.exit_status


def _check_names(options: argparse.Namespace) -> None:
    """Raise UsageError for file names that results and messages cannot show."""
    try:
        here = str(Path.cwd())
    except OSError:
        return
    texts = [text for value in vars(options).values() for text in (value if isinstance(value, list) else [value])]
    for text in [here, *texts]:
        if isinstance(text, (str, Path)) and shown(text) != str(text):
            what = "the current folder" if text is here else "it"
            raise UsageError(
                f"{shown(text)}: {what} is not named in UTF-8, as results and messages are; use another name"
            )


@final
class _Commands:
    """Adds commands to a parser."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._group = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def group(self, name: str, does: str) -> _Commands:
        """Add a group of commands under a common name."""
        return _Commands(self._group.add_parser(name, help=does, description=f"{does[0].upper()}{does[1:]}."))

    def add(self, name: str, command: Command, does: str, *options: Callable[[argparse.ArgumentParser], None]) -> None:
        """Add a command; does: its description, in a few words; options: add its options."""
        one = self._group.add_parser(name, help=does, description=f"{does[0].upper()}{does[1:]}.")
        one.set_defaults(command=command)
        for option in options:
            option(one)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evedrop", description="A network emulator for secrecy in remote state estimation."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    top = _Commands(parser)
    add = top.add
    add("list", commands.list_scenarios, "the shipped scenarios, one line each")
    add("new", commands.new, "write a commented scenario to start from", _argument("file", "FILE"))
    add("demo", commands.demo, "the shipped scenario `vehicle`, live, in real time, with the view", *_LIVE)
    add("run", commands.run, "a live run: processes, network, view, results", _scenario, *_LIVE)
    add("montecarlo", commands.montecarlo, "the same trials in memory (default 1000)", _scenario, *_MEMORY)
    add("link", operate.link, "change, cut or heal a link of a run in progress", _going_on, _changed_link)
    add("pause", operate.pause, "hold a run in progress between two slots", _going_on)
    add("resume", operate.resume, "let a held run go on", _going_on)
    add("step", operate.step, "let a run go on for some slots, and hold it again", _going_on, _slots)
    add("status", operate.status, "the status of a run in progress", _going_on, _as_json)
    add("sweep", commands.sweep, "Monte Carlo over a grid of values of any entries", _scenario, _over, *_MEMORY)
    add("compare", commands.compare, "every scheme against every adversary", _scenario, _entries, _output, _compares)
    add("design", commands.design, "admissible μ_d, secrecy, optimum, per eavesdropper", _scenario, _set, _designs)
    add(
        "figures",
        commands.figures,
        "the paper's figures and number table, with our values next to the paper's",
        _figures,
    )
    add("view", commands.view, "open a finished run", _argument("run", "RUN"), finished_view, _served)
    add("diff", commands.diff, "the first slot, trial and peer at which two runs differ, with both values", _two_runs)
    add("test", commands.test, "scenarios as tests: one line each, a report for CI", _places, _tests)
    add("check", commands.check, "validate scenarios, or classes of your own", _scenarios, _set, _classes)
    links = top.group("links", "commands about links")
    links.add(
        "fit", commands.fit_link, "the loss model and delays of a recorded link", _argument("trace", "TRACE"), _fits
    )
    add("selftest", commands.selftest, "versions, processor, golden digest computed here")
    add("brief", roles.brief, "write the briefs, to start the processes by hand", _scenario, _entries, _briefs)
    add("health", roles.health, "whether the process of a brief is on the network", _argument("brief", "BRIEF"))
    for role in _ROLES:
        of_role = (_role(role), _observed, _served) if role == "observer" else (_role(role),)
        add(role, roles.process, f"one process of a run, the {role}", _argument("brief", "BRIEF"), *of_role)
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
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO")


def _classes(parser: argparse.ArgumentParser) -> None:
    for kind, what in (
        ("scheme", "a scheme, or the scheme to check an eavesdropper with"),
        ("eavesdropper", "an eavesdropper"),
        ("link", "a loss model"),
        ("delay", "a delay model"),
    ):
        text = f"check {what}: MODULE:CLASS of a module in this folder or an installed one; --set gives its parameters"
        parser.add_argument(f"--{kind}", metavar="NAME", help=text)


def _places(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "places", nargs="+", metavar="PATH", help="a scenario, a folder that contains scenarios, or a shipped name"
    )


def _tests(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--in-memory", action="store_true", help="in memory instead of live")
    parser.add_argument("--trials", type=int, metavar="N", help="number of trials; default the scenario's")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write a report in JUnit XML")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results, with a folder for each scenario; default runs/"
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="how many to run at the same time; default 1")


def _going_on(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="the results folder of a run in progress")


def _changed_link(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="the receiver whose link it is")
    parser.add_argument(
        "changes",
        nargs="+",
        metavar="KEY=VALUE",
        help="an entry of the link, such as quality=0.2, with a dotted key for an entry of a table; or the word cut or heal",
    )


def _slots(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("slots", type=int, metavar="N", help="number of slots")


def _as_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


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
    parser.add_argument("--pace", type=float, metavar="SECONDS", help="seconds per slot; 0 = as fast as possible")
    parser.add_argument("--secret", type=Path, metavar="FILE", help="a secret that is not derived from the seed")


def _observed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, metavar="DIR", help="results folder, new or empty; default the brief's")


def _output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, metavar="DIR", help="results folder, new or empty")
    parser.add_argument("--json", action="store_true", help="print only the summary, as JSON, on standard output")


def _live(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=("auto", "native", "web", "off"), default="auto", help="default auto")
    parser.add_argument(
        "--listen", metavar="ENDPOINT", help="the router's endpoint: tcp/127.0.0.1:PORT or tls/127.0.0.1:PORT"
    )
    parser.add_argument("--relay", metavar="ENDPOINT", help="the second router's endpoint, if the scenario has two")


def finished_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--view", choices=("auto", "native", "web"), default="auto", help="default auto")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw the run into a file instead; needs no screen"
    )
    instead.add_argument("--table", action="store_true", help="print the run's table and verdict instead")
    parser.add_argument("--slot", type=int, metavar="K", help="the slot to draw; default the last")


def _served(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--serve", metavar="HOST:PORT", help="show the run to browsers, at this address and port (and the next port)"
    )


def _memory(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--workers", type=int, metavar="N", help="number of worker processes; does not affect the results"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="use a Dask cluster, tcp://HOST:PORT")
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
        help="simulate the errors themselves: any number of slots, no digest",
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


def _compares(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--schemes", metavar="A,B", help="default all")
    parser.add_argument("--adversaries", metavar="X,Y", help="default all")
    parser.add_argument(
        "--with",
        dest="parameters",
        action="append",
        default=[],
        metavar="SCHEME.PARAMETER=VALUE",
        help="a parameter of a scheme other than the scenario's own; repeatable",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="number of worker processes; does not affect the results"
    )


def _designs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--max-trace", type=float, metavar="Ω", help="find the least μ_d whose limiting trace stays below Ω"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def _figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", type=Path, default=Path("figures"), metavar="DIR")
    parser.add_argument(
        "--full", action="store_true", help="simulate the paper's 1000 trials of a day; takes minutes, not seconds"
    )


def _fits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--column", metavar="C", help="the column of outcomes, if the file has several columns")
    parser.add_argument(
        "--delay-column",
        metavar="C",
        help="the column of delays in slots; default the column named delay, if there is one",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def _briefs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the briefs")
    parser.add_argument(
        "--results",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="the observer's results folder, on its host; relative to its working directory",
    )
    parser.add_argument(
        "--listen",
        default="tcp/127.0.0.1:17447",
        metavar="ENDPOINT",
        help="the endpoint where the router listens, such as tls/router.lan:7447",
    )
    parser.add_argument(
        "--connect", metavar="ENDPOINT", help="the endpoint that the others connect to; default that of --listen"
    )
    parser.add_argument("--relay", metavar="ENDPOINT", help="where the second router listens, if the scenario has two")
    parser.add_argument(
        "--relay-connect",
        metavar="ENDPOINT",
        help="the endpoint that its processes connect to; default that of --relay",
    )
    parser.add_argument(
        "--wait", type=int, default=600, metavar="SECONDS", help="how long processes wait for each other; default 600"
    )
    parser.add_argument(
        "--insecure", action="store_true", help="listen without encryption although other machines can reach it"
    )


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"evedrop {version('evedrop')}")
        parser.exit()

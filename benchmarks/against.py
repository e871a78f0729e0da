"""Compares the checkout with an earlier commit, command by command and in turns: what became slower.

    make bench-against                       # against the last tag
    make bench-against BASE=dd03e67          # against a commit
    python benchmarks/against.py BASE --python PATH [--quick]

The earlier commit is set up in a folder of its own, as `make setup` does it; with `--python` it is the one whose interpreter
has the path. Both run the same commands in turns, some rounds; a ratio above 1 is faster than before. A row is slower if its
median ratio is below 0.9 and no round was as fast as before: the exit status is then 1.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from live_run import scenario_file
from processes import children_seconds
from throughput import eavesdroppers

ROOT = Path(__file__).parents[1]
_NOISE = 0.1  # of a median of ratios, on a machine with other work
_MEASURED = (0, 1)  # 1: the scenario did not meet an expectation of its own
_LIMIT = 600.0  # seconds of one command


class NotMeasured(Exception):
    """A command failed: the earlier commit may not know it."""


@dataclass(frozen=True)
class Measurement:
    """A row: a command of Evedrop, and how fast it is, in any unit of which more is better."""

    what: str
    words: tuple[str, ...]
    speed: Callable[[Path, float, float], float]
    """From its results folder, the seconds on the clock and the seconds of the processor."""

    def of(self, python: str) -> float:
        """How fast an installation's command is. Raises NotMeasured."""
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            spent, began = children_seconds(), time.monotonic()
            command = [python, "-m", "evedrop", *self.words, "--out", str(out)]
            try:
                done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=_LIMIT)
            except (OSError, subprocess.TimeoutExpired) as error:
                raise NotMeasured(str(error)) from error
            if done.returncode not in _MEASURED or not (out / "summary.json").exists():
                raise NotMeasured(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "no reason given")
            return self.speed(out, time.monotonic() - began, children_seconds() - spent)


def slots_a_second(out: Path, _clock: float, _processor: float) -> float:
    """From the start of the first slot to the last row on disk."""
    return float(json.loads((out / "summary.json").read_text(encoding="utf-8"))["slots_per_second"])


def commands_a_second(_out: Path, clock: float, _processor: float) -> float:
    """By the clock."""
    return 1.0 / clock


def commands_a_processor_second(_out: Path, _clock: float, processor: float) -> float:
    """By the processor."""
    return 1.0 / processor


def measurements(folder: Path, quick: bool) -> Iterator[Measurement]:
    """All rows. folder: for scenario files."""

    def live(what: str, scenario: str, slots: int, *options: str) -> Measurement:
        count = str(max(50, slots // 100) if quick else slots)
        return Measurement(what, ("run", scenario, "--pace", "0", "--slots", count, *options), slots_a_second)

    off = ("--view", "off")
    yield live("one trial, 4 receivers", "eavesdroppers", 60_000, *off)
    yield live("the same with the web view", "eavesdroppers", 60_000, "--view", "web")
    yield live("1000 trials, 4 receivers", "eavesdroppers", 16_000, "--trials", "1000", *off)
    yield live("closed loop in lock-step", "microgrid", 20_000, *off)
    for number, slots in ((4, 40_000), (16, 16_000), (63, 8_000)):
        place = folder / f"{number}"
        place.mkdir()
        file = scenario_file(place, eavesdroppers(number, slots))
        yield live(f"{number} eavesdroppers, half smart, half naive", str(file), slots, *off)
    yield Measurement(
        "a run of one slot, start to end", ("run", "eavesdroppers", "--slots", "1", *off), commands_a_second
    )
    size = "100" if quick else "2000"
    words = ("montecarlo", "eavesdroppers", "--slots", size, "--trials", size, "--workers", "1")
    yield Measurement("a study in memory, processor time", words, commands_a_processor_second)


def is_slower(ratios: Sequence[float]) -> bool:
    """Whether a row became slower, from this one's speed over the earlier one's in each round."""
    return statistics.median(ratios) < 1.0 - _NOISE and max(ratios) < 1.0


def compare(rows: Iterator[Measurement], before: str, rounds: int) -> list[str]:
    """Print a row for each measurement; returns those that became slower, or fail now.

    before: the earlier installation's interpreter. A row that it cannot measure is left out: it may not know the command.
    """
    worse = []
    for row in rows:
        pairs = []
        for _ in range(rounds):
            try:
                now = row.of(sys.executable)
            except NotMeasured as reason:
                print(f"| {row.what} | {reason} | fails now |", flush=True)
                worse.append(row.what)
                break
            try:
                pairs.append((now, row.of(before)))
            except NotMeasured as reason:
                print(f"| {row.what} | not measured before: {reason} | |", flush=True)
                break
        if len(pairs) < rounds:
            continue
        ratios = [now / then for now, then in pairs]
        word = "slower" if is_slower(ratios) else ""
        shown = ", ".join(f"{ratio:.2f}" for ratio in sorted(ratios))
        print(f"| {row.what} | {statistics.median(ratios):.2f} ({shown}) | {word} |", flush=True)
        worse += [row.what] if word else []
    return worse


def last_tag(root: Path) -> str | None:
    """The last tag of a version before this commit; None without one."""
    done = subprocess.run(
        ["git", "describe", "--tags", "--abbrev=0", "--match", "v[0-9]*"],  # noqa: S607
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or None


@contextmanager
def installed(commit: str) -> Iterator[str]:
    """The interpreter of an earlier commit, set up in a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "before"
        subprocess.run(["git", "worktree", "add", "--detach", str(tree), commit], cwd=ROOT, check=True)  # noqa: S607
        try:
            subprocess.run(["make", "setup"], cwd=tree, check=True)  # noqa: S607
            yield str(tree / ".venv/bin/python")
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)  # noqa: S607


def main(words: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Print the table; returns 1 if a row became slower."""
    parser = argparse.ArgumentParser(description="This checkout against an earlier commit.")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("base", nargs="?", help="the earlier commit; without it, the last tag")
    either.add_argument("--python", help="the interpreter of an earlier installation, in place of a commit")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="small sizes, too small to judge by")
    options = parser.parse_args(words)
    base: str | None = options.base or (None if options.python else last_tag(root))
    if base is None and options.python is None:
        print("There is no tag yet, so there is nothing to compare with. BASE=COMMIT compares with a commit.")
        return 0
    rounds = 1 if options.quick else options.rounds
    print(f"this checkout over {base or options.python}, {rounds} rounds in turns; above 1: faster than before\n")
    print("| what | median of ratios | |\n|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        rows = measurements(Path(folder), options.quick)
        if base is None:
            worse = compare(rows, options.python, rounds)
        else:
            with installed(base) as before:
                worse = compare(rows, before, rounds)
    if options.quick:
        print("\nThese sizes are too small to judge by.")
        return 0
    print(
        f"\nSlower than before, or failed: {'; '.join(worse)}."
        if worse
        else "\nNothing that was measured became slower."
    )
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())

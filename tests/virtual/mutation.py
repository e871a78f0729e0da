"""Whether the simulated world notices mistakes: each mutant is put into a copy of the package, and seeds are played in it.

If no seed notices it, the cases of regressions.toml are played, too.

    python -m tests.virtual.mutation

Prints a row for each mutant: what noticed it, and after how many seeds, or in which case. A seed that breaks a promise without
the mistake does not count. A mutant that nothing notices shows what the simulation lacks.
Each processor tries one mutant at a time.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import argparse
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from tests.mutants import Mutant, cell, copy_with, mutants
from tests.virtual.simulated import play, played, read_case, save_time
from tests.virtual.test_campaign_regressions import REGRESSIONS

_ROOT = Path(__file__).parents[2]
_SEEDS, _CASES = "seeds", "cases"
_FOREVER_SECONDS = 60.0
"""A seed takes a fraction of a second: one that takes so long does not end."""


@dataclass(frozen=True)
class Outcome:
    """What the simulated world said of a mutant."""

    mutant: Mutant
    noticed: str | None
    """The first miss; None if there was none."""
    seeds: int
    """How many seeds had been played by then."""
    seconds: float
    case: int | None = None
    """The number of the case that noticed it, from 1; None if a seed did, or nothing."""

    def __str__(self) -> str:
        played = self.seeds if self.case is None else f"{self.seeds}, case {self.case}"
        return f"{self.mutant.row} {self.noticed or 'NOT NOTICED'} | {played} | {self.seconds:.0f} s |"


def tried(mutant: Mutant, seeds: range, seconds: float) -> Outcome:
    """Play seeds with a mutant until one notices it, for some seconds at most, and then the cases."""
    begun, count = time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        copy_with(mutant, Path(folder))
        with closing(_played_with(Path(folder), _SEEDS, seeds)) as misses:
            for seed, miss in zip(seeds, misses, strict=False):
                count += 1
                took = time.monotonic() - begun
                if miss and not _broken_anyway(seed):
                    return Outcome(mutant, cell(miss), count, took)
                if took > seconds:
                    break
        cases = range(1, 1 + len(REGRESSIONS))
        with closing(_played_with(Path(folder), _CASES, cases)) as misses:
            for case, miss in zip(cases, misses, strict=False):
                if miss:
                    return Outcome(mutant, cell(miss), count, time.monotonic() - begun, case)
    return Outcome(mutant, None, count, time.monotonic() - begun)


@cache
def _broken_anyway(seed: int) -> bool:
    """Whether a seed breaks a promise without any mistake."""
    return bool(played(seed)[5])


def _played_with(folder: Path, what: str, numbers: range) -> Generator[str]:
    """The first misses of seeds, or of cases, that are played with the copy of the package in a folder."""
    words = [sys.executable, "-m", "tests.virtual.mutation", "--play", what, str(numbers.start), str(numbers.stop)]
    # The class of an eavesdropper may have a process of its own, which ends a little later than this one: it writes nothing.
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    with (
        (folder / "stderr").open("w+") as errors,
        subprocess.Popen(
            words, cwd=_ROOT, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process,
    ):
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()

        def read() -> None:
            for line in process.stdout or ():
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        try:
            for _ in numbers:
                line = lines.get(timeout=_FOREVER_SECONDS)
                if line is None:
                    errors.seek(0)
                    raise RuntimeError(f"the interpreter of a mutant ended with {process.wait()}: {errors.read()}")
                yield line.strip()
        except queue.Empty:
            yield "the run does not end, and no virtual time passes"
        finally:
            process.kill()


def _play(what: str, numbers: range) -> None:
    """Play seeds, or cases, and print the first miss of each, on a line of its own."""
    save_time()
    for number in numbers:
        try:
            misses = played(number)[5] if what == _SEEDS else play(read_case(REGRESSIONS[number - 1]["case"])).misses
        except Exception as error:
            misses = (f"in memory: {type(error).__name__}: {error}",)
        _say(" ".join(misses[0].split()) if misses else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all mutants, or those whose description contains a word; 1 if one is not noticed."""
    parser = argparse.ArgumentParser(prog="python -m tests.virtual.mutation", description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default="", help="mutants whose description or file contains this")
    parser.add_argument("--seeds", type=int, default=400, help="how many are played with each")
    parser.add_argument("--seconds", type=float, default=120.0, help="for how long they are played at most")
    parser.add_argument("--play", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.play is not None:
        what, first, stop = options.play
        _play(what, range(int(first), int(stop)))
        return 0
    chosen = [mutant for mutant in mutants(options.only) if mutant.simulated]
    _say(f"| {len(chosen)} mutants | file | noticed by | seeds | time |\n|---|---|---|---|---|")
    missed = 0
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for outcome in pool.map(partial(tried, seeds=range(1, 1 + options.seeds), seconds=options.seconds), chosen):
            missed += outcome.noticed is None
            _say(str(outcome))
    _say(f"\n{len(chosen) - missed} of {len(chosen)} mutants were noticed")
    return 1 if missed else 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main())

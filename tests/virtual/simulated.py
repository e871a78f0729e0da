"""Play cases in the simulated world; cases that break a promise are shrunk, and shown.

python -m tests.virtual.simulated --seed 1 --count 100
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path

import pyarrow as pa

from evedrop.cli.simulated import program
from evedrop.virtual.campaign import PlayedCase, play_case
from evedrop.virtual.campaign import play as play_seed
from evedrop.virtual.cases import SEEDS_OF_A_SCENARIO, SimulatedCase, case_from, case_of
from evedrop.virtual.diagram import diagram
from evedrop.virtual.shrinking import Shrunk, kind_of, shrink
from evedrop.virtual.steps import Step, steps_of
from tests.virtual.wire_cases import EVERY, PlayedWire, SimulatedWireCase

AnyCase = SimulatedCase | SimulatedWireCase
WINDOW = Path()
"""What `--view` is without a file: the viewer is opened."""


def any_case(seed: int) -> AnyCase:
    """The case of a seed: one of so many is a wire."""
    return case_of(seed) if seed % EVERY else SimulatedWireCase.of(seed)


def read_case(text: str) -> AnyCase:
    """The case of a text: of a seed alone, or of a case written down. Raises UsageError."""
    if text.isdecimal():
        return any_case(int(text))
    return SimulatedWireCase.read(text) if '"starts"' in text else case_from(text)


def play(case: AnyCase, keep: bool = False) -> PlayedCase | PlayedWire:
    """Play a case."""
    return case.play(keep) if isinstance(case, SimulatedWireCase) else play_case(case, program, keep)


def played(seed: int) -> tuple[int, str, str, int, float, tuple[str, ...], int | None]:
    """A case, as it is told: seed, case, digest, events, virtual seconds, misses, status."""
    try:
        result = play_seed(seed, program) if seed % EVERY else play(any_case(seed))
    except Exception as error:
        error.add_note(f"while seed {seed} was played")
        raise
    run = result.run
    return seed, str(result.case), run.digest, run.events, run.seconds, result.misses, run.status


def shrunk(case: AnyCase, misses: Sequence[str], say: Callable[[str], object] = print) -> AnyCase:
    """The smallest case found that breaks the same promise; says how it is played again."""
    result: Shrunk[SimulatedWireCase] | Shrunk[SimulatedCase]
    if isinstance(case, SimulatedWireCase):
        result = shrink(case, misses, lambda smaller: smaller.play().misses, reductions=[SimulatedWireCase.smaller])
    else:
        result = shrink(case, misses, lambda smaller: play_case(smaller, program).misses)
    say(f"shrunk in {result.plays} plays; to play it again:")
    say(f"    {sys.executable} -m tests.virtual.simulated --case '{result.case.to_text()}'")
    return result.case


def show(case: AnyCase, view: Path | None = None, say: Callable[[str], object] = print) -> bool:
    """Play a case, and say what happened; returns whether all promises were kept.

    view: a file for its recording, or WINDOW.
    """
    result = play(case, keep=True)
    run, steps = result.run, steps_of(result.run.happened)
    say(f"{case}\n{run.events} events, {run.seconds:.2f} s, status {run.status}, {run.digest}")
    for miss in result.misses:
        say(f"    MISS {miss}")
    say(f"\n{diagram(steps)}\n")
    if view is not None:
        record(steps, view)
    return not result.misses


def record(steps: Sequence[Step], view: Path) -> None:
    """Write a recording, or open a viewer of it until it is closed."""
    from evedrop.show.view.viewer import open_run
    from tests.virtual.simulated_view import write_recording

    if view != WINDOW:
        write_recording(steps, view)
        return
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.rrd"
        write_recording(steps, recording)
        viewer = open_run(Path(folder), "auto", recording=recording)
        print(viewer.address or "the viewer is open")
        try:
            while viewer.alive():
                time.sleep(0.2)
        except KeyboardInterrupt:
            viewer.stop()


def unlike(failed: Sequence[tuple[int, tuple[str, ...]]]) -> list[tuple[int, tuple[str, ...]]]:
    """The first seed, and its misses, of all that broke the same promises."""
    first: dict[frozenset[str], tuple[int, tuple[str, ...]]] = {}
    for seed, misses in failed:
        first.setdefault(frozenset(map(kind_of, misses)), (seed, misses))
    return list(first.values())


def save_time() -> None:
    """Let a worker search its new objects for cycles less often, and its modules never; and use no threads for small tables.

    Ctrl-C is for the campaign, which waits for the cases that are being played.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    gc.set_threshold(50_000)
    pa.set_cpu_count(1)


def campaign(seeds: range, workers: int, explained: int, view: Path | None) -> bool:
    """Play the cases of seeds, and explain the first ones that fail in different ways; returns whether all kept their promises.

    Ctrl-C ends it early: it then tells of those that were played.
    """
    begun, count, events, total = time.perf_counter(), 0, 0, hashlib.blake2b(digest_size=8)
    failed: list[tuple[int, tuple[str, ...]]] = []
    with ProcessPoolExecutor(workers, initializer=save_time) as pool, suppress(KeyboardInterrupt):
        try:
            for seed, case, digest, happened, seconds, misses, status in pool.map(
                played, seeds, chunksize=SEEDS_OF_A_SCENARIO
            ):
                count += 1
                events += happened
                total.update(digest.encode())
                if misses or len(seeds) <= 20:
                    print(f"{seed}  {status}  {case}  {happened} events, {seconds:.2f} s, {digest}")
                for miss in misses:
                    print(f"    MISS {miss}")
                if misses:
                    failed.append((seed, misses))
        finally:
            pool.shutdown(cancel_futures=True)
    took = time.perf_counter() - begun
    for seed, misses in unlike(failed)[:explained]:
        print(f"\nseed {seed}: {any_case(seed)}")
        show(shrunk(any_case(seed), misses), view)
        view = None
    print(
        f"{count} runs, {len(failed)} with a miss; {events:,} events in {took:.1f} s, {count / took:.1f} runs/s; "
        f"hash of all events {total.hexdigest()}"
    )
    return not failed and count == len(seeds)


def main(arguments: Sequence[str] | None = None) -> int:
    """Play cases; returns 1 if a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--explained", type=int, default=2, help="how many failing seeds are shrunk and shown")
    parser.add_argument(
        "--explain", type=int, metavar="SEED", help="shrink the case of a seed, if it fails, and show it"
    )
    parser.add_argument("--case", metavar="TEXT|FILE", help="play a seed or a shrunk case, and show it")
    parser.add_argument(
        "--view", type=Path, nargs="?", const=WINDOW, metavar="FILE.rrd", help="also as a recording, or in a viewer"
    )
    options = parser.parse_args(arguments)
    if options.case is not None:
        text = options.case
        kept = show(read_case(text if text.lstrip()[:1] in "{0123456789" else Path(text).read_text()), options.view)
    elif options.explain is not None:
        case = any_case(options.explain)
        misses = play(case).misses
        print(f"seed {options.explain}: {case}")
        kept = show(shrunk(case, misses) if misses else case, options.view)
    else:
        seeds = range(options.seed, options.seed + options.count)
        kept = campaign(seeds, options.workers, options.explained, options.view)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())

"""Reads examples that were changed at random, and says which of them a reader broke on.

    python -m tests.fuzz.fuzzing READER --seed N --first N --count N

What breaks a reader is written into tests/corpus/READER, and read again by `make test` from then on.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from evedrop.errors import EvedropError
from tests.fuzz.mutation import Mutator
from tests.fuzz.reader import Reader
from tests.fuzz.readers import READERS

CORPUS = Path(__file__).parents[1] / "corpus"
LONGEST_SECONDS = 20.0
"""Of processor, for anything that is read: a scenario of many slots and states takes some of them on a slow machine."""
_MEMORY = 4 * 2**30
_MEMORY_WITH_RERUN = 8 * 2**30  # of addresses, of which Rerun uses little
_MOST_FAILURES = 25


@dataclass(frozen=True)
class Failure:
    """What broke a reader."""

    data: bytes
    how: str


class TooLong(Exception):
    """Something was read for longer than anything may be."""


@contextlib.contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise TooLong in the block when it has used this number of seconds of processor time."""

    def ring(*_: object) -> None:
        raise TooLong(f"it took more than {seconds:g} s")

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def broken_by(reader: Reader, data: bytes, folder: Path) -> Failure | None:
    """How a reader broke on bytes; None if it read or refused them."""
    how = None
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        # For unusable numbers in a file, the error says what is wrong, not numpy.
        with _limited(LONGEST_SECONDS), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            reader.read(data, folder)
    except EvedropError as error:
        if error.exit_status != reader.status:
            how = f"exit status {error.exit_status}, expected {reader.status}: {error}"
        elif not str(error).strip():
            how = f"{type(error).__name__} without a word"
    except Exception:
        how = traceback.format_exc()
    return None if how is None else Failure(data, how)


def campaign(name: str, seed: int, count: int, first: int = 0) -> list[Failure]:
    """The failures of a reader among this number of changed examples, from the one with the number `first` on."""
    reader = READERS[name]
    failures: list[Failure] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as place:
        for number in range(first, first + count):
            mutator = Mutator(f"{name}/{seed}/{number}", reader.words())
            failure = broken_by(reader, reader.changed(mutator, number), Path(place) / "of-one")
            if failure is not None:
                failures.append(failure)
                if len(failures) == _MOST_FAILURES:
                    break
    return failures


def keep(name: str, failure: Failure) -> Path:
    """Write what broke a reader into the corpus; its file."""
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / sha256(failure.data).hexdigest()[:16]
    path.write_bytes(failure.data)
    return path


def main() -> int:
    """The command line; 1 if anything broke."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"one of {', '.join(READERS)}; default all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000)
    options = parser.parse_args()
    memory = _MEMORY_WITH_RERUN if any(name.startswith("view-") for name in options.readers) else _MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    broken = False
    for name in options.readers or READERS:
        started = time.process_time()
        failures = campaign(name, options.seed, options.count, options.first)
        seconds = time.process_time() - started
        sys.stdout.write(f"{name}: {options.count} read in {seconds:.1f} s, {len(failures)} failures\n")
        sys.stdout.flush()
        for failure in failures:
            broken = True
            sys.stderr.write(f"{keep(name, failure)}\n{failure.how}\n")
    return 1 if broken else 0


if __name__ == "__main__":
    raise SystemExit(main())

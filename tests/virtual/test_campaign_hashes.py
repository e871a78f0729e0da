"""A seed is a run, on every machine, and whatever hash Python gives to texts."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import pytest

from tests.virtual.simulated import played

HASH = "03fcf3c605f11670"
"""Of the seeds 1 to 30."""
_PLAY = """
from evedrop.results.reading import Results
from evedrop.virtual import campaign
from tests.virtual.simulated import played, program
campaign.misses = lambda case, run, *rest: [run.digest, Results.read(run.folder).summary["outages"]]
print(campaign.play(1002, program).misses, played(1104)[2])
"""


@pytest.mark.parametrize(
    ("seeds", "expected"), [(3, "0a56e525dde26eb1"), pytest.param(30, HASH, marks=pytest.mark.campaign)]
)
def test_seeds_give_the_same_events_on_every_machine(seeds: int, expected: str) -> None:
    """To the byte, with every version of Python. A change of the programs may change a hash: then it is written here again."""
    total = hashlib.blake2b(digest_size=8)
    for seed in range(1, seeds + 1):
        total.update(played(seed)[2].encode())
    assert total.hexdigest() == expected


@pytest.mark.campaign
def test_the_order_of_texts_in_sets_decides_nothing() -> None:
    """The router of a run ends while others watch it: who heard first of whose end was in the order of a set.

    A wire mirrors several keys at once: their order was that of a set.
    """
    said = {
        subprocess.run(
            [sys.executable, "-c", _PLAY],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        ).stdout
        for seed in ("0", "3", "4", "7")
    }
    assert len(said) == 1

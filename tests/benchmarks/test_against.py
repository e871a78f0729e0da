"""`make bench-against`: what became slower than an earlier commit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
TAG = """
import sys
sys.path[:0] = [{benchmarks!r}]
from pathlib import Path
from against import last_tag, main
print(last_tag(Path({root!r})), main([], Path({root!r})))
"""
JUDGED = """
import sys
sys.path[:0] = [{benchmarks!r}]
from against import is_slower
print(*[is_slower(ratios) for ratios in {ratios!r}])
"""


COMPARED = """
import sys
sys.path[:0] = [{benchmarks!r}]
from against import Measurement, commands_a_second, compare
words = {words!r}
print(compare(iter([Measurement("a row", tuple(words), commands_a_second)]), {before!r}, 1))
"""


def said(code: str) -> str:
    """What a program prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.strip()


def test_a_row_is_slower_only_beyond_the_noise() -> None:
    """A median of less than 0.9 of before, and not one round as fast."""
    ratios = [(0.8, 0.85, 0.95), (0.8, 0.85, 1.01), (0.91, 0.92, 0.93), (1.2, 1.1, 1.3), (0.5,)]
    assert said(JUDGED.format(benchmarks=str(BENCHMARKS), ratios=ratios)) == "True False False False True"


def compared(words: list[str], before: str) -> list[str]:
    """The row of a command, and what became worse."""
    return said(COMPARED.format(benchmarks=str(BENCHMARKS), words=words, before=before)).splitlines()


@pytest.mark.thorough
def test_a_command_that_fails_now_is_worse_however_fast_it_fails() -> None:
    """And a command that only the earlier commit cannot carry out is left out."""
    row, worse = compared(["run", "no such scenario"], sys.executable)
    assert row.endswith("| fails now |")
    assert worse == "['a row']"
    study = ["montecarlo", "eavesdroppers", "--slots", "5", "--trials", "2", "--workers", "1"]
    row, worse = compared(study, str(BENCHMARKS / "no interpreter"))
    assert "not measured before" in row
    assert worse == "[]"


def test_without_a_tag_there_is_nothing_to_compare_with(tmp_path: Path) -> None:
    """It says so, and ends well."""
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    *line, last = said(TAG.format(benchmarks=str(BENCHMARKS), root=str(tmp_path))).splitlines()
    assert line == ["There is no tag yet, so there is nothing to compare with. BASE=COMMIT compares with a commit."]
    assert last == "None 0"


@pytest.mark.long
def test_every_command_is_compared() -> None:
    """With small sizes, an installation against itself: no row is left out."""
    command = [sys.executable, str(BENCHMARKS / "against.py"), "--python", sys.executable, "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line for line in done.stdout.splitlines() if line.startswith("| ")]
    assert len(rows) == 10
    assert "not measured" not in done.stdout
    assert "fails" not in done.stdout

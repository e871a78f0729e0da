"""`make bench`: a table of all metrics, whatever fails."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
GOOD = """
from table import Row, run_alone
run_alone(lambda quick: [Row("good", "1", "2", "3", "4", "yes")])
"""
FAILING = """
from table import Row, run_alone
def rows(quick):
    yield Row("before the failure", "1", "2", "3", "4", "no")
    raise ValueError("nothing to measure")
run_alone(rows)
"""
HANGING = "import time\ntime.sleep(600)\n"
MAIN = """
import sys
sys.path[:0] = [{benchmarks!r}]
from pathlib import Path
from bench import Family, main
limits = dict(failing=60.0, hanging=1.0, good=60.0)
sys.exit(main(False, [Family(Path({folder!r}) / f"{{name}}.py", limits[name]) for name in {names!r}]))
"""


def cells(line: str) -> list[str]:
    """The cells of a line of a Markdown table."""
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def bench_of(folder: Path, programs: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """The table of some programs instead of the real ones."""
    for name, code in programs.items():
        file = folder / f"{name}.py"
        file.write_text(f"import sys\nsys.path[:0] = [{str(BENCHMARKS)!r}]\n{code}", encoding="utf-8")
    code = MAIN.format(benchmarks=str(BENCHMARKS), folder=str(folder), names=list(programs))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.thorough
def test_programs_that_fail_or_hang_do_not_keep_the_others_from_running(tmp_path: Path) -> None:
    """They are rows of their own, after what they could measure, and the exit status is 1."""
    done = bench_of(tmp_path, {"failing": FAILING, "hanging": HANGING, "good": GOOD})
    rows = [cells(line) for line in done.stdout.splitlines() if line.startswith("| ")]
    assert rows == [
        ["what", "measured", "yardstick", "at least", "aim", "holds?"],
        ["before the failure", "1", "2", "3", "4", "no"],
        ["`failing.py`", "failed", "", "", "", "failed"],
        ["`hanging.py`", "failed", "", "", "", "failed"],
        ["good", "1", "2", "3", "4", "yes"],
    ]
    assert done.returncode == 1
    assert "failing.py ended with status 1" in done.stderr
    assert "ValueError: nothing to measure" in done.stderr
    assert "hanging.py did not end within 1 s" in done.stderr


def test_without_a_failure_the_exit_status_is_0(tmp_path: Path) -> None:
    """And the heading says on what machine, with which Python and of which commit the table is."""
    done = bench_of(tmp_path, {"good": GOOD})
    assert done.returncode == 0, done.stderr
    heading = done.stdout.splitlines()[0]
    assert re.match(
        r"`make bench`, \d{4}-\d\d-\d\d, commit .+, on .+, \d+ cores, Python 3\.\d+\.\d+\S*, kernels ", heading
    )


@pytest.mark.long
def test_every_metric_is_measured() -> None:
    """With small sizes, all programs run to their end and print each metric with its yardstick and its targets."""
    command = [sys.executable, str(BENCHMARKS / "bench.py"), "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    _, *rows = [cells(line) for line in done.stdout.splitlines() if line.startswith("| ")]
    assert len(rows) == 25
    for _, measured, yardstick, at_least, aim, holds in rows:
        assert re.search(r"\d", measured)
        assert all((yardstick, at_least, aim))
        assert holds in ("yes, and the aim", "yes", "no")

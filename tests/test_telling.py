"""A command that is forked finds what its PYTHONPATH has, as a new interpreter would."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
FORKED = """
import os
import sys
from tests import telling
assert sys.modules["sitecustomize"].__file__.startswith(sys.argv[1])
os.environ["PYTHONPATH"] = sys.argv[2]
telling.program = lambda: print("the command")
telling.program_with_path()
"""


def test_a_tests_sitecustomize_is_imported_where_the_distribution_has_one(tmp_path: Path) -> None:
    """Debian's and Ubuntu's Python import a `sitecustomize` when they start; that of a test is imported after it."""
    distribution, own = tmp_path / "distribution", tmp_path / "own"
    for folder in (distribution, own):
        folder.mkdir()
        (folder / "sitecustomize.py").write_text(f"print({folder.name!r})\n")
    environment = {**os.environ, "PYTHONPATH": f"{distribution}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-c", FORKED, str(distribution), str(own)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n") == ["distribution", "own", "the command", ""]

"""`python -m evedrop` imports modules from the current folder, as SECURITY.md says; `evedrop` does not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = "import sys; sys.argv = ['evedrop', *sys.argv[1:]]; from evedrop.__main__ import program; program()"


@pytest.mark.parametrize(("how", "runs"), [("-m", True), ("-P -m", False), ("script", False)])
def test_only_a_module_run_by_name_has_the_current_folder_on_the_path(how: str, runs: bool, tmp_path: Path) -> None:
    """A file `argcomplete.py` there is run, or not; the script `evedrop` has its own folder on the path."""
    here = tmp_path / "here"
    here.mkdir()
    for name in ("argparse", "argcomplete"):
        (here / f"{name}.py").write_text("import pathlib; pathlib.Path('ran').touch(); raise SystemExit\n")
    script = tmp_path / "bin" / "evedrop"
    script.parent.mkdir()
    script.write_text(SCRIPT)
    words = [str(script)] if how == "script" else [*how.split(), "evedrop"]
    subprocess.run([sys.executable, *words, "list"], cwd=here, capture_output=True, check=False, timeout=120)
    assert (here / "ran").exists() == runs

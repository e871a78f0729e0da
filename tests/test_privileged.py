"""Tests that a machine cannot run are skipped, fail nothing, and are named by a banner that has the last word."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.privileged import BANNER

ROOT = Path(__file__).parents[1]
FOLDERS = ("tests/containers", "tests/fresh", "tests/hosts")


@pytest.mark.long
def test_what_cannot_be_tested_is_said_loudly(tmp_path: Path) -> None:
    """The reason is that the user is not root or, for root, that the commands and apt-get are missing."""
    command = (sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "hosts or containers or fresh", *FOLDERS)
    where = {"PATH": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **where}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert " passed" not in done.stdout
    *lines, _ = done.stdout.splitlines()[-2 * len(FOLDERS) - 1 :]
    assert [banner.strip("!") for banner in lines[::2]] == [f" {BANNER}: {folder} " for folder in FOLDERS]
    assert all("it takes Linux and root" in reason or "there is no apt-get" in reason for reason in lines[1::2])

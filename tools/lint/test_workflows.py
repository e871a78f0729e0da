"""What CI runs is pinned, and a pull request gets no right to write."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
BY_TAG = {"pypa/cibuildwheel@v4.3.3"}
"""Actions whose commit nobody here could look up. Nothing else may join them."""
PINNED = re.compile(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+(\.\d+)*")


def jobs(text: str) -> list[str]:
    """The jobs of a workflow, each as text."""
    return re.split(r"^  (?=\w[\w-]*:$)", text.partition("\njobs:\n")[2], flags=re.MULTILINE)[1:]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_actions_are_pinned_by_their_commit(path: Path) -> None:
    """A tag can be moved to another commit; the comment says the version."""
    used = re.findall(r"uses: (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    assert used
    assert [action for action in used if not PINNED.fullmatch(action) and action not in BY_TAG] == []


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_only_jobs_of_a_release_may_write(path: Path) -> None:
    """The workflow reads; a job that writes packages runs for tags alone, and none runs with a pull request's base."""
    text = path.read_text(encoding="utf-8")
    assert "pull_request_target" not in text
    assert "\npermissions:\n  contents: read" in text.partition("\njobs:\n")[0]
    assert jobs(text)
    for job in jobs(text):
        if "write" in re.findall(r"^      \w+: (\w+)$", job, re.MULTILINE):
            assert "\n    if: startsWith(github.ref, 'refs/tags/v')\n" in job


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_packages_are_installed_by_their_hashes(path: Path) -> None:
    """Apart from the project itself, which needs none."""
    for line in re.findall(r".*pip install.*", path.read_text(encoding="utf-8")):
        assert "--require-hashes" in line or "--no-deps --no-build-isolation --editable ." in line

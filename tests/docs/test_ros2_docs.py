"""What the pages say of ROS 2: nothing has been run with its nodes, and they say so first."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "ros2.md").read_text(encoding="utf-8")


def test_the_first_paragraph_says_that_no_node_has_been_run() -> None:
    """And which parts of ROS 2 have not been tried: those that the end of the page lists."""
    _, first, *_ = PAGE.split("\n\n")
    assert "**This is tested against Zenoh sessions that imitate rmw_zenoh, not yet with real nodes.**" in re.sub(
        r"\s+", " ", first
    )
    assert "actions" not in re.sub(r"\s+", " ", first).partition("work across a wire")[0]
    assert "Not tested: real nodes, actions as a whole" in PAGE


def test_the_readme_says_so_too() -> None:
    """Where it links to the page."""
    assert "[not yet with nodes](docs/ros2.md)" in (ROOT / "README.md").read_text("utf-8")


def test_each_launch_has_the_same_losses() -> None:
    """Its wire has a folder of its own: in a fixed one, the second launch would continue the fates of the first."""
    launch = (ROOT / "docs" / "ros2" / "robot.launch.py").read_text(encoding="utf-8")
    assert re.findall(r"cmd=(.*?\])", launch) == ['["evedrop", "wire", str(WIRE)]']


def test_no_test_runs_a_node() -> None:
    """The day one does, these pages may say more."""
    tests = (path for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__).resolve())
    assert not [
        path for path in tests if re.search(r"^\s*(import|from) rclpy\b", path.read_text("utf-8"), re.MULTILINE)
    ]

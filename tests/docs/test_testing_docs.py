"""The page on scenarios as tests: its scenario passes, its CI jobs are right, and the plugin is declared."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from evedrop.cli import main as cli
from evedrop.studies.scenario_tests import Manner, Outcome, carry_out

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "testing.md").read_text(encoding="utf-8")
JOBS: list[dict[str, Any]] = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]


def test_the_scenario_of_the_page_passes(tmp_path: Path) -> None:
    """As it stands, in memory."""
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "page.toml").write_text(text, encoding="utf-8")
    result = carry_out(str(tmp_path / "page.toml"), Manner(in_memory=True, out=tmp_path / "out"))
    assert (result.outcome, result.reasons) == (Outcome.PASSED, ())


def test_the_ci_jobs_test_and_keep_the_report() -> None:
    """Each is YAML with the parts its server looks for; its command is one, and what it writes is what is kept."""
    github, gitlab = JOBS
    assert {"name", "jobs", True} == set(github)  # `on` is true in YAML 1.1
    (job,) = github["jobs"].values()
    steps = job["steps"]
    assert job["runs-on"].startswith("ubuntu")
    assert all(("uses" in step) != ("run" in step) for step in steps)
    (script,) = (job["script"] for job in gitlab.values())
    for commands, kept in (
        ([step["run"] for step in steps if "run" in step], steps[-1]["with"]["path"].split()),
        (script, [gitlab["scenarios"]["artifacts"]["reports"]["junit"], *gitlab["scenarios"]["artifacts"]["paths"]]),
    ):
        install, test = commands
        assert install == "pip install ./evedrop"
        options = cli.parser_of().parse_args(shlex.split(test)[1:])
        assert options.places == ["scenarios/"]
        assert kept == [str(options.junit), f"{options.out}/"]


@pytest.mark.parametrize("option", ["--evedrop-in-memory", "--evedrop-trials", "--evedrop-out", "--evedrop-scheduler"])
def test_every_option_of_the_plugin_is_on_the_page(option: str) -> None:
    """In its table, and in the plugin."""
    assert f"| `{option}" in PAGE
    assert f'"{option}"' in (ROOT / "emulator" / "evedrop" / "cli" / "pytest_plugin.py").read_text(encoding="utf-8")


def test_pytest_finds_the_plugin_where_the_package_is_installed() -> None:
    """By its entry point, which names a module that is there."""
    points = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    assert points["pytest11"] == {"evedrop": "evedrop.cli.pytest_plugin"}
    assert (ROOT / "emulator" / "evedrop" / "cli" / "pytest_plugin.py").is_file()

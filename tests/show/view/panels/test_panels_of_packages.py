"""Panels of installed packages: the tutorial's, and broken ones, which change nothing but the view."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evedrop import load_results, montecarlo
from evedrop.model.process import Floats
from evedrop.scenario.loading import load
from evedrop.show.view.scene_slots import replay
from tests.builders import digests_of
from tests.conftest import Evedrop
from tests.packages import install
from tests.show.view.read_back import rows

PAGE = Path(__file__).parents[4] / "docs" / "your-own" / "panel.md"
BLOCK = re.compile(r"^```(?:python|toml)\n# (\S+\.\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
GROUP = "evedrop.panels"
SLOTS = 60


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder in which this process finds packages."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None) or "").startswith(str(folder)):
            del sys.modules[name]


@pytest.fixture
def tutorial(site: Path) -> Path:
    """The package of the tutorial."""
    blocks = dict(BLOCK.findall(PAGE.read_text(encoding="utf-8")))
    entries = tomllib.loads(blocks["pyproject.toml"])["project"]["entry-points"]
    install(site, {"ratio.py": blocks["ratio.py"]}, entries)
    return site


def curve(rrd: Path, path: str) -> dict[int, float]:
    """A curve, by slot."""
    return {slot: value[0] for slot, value in rows(rrd, path, "Scalars:scalars").items()}


def expected_ratios(folder: Path, name: str) -> dict[int, float]:
    """log10 of the errors' ratio in every slot, from the results' table."""
    errors: dict[str, Floats] = {}
    floor = np.trace(load(folder / "scenario.toml").process.process.Q) / 100
    for peer in ("legitimate", name):
        table = sorted((row for row in load_results(folder).slots.to_pylist() if row["peer"] == peer), key=by_slot)
        errors[peer] = np.maximum([row["mean_squared_error"] for row in table], floor)
    return dict(enumerate(np.log10(errors[name] / errors["legitimate"]).tolist()))


def by_slot(row: dict[str, int]) -> int:
    """The order of a run."""
    return row["slot"]


@pytest.mark.long
def test_a_package_adds_a_panel_to_the_recording_of_a_live_run(tutorial: Path, evedrop: Evedrop) -> None:
    """The tutorial's file and line are enough."""
    environment = {**evedrop.environment, "PYTHONPATH": str(tutorial)}
    words = ("run", "eavesdroppers", "--slots", str(SLOTS), "--view", "web", "--out", "run")
    done = evedrop.process(*words, env=environment)
    assert "lacks" not in done.err
    run = evedrop.folder / "run"
    expected = expected_ratios(run, "naive")
    assert len(expected) == SLOTS
    assert curve(run / "recording.rrd", "ratio/naive") == pytest.approx(expected)


def test_a_package_adds_a_panel_to_the_recording_of_a_run_in_memory(tutorial: Path, tmp_path: Path) -> None:
    """The same file and line; of every eavesdropper, and not of the legitimate estimator."""
    assert tutorial.is_dir()
    montecarlo("eavesdroppers", trials=2, slots=SLOTS, out=tmp_path / "run")
    rrd = replay(tmp_path / "run")
    for name in ("naive", "smart"):
        assert curve(rrd, f"ratio/{name}") == pytest.approx(expected_ratios(tmp_path / "run", name))
    assert curve(rrd, "ratio/legitimate") == {}


HEAD = """
import sys
import numpy as np
from evedrop.extend import PlacedView, ViewPanel, curves_view, recent_slots, scalars


class Sound(ViewPanel):
    def views(self):
        return [PlacedView(curves_view("Sound", "sound", recent_slots(self.scene)), "right")]

    def columns(self, slots):
        return [scalars("sound", slots.numbers, slots.x[:, 0])]
"""
BROKEN = {
    "import": ("raise RuntimeError('not today')", "and the module broken_import cannot be imported (RuntimeError"),
    "class": ("class Other: pass", "and the module broken_class"),
    "base": ("class Mine: pass", "which is not a ViewPanel; expected a class that inherits from evedrop.extend.ViewPanel"),
    "abstract": ("class Mine(ViewPanel): pass", "which lacks columns, views"),
    "applies": ("class Mine(Sound):\n    applies = None", ": TypeError: 'NoneType' object is not callable"),
    "init": ("class Mine(Sound):\n    def __init__(self, scene): 1 / 0", ": ZeroDivisionError: division by zero, broken_init.py"),
    "views": ("class Mine(Sound):\n    def views(self): return [5]", ": TypeError: views() gave 5; expected a PlacedView"),
    "view": ("class Mine(Sound):\n    def views(self): return [PlacedView(5, 'left')]", ": ValueError: Unknown part type: 5"),
    "styles": ("class Mine(Sound):\n    def styles(self): return {'sound': 5}", ": TypeError: "),
    "slots": (
        "class Mine(Sound):\n    def columns(self, slots): return [scalars('sound', slots.numbers, slots.x[:-1, 0])]",
        ": ValueError: ",
    ),
    "exit": ("class Mine(Sound):\n    def columns(self, slots): sys.exit()", ": SystemExit"),
    "columns": ("class Mine(Sound):\n    def columns(self, slots): return 5", ": TypeError: 'int' object is not iterable"),
    "notes": ("class Mine(Sound):\n    def notes(self, notes): raise KeyError('k')", ": KeyError: 'k', broken_notes.py"),
    "writes": (
        "class Mine(Sound):\n    def columns(self, slots): slots.peers['naive'].x_hat[:] = 0.0",
        ": ValueError: assignment destination is read-only, broken_writes.py",
    ),
}  # fmt: skip
"""What a panel of a package does wrong → its class, and the expected message."""


def install_broken(site: Path) -> None:
    """A package with every broken panel, and one that is sound."""
    for case, (body, _) in BROKEN.items():
        (site / f"broken_{case}.py").write_text(f"{HEAD}\n\n{body}\n")
    (site / "sound.py").write_text(HEAD)
    install(site, {}, {GROUP: {case: f"broken_{case}:Mine" for case in BROKEN} | {"sound": "sound:Sound"}})


def check_warnings(text: str, prefix: str) -> None:
    """One line for every broken panel, and none besides."""
    lines = [line for line in text.splitlines() if "lacks" in line]
    for case, (_, message) in BROKEN.items():
        (line,) = [line for line in lines if re.match(f"{prefix}the view lacks the panel {case}[,:]", line)]
        assert message in line
    assert len(lines) == len(BROKEN)


def test_a_broken_panel_is_left_out_of_a_recording(
    site: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """One warning for each, whatever is wrong; the other panels, and the package's sound one, are whole."""
    montecarlo("eavesdroppers", trials=2, slots=SLOTS, out=tmp_path / "run")
    before = curve(replay(tmp_path / "run"), "error/naive")
    install_broken(site)
    capfd.readouterr()
    # A path of its own: the entry points of a path are looked up once.
    sys.path.insert(0, str(tmp_path))
    try:
        rrd = replay(tmp_path / "run")
    finally:
        sys.path.remove(str(tmp_path))
    check_warnings(capfd.readouterr().err, "evedrop: warning: ")
    assert curve(rrd, "error/naive") == before
    assert len(rows(rrd, "plane/Truth/at", "Points2D:positions")) == SLOTS
    assert sorted(curve(rrd, "sound")) == list(range(SLOTS))


@pytest.mark.long
def test_a_broken_panel_changes_nothing_of_a_live_run(site: Path, evedrop: Evedrop) -> None:
    """Status and digests are those without it, and the warnings are told while the run goes on."""
    words = ("run", "eavesdroppers", "--slots", str(SLOTS), "--set", "trials=2")
    plain = evedrop.process(*words, "--view", "off", "--out", "plain")
    install_broken(site)
    environment = {**evedrop.environment, "PYTHONPATH": str(site), "COLUMNS": "1000"}
    done = evedrop.process(*words, "--view", "web", "--out", "broken", env=environment)
    assert done.status == plain.status
    check_warnings(done.err, "warning: ")
    assert digests_of(evedrop.folder / "broken") == digests_of(evedrop.folder / "plain")
    rrd = evedrop.folder / "broken" / "recording.rrd"
    assert len(curve(rrd, "trace/naive")) == len(curve(rrd, "sound")) == SLOTS

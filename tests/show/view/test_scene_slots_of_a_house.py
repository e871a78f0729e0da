import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from evedrop import load_results, montecarlo
from evedrop.errors import UsageError
from evedrop.scenario.loading import checked, load
from evedrop.show.view.scene_slots import LoopValues, drawable, driven_scene, replay
from tests.builders import with_inputs
from tests.show.view.drawn import panels_are_filled
from tests.show.view.read_back import rows

SLOTS = 300


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first minutes of a house's day, in memory, around sunrise for there to be something to see."""
    folder = tmp_path_factory.mktemp("day") / "run"
    scenario = load("microgrid")
    assert scenario.plant is not None
    values = (scenario.plant.disturbance_values or [])[30_000 : 30_000 + SLOTS]
    tables = scenario.model_dump(mode="json", exclude_none=True)
    tables["plant"]["disturbance_values"] = values
    tables["slots"] = SLOTS
    montecarlo(checked(tables, "day"), trials=1, out=folder)
    return folder


def test_the_recording_holds_what_moves_the_plant(day: Path) -> None:
    """Disturbances and inputs of every slot, levels and the estimates of them, and energy bought and sold."""
    path = replay(day)
    results = load_results(day)
    assert results.inputs is not None
    inputs = results.inputs.to_pydict()
    u, d = np.array(inputs["u"]), np.array(inputs["d"])
    for i, expected in enumerate([d[:, 0], d[:, 1], u[:, 0], u[:, 1]]):
        shown = rows(path, f"moving/{i}", "Scalars:scalars")
        assert [shown[k][0] for k in range(SLOTS)] == expected.tolist()
    trials = [row for row in results.trials.to_pylist() if row["peer"] == "smart"]
    for i in range(2):
        shown = rows(path, f"levels/{i}/Truth", "Scalars:scalars")
        assert [shown[k][0] for k in range(SLOTS)] == [row["x"][i] for row in trials]
        shown = rows(path, f"levels/{i}/smart", "Scalars:scalars")
        assert [shown[k][0] for k in range(SLOTS)] == [row["x_hat"][i] for row in trials]
    house = results.summary["household"]
    for name in ("bought", "sold"):
        shown = rows(path, f"energy/{name}", "Scalars:scalars")
        assert shown[SLOTS - 1][0] == pytest.approx(house[f"{name}_energy"])


def test_the_house_is_drawn_as_the_tables_have_it(day: Path) -> None:
    """The words and the heights of the bars in every slot, from the true state and the powers."""
    path, results = replay(day), load_results(day)
    assert results.inputs is not None
    inputs = results.inputs.to_pydict()
    states = [row["x"] for row in results.trials.to_pylist() if row["peer"] == "smart"]
    words, bars = rows(path, "drawing/words", "Points2D:labels"), rows(path, "drawing/bars", "LineStrips2D:strips")
    for k, ((battery, hydrogen), (_, grid), (sun, drawn)) in enumerate(
        zip(states, inputs["u"], inputs["d"], strict=True)
    ):
        assert words[k][:3] == [f"battery {battery:.1f} %", f"hydrogen {hydrogen:.1f} %", f"load {drawn:.2f} kW"]
        assert words[k][3] == (f"to grid {-grid:.2f} kW" if grid < -0.005 else f"from grid {max(0.0, grid):.2f} kW")
        assert words[k][4] == f"sun {sun:.2f} kW"
        tops = [min(y for _, y in strip) - 0.07 for strip in bars[k]]
        assert tops == pytest.approx([5.4 - 2.2 * level / 100.0 for level in (battery, hydrogen)], abs=1e-4)


def test_guesses_are_shown_from_where_their_minute_began(day: Path) -> None:
    """One for each minute that is over, and the legitimate estimator's is near the load."""
    path = replay(day)
    shown = rows(path, "guesses/legitimate", "Scalars:scalars")
    assert sorted(shown) == [0, 60, 120, 180]
    load = rows(path, "guesses/Truth", "Scalars:scalars")
    (style,) = RrdReader(path).stream().filter(content="/guesses/Truth", is_static=True)
    assert style.to_record_batch().to_pydict()["SeriesLines:names"] == [["truth"]]
    for first, guess in shown.items():
        assert guess[0] == pytest.approx(np.mean([load[k][0] for k in range(first, first + 60)]), abs=0.8)


def test_slots_may_come_in_any_pieces() -> None:
    """As a live run has them, some tens or hundreds at a time: the same values, energies and guesses."""
    scenario = load("microgrid", {"slots": SLOTS})
    rng = np.random.default_rng(5)
    u = 5.0 * rng.standard_normal((SLOTS, 2))
    estimates = {name: 0.1 * rng.standard_normal((SLOTS, 2)) for name in scenario.receivers}
    results = []
    for cuts in ([0, SLOTS], [0, 1, 60, 61, 130, SLOTS]):
        loop_values = LoopValues.of(scenario)
        assert loop_values is not None
        pieces = [slice(first, end) for first, end in pairwise(cuts)]
        moves = [
            loop_values.take(with_inputs(u).rows(rows), {name: x[rows] for name, x in estimates.items()})
            for rows in pieces
        ]
        curves = {path: np.concatenate([move.curves[path] for move in moves], axis=1) for path in moves[0].curves}
        energies = np.stack([curves["energy/bought"][1], curves["energy/sold"][1]], axis=1)
        results.append((np.concatenate([move.values for move in moves]), energies, curves["guesses/naive"]))
    for whole, pieces_of_it in zip(*results, strict=True):
        assert np.allclose(whole, pieces_of_it, rtol=1e-12)
    values, energies, guesses = results[0]
    assert np.abs(values[:, 2]).max() == 1.5
    assert np.allclose(
        energies[-1], [np.maximum(values[:, 3], 0).sum() / 3600, np.maximum(-values[:, 3], 0).sum() / 3600]
    )
    assert guesses[0].tolist() == [0.0, 60.0, 120.0, 180.0]


def test_names_need_not_be_in_letters_of_the_viewers_font() -> None:
    """A headless viewer ends at another letter, and then draws no picture."""
    tables = load("microgrid").model_dump(mode="json", exclude_none=True)
    tables["process"]["states"], tables["plant"]["inputs"] = ["SOC", "水素"], ["燃料", "P_grid"]
    scene = driven_scene(checked(tables, "house"))
    words = [*scene["states"], *scene["moving"], *(panel.title for panel in scene["panels"])]
    words += [level.name for level in scene["drawing"].levels]
    words += [word for flow in scene["drawing"].flows for word in (flow.positive, flow.negative)]
    assert any("??" in word for word in words)
    assert words == [drawable(word) for word in words]


@pytest.mark.pictures
@pytest.mark.parametrize(("tab", "panels"), [("scene", 8), ("numbers", 11)])
def test_every_panel_of_a_house_is_filled(tab: str, panels: int, day: Path, tmp_path: Path) -> None:
    """Each draws something, and complains of nothing."""
    panels_are_filled(replay(day, tmp_path / "day.rrd"), tab, panels)


def test_inputs_that_do_not_fit_are_refused(day: Path, tmp_path: Path) -> None:
    """A table of inputs that is cut short is named."""
    import pyarrow.parquet as pq

    folder = tmp_path / "run"
    shutil.copytree(day, folder, ignore=shutil.ignore_patterns("*.rrd"))
    pq.write_table(pq.read_table(folder / "inputs.parquet").slice(0, 40), folder / "inputs.parquet")
    with pytest.raises(
        UsageError, match=r"inputs\.parquet does not have the slots of trials\.parquet; run the scenario again"
    ):
        replay(folder)

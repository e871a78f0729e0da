"""What the gallery shows of a built-in scenario: pictures, the verdict, and a recording of the view.

All of it is made in memory, from some hundreds of thousand trial-slots, and kept in build/gallery for as long as neither the
scenario nor the program changes. Nothing here needs a screen or a Vulkan driver.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
from card_drawing import Curve, Floats, Shown, card
from matplotlib.figure import Figure
from picture_folder import PICTURES, program_digest

from evedrop import Scenario, montecarlo
from evedrop.cli.api.results import RunResults
from evedrop.names import LEGITIMATE
from evedrop.scenarios import built_in_text
from evedrop.show.view.figure_style import OCHRE, SLATE, drawing
from evedrop.show.view.palette import ALARM, TRUTH_CURVE, hexadecimal, identities, paper_inks
from evedrop.show.view.scene_slots import replay
from evedrop.simulate.simulation import Simulation

_TRIAL_SLOTS = 200_000
_MOST_TRIALS = 200
_MOST_SLOTS = 5_000  # of the day in a house
_RECORDED_SLOTS = 1_500
_WHOLE = 400  # slots of a run whose dots move from its beginning to its end
_MOVED = 240  # slots of a longer one
_UNSTABLE = 1.01  # spectral radius
_REACH = 3.0
_THIS = b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in ("gallery_pictures", "card_drawing"))
_DARK_INK, _DARK_GRID = "#c9ccd6", "#3a3d4a"


@dataclass(frozen=True)
class Kept:
    """The files of a scenario."""

    folder: Path
    """`card.svg`, `card-light.svg`, the same with `-still`, `run.png`, `run-light.png` and `recording.rrd`."""
    verdict: str | None
    slots: int
    trials: int


def kept(name: str) -> Kept:
    """The files of a built-in scenario, made unless they are there."""
    digest = hashlib.sha256(program_digest() + _THIS + built_in_text(name).encode()).hexdigest()[:16]
    folder = PICTURES / f"{name}-{digest}"
    if not folder.exists():
        new = folder.with_suffix(".new")
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(parents=True)
        _make(name, new)
        for old in PICTURES.glob(f"{name}-{'[0-9a-f]' * 16}"):
            shutil.rmtree(old)
        new.rename(folder)
    facts: dict[str, Any] = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    return Kept(folder, **facts)


def _make(name: str, folder: Path) -> None:
    scenario = Scenario.load(name)
    slots = min(scenario.slots, _MOST_SLOTS)
    trials = min(_MOST_TRIALS, _TRIAL_SLOTS // slots)
    results = montecarlo(name, trials=trials, slots=slots)
    scenario = Scenario.load(results.folder)
    attacked = "integrity" in scenario.applications
    for theme, figure in (
        ("-light", _attack_figure(scenario, results) if attacked else results.plot()),
        ("", darkened(_attack_figure(scenario, results) if attacked else results.plot())),
    ):
        figure.savefig(folder / f"run{theme}.png", dpi=110, transparent=True)
    for dark, theme in ((True, ""), (False, "-light")):
        shown = _shown(scenario, results, dark=dark)
        (folder / f"card{theme}.svg").write_text(card(shown, dark=dark), encoding="utf-8")
        (folder / f"card-still{theme}.svg").write_text(card(shown, dark=dark, moves=False), encoding="utf-8")
    recorded = results if slots <= _RECORDED_SLOTS else montecarlo(name, trials=1, slots=_RECORDED_SLOTS)
    replay(recorded.folder, folder / "recording.rrd")
    verdict = None if results.verdict is None else results.verdict.sentence
    facts = {"verdict": verdict, "slots": slots, "trials": trials}
    (folder / "facts.json").write_text(json.dumps(facts), encoding="utf-8")


def _inks(scenario: Scenario, *, dark: bool) -> dict[str, str]:
    strategies = {name: table.strategy for name, table in scenario.eavesdroppers.items()}
    if not dark:
        return paper_inks(scenario.receivers, strategies)
    return {
        name: hexadecimal(colour)
        for name, colour in identities({name: strategies.get(name, name) for name in scenario.receivers}).items()
    }


def _shown(scenario: Scenario, results: RunResults, *, dark: bool) -> Shown:
    """What the card of a run shows: the run of trial 0, and the mean errors of all trials."""
    inks = _inks(scenario, dark=dark)
    slots = scenario.slots
    if "integrity" in scenario.applications:
        attack = _Attack.of(scenario, results)
        curves = [Curve(SLATE if not dark else _DARK_INK, attack.statistic)]
        curves.append(Curve(hexadecimal(ALARM), np.full(slots, attack.threshold), dashed=True))
        return Shown(
            scenario.title, range(slots), slots, attack.truth, {LEGITIMATE: attack.estimate}, inks, curves, False
        )
    trials = results.trials.filter(_is(results.trials["trial"], 0))
    rows = {name: trials.filter(_is(trials["peer"], name)) for name in inks}
    whole = slots <= _WHOLE or bool(scenario.event) or scenario.controller is not None
    span = range(slots) if whole else range(slots - _MOVED, slots)
    places = {name: _states(table, "x_hat")[span.start :, :2] for name, table in rows.items()}
    truth = _states(rows[LEGITIMATE], "x")[span.start :, :2]
    curves = [
        Curve(inks[name], _of_slots(results, name, ("mean_squared_error", "mean_actual_trace_covariance")))
        for name in inks
    ]
    if scenario.controller is None and np.abs(np.linalg.eigvals(np.array(scenario.process.A))).max() > _UNSTABLE:
        # The truth grows until nothing else can be seen: errors are shown in its place, as far as the estimator's go.
        errors = {name: values - truth for name, values in places.items()}
        reach = _REACH * np.abs(errors[LEGITIMATE]).max(axis=0)
        return Shown(scenario.title, span, slots, np.zeros_like(truth), errors, inks, curves, reach=reach)
    return Shown(scenario.title, span, slots, truth, places, inks, curves)


def _is(column: Any, value: object) -> Any:
    return pc.equal(column, value)


def _states(table: Any, column: str) -> Floats:
    return np.array(table[column].to_pylist(), np.float64)


def _of_slots(results: RunResults, name: str, columns: tuple[str, ...]) -> Floats:
    table = results.slots.filter(_is(results.slots["peer"], name))
    column = next(column for column in columns if column in table.column_names and table[column].null_count == 0)
    return np.array(table[column].to_pylist(), np.float64)


@dataclass(frozen=True)
class _Attack:
    """An attack on measurements in trial 0."""

    truth: Floats
    """(slots, 1): the first true state."""
    estimate: Floats
    """(slots, 1): what the controller takes for it."""
    inputs: Floats
    """(slots,): the first input."""
    statistic: Floats
    threshold: float
    begins: int

    @classmethod
    def of(cls, scenario: Scenario, results: RunResults) -> _Attack:
        """That of a scenario, simulated again for the true states, which results do not have."""
        chunks = [chunk.slots for chunk in Simulation(scenario, range(1)).chunks() if chunk.slots is not None]
        rows = results.inputs.filter(_is(results.inputs["trial"], 0))
        integrity = results.summary["integrity"]
        return cls(
            np.concatenate([slots.sensor.states[:, :1, 0] for slots in chunks]),
            np.concatenate([slots.receivers[LEGITIMATE].x_hat[:, :1, 0] for slots in chunks]),
            _states(rows, "u")[:, 0],
            np.array(rows["statistic"].to_pylist(), np.float64),
            float(integrity["threshold"]),
            int(integrity["attack_from"]),
        )


def _attack_figure(scenario: Scenario, results: RunResults) -> Figure:
    """The true state beside the estimate that the controller acts on, its input, and the detector's statistic."""
    attack = _Attack.of(scenario, results)
    process, plant = scenario.process, scenario.plant
    state = (process.states or ["x"])[0]
    entry = (plant.inputs if plant is not None else ["u"])[0]
    ink = paper_inks([LEGITIMATE], {})[LEGITIMATE]
    with drawing(8.4, 7.6) as figure:
        world, inputs, evidence = figure.subplots(3, 1, sharex=True)
        world.plot(attack.truth[:, 0], color=hexadecimal(TRUTH_CURVE), linewidth=2.6, label=f"true {state}")
        world.plot(attack.estimate[:, 0], color=ink, linewidth=1.2, label="the controller's estimate")
        world.set_title(f"{scenario.title}; trial 0")
        world.set_ylabel(state)
        inputs.plot(attack.inputs, color=OCHRE, linewidth=1.2, label=f"input {entry}")
        inputs.set_ylabel(entry)
        evidence.plot(attack.statistic, color=hexadecimal(TRUTH_CURVE), label="the detector's statistic")
        evidence.axhline(attack.threshold, color=hexadecimal(ALARM), linestyle="--", label="threshold: alarm")
        evidence.set_ylabel("evidence (nats)")
        evidence.set_xlabel("slot")
        for axes in (world, inputs, evidence):
            axes.axvline(attack.begins, color=hexadecimal(ALARM), linewidth=0.8, label="the attack begins")
            axes.legend(loc="upper left")
    return figure


def darkened(figure: Figure) -> Figure:
    """A figure for a dark page: letters, axes and grids are light; colours of curves stay."""
    for text in figure.findobj(lambda artist: hasattr(artist, "set_fontsize") and hasattr(artist, "set_color")):
        if text.get_color() in ("black", "#000000", "k"):
            text.set_color(_DARK_INK)
    for axes in figure.axes:
        axes.set_facecolor("none")
        axes.tick_params(colors=_DARK_INK, which="both")
        for spine in axes.spines.values():
            spine.set_edgecolor(_DARK_INK)
        for line in (*axes.get_xgridlines(), *axes.get_ygridlines()):
            line.set_color(_DARK_GRID)
    for legend in [axes.get_legend() for axes in figure.axes] + figure.legends:
        if legend is not None:
            legend.get_frame().set(facecolor="#1e2129", edgecolor=_DARK_GRID)
    return figure

"""Converts a run to the view's form: its scene at the start, and its slots as they are scored."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import Scored
from evedrop.score.slots import Slots
from evedrop.system.output import warn

if TYPE_CHECKING:
    from evedrop.show.view.plant_slots import LoopValues
    from evedrop.show.view.recording import ViewRecording


def loop_values_of(scenario: Scenario) -> LoopValues | None:
    """An object that follows the trial of a closed loop that the view shows; None without a controller."""
    from evedrop.show.view.plant_slots import LoopValues  # noqa: PLC0415 - only with a view

    return LoopValues.of(scenario)


def open_recording(
    scenario: Scenario,
    run: str,
    path: Path,
    warn: Callable[[str], None] = warn,
    words: Mapping[str, str] | None = None,
    unknown_links: Collection[str] = (),
) -> ViewRecording:
    """Begin the run's recording on disk.

    run: its name; warn: as in ViewRecording; words: receiver → the name of its scheme or strategy, if not that of the scenario;
    unknown_links: receivers whose link has a quality that is not that of the scenario, and unknown.
    """
    from evedrop.show.view.glyphs import drawable  # noqa: PLC0415 - only with a view
    from evedrop.show.view.plant_slots import driven_scene  # noqa: PLC0415 - only with a view
    from evedrop.show.view.recording import ViewRecording  # noqa: PLC0415 - saves 0.3 s and 100 MB in a run without a view
    from evedrop.show.view.scene import Scene, Shown  # noqa: PLC0415 - the same

    quality = scenario.quality
    described = {
        LEGITIMATE: scenario.encoding.scheme,
        **{name: table.strategy for name, table in scenario.eavesdroppers.items()},
    }
    receivers = [
        Shown(
            name,
            "legitimate" if name == LEGITIMATE else "eavesdropper",
            {**described, **(words or {})}[name],
            None if name in unknown_links else quality[name],
        )
        for name in scenario.receivers
    ]
    ways = {name: scenario.link(name).model.ways for name in scenario.receivers if name not in unknown_links}
    scene = Scene(
        title=drawable(scenario.title),
        run=run,
        slots=scenario.slots,
        trials=scenario.trials,
        n=len(scenario.process.A),
        pace=scenario.pace,
        receivers=tuple(receivers),
        noise=float(np.trace(scenario.process.process.Q)),
        units=tuple(map(drawable, scenario.process.units or ())),
        ways={name: ways for name, ways in ways.items() if ways is not None},
        **driven_scene(scenario),
    )
    return ViewRecording(path, scene, warn)


def shown(
    slots: Slots, scored: Mapping[str, Scored], around: Sequence[float], loop_values: LoopValues | None = None
) -> Any:
    """Some slots as `SceneSlots`: the first recorded trial, in absolute values, and means over all trials.

    around: the reference from which states are deviations, (n,); loop_values: follows the same trial of a closed loop.
    """
    from evedrop.show.view.scene import PeerSlots, SceneSlots  # noqa: PLC0415 - only with a view

    peers = {
        name: PeerSlots(
            x_hat=receiver.x_hat[:, :, 0] + around,
            P=receiver.P[:, :, :, 0],
            action=receiver.action[:, 0],
            squared_error=np.asarray(scored[name].squared_error.mean(axis=1)),
            standard_error=scored[name].sums.standard_errors,
            trace=receiver.trace[:, 0] / slots.trials,
            expected_trace=scored[name].expected,
        )
        for name, receiver in slots.receivers.items()
    }
    moved = None
    if loop_values is not None and slots.inputs is not None:
        estimates = {name: receiver.x_hat[:, :, 0] for name, receiver in slots.receivers.items()}
        monitored = None if slots.inputs.monitored is None else slots.inputs.monitored.part(slice(0, 1))
        moved = loop_values.take(slots.inputs.u[:, :, 0], estimates, monitored)
    sent = None if slots.sent is None else slots.sent[:, 0]
    return SceneSlots(slots.first, slots.x[:, :, 0] + around, slots.nu[:, 0], peers, moved, sent)

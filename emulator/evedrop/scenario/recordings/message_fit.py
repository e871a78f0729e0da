"""The fit of recorded messages: a link for a wire, whose delays are in seconds, and for a scenario, in slots.

Source: docs/links.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from evedrop.model.checks import toml_of
from evedrop.scenario.recordings.link_candidates import rounded
from evedrop.scenario.recordings.link_fit import FEWEST_DELAYS, Fit, fit_outcomes, headline, model_lines
from evedrop.scenario.recordings.message_recording import COUNTS, MessageRecording


@final
@dataclass(frozen=True)
class MessageFit:
    """The result of fitting recorded messages."""

    recording: MessageRecording
    fit: Fit
    """Of losses, and of delays in seconds."""
    slot: float | None
    """Seconds of a slot in a scenario; None: not known."""

    @property
    def settings(self) -> dict[str, Any]:
        """The entries of a link in a wire file, without its sides and keys."""
        return {**self.fit.link, **self._chances}

    @property
    def wire_toml(self) -> str:
        """The link for a wire file."""
        recording = self.recording
        entries = {"from": recording.source, "to": recording.target, "keys": recording.keys, **self.settings}
        return "\n".join(["[[link]]", *(f"{name} = {toml_of(value)}" for name, value in entries.items())])

    @property
    def scenario_link(self) -> dict[str, Any] | None:
        """The link of a scenario, where a message is a slot; None if there are delays, and no slot has a known length."""
        chosen = self.fit.chosen_delay
        if chosen is None:
            return {**self.fit.link, **self._chances}
        if self.slot is None:
            return None
        delay = {
            name: rounded(value / self.slot) if name in _IN_SECONDS else value for name, value in chosen.spec.items()
        }
        return {**self.fit.link, "delay": delay, **self._chances}

    @property
    def _chances(self) -> dict[str, float]:
        series, corrupt = self.recording.series, self.recording.corrupt or 0.0
        # A message that was damaged or dropped does not arrive twice.
        whole = float(series.outcomes.sum()) * (1.0 - corrupt) - self.recording.dropped
        chances = {"duplicate": min(1.0, series.repeated / whole) if whole else 0.0, "corrupt": corrupt}
        return {name: rounded(value) for name, value in chances.items() if value}

    def as_dict(self) -> dict[str, Any]:
        """The fit as JSON values."""
        series, link = self.recording.series, self.scenario_link
        return {
            **self.fit.as_dict(),
            **{name: getattr(series, name) for name in COUNTS},
            "outages": list(series.outages),
            "notes": list(self.recording.notes),
            "settings": self.settings,
            "wire": self.wire_toml,
            "slot_seconds": self.slot,
            "link": link,
            "toml": None if link is None else f"link = {toml_of(link)}",
        }


_IN_SECONDS = frozenset({"value", "mean", "standard_deviation", "least"})
"""The parameters of delay models that are times."""


def fit_messages(recording: MessageRecording, slot: float | None = None) -> MessageFit:
    """Find the models that may have produced recorded messages.

    slot: seconds of a slot; None: the median time between two messages.

    Raises TraceError if nothing can be estimated.
    """
    delays = recording.delays if len(recording.delays) >= FEWEST_DELAYS and recording.delays.any() else np.empty(0)
    return MessageFit(
        recording, fit_outcomes(recording.name, recording.series.outcomes, delays), slot or recording.series.seconds
    )


def message_lines(fitted: MessageFit) -> list[str]:
    """The fit as printed lines."""
    fit = fitted.fit
    told = [headline(fit, "messages", "message")]
    told += [f"  {sentence}" for sentence in (*_counted(fitted), *fitted.recording.notes)]
    told += [*model_lines(fit, "message"), "# for a wire file:", fitted.wire_toml]
    link = fitted.scenario_link
    if link is None:
        return [*told, "# a scenario needs the length of a slot: give --slot SECONDS"]
    if fit.chosen_delay is None:
        return [*told, "# for a scenario in which a message is a slot:", f"link = {toml_of(link)}"]
    each = "" if fitted.slot == fitted.recording.series.seconds else ", each with one message"
    return [*told, f"# for a scenario with slots of {fitted.slot:.4g} s{each}:", f"link = {toml_of(link)}"]


def _counted(fitted: MessageFit) -> list[str]:
    """What else happened to the messages, in sentences."""
    series = fitted.recording.series
    told = []
    if series.repeated:
        told.append(f"{series.repeated} arrived twice")
    if series.late:
        told.append(f"{series.late} arrived after a later one")
    if series.restarts:
        told.append(f"the numbers began again {_times(series.restarts)}: the sender was started again")
    if series.leaps:
        told.append(
            f"the numbers leapt ahead {_times(series.leaps)} faster than messages could be lost: not counted as losses"
        )
    if series.outages:
        told.append(
            f"silences longer than --outage: {len(series.outages)}, the longest of {max(series.outages):.4g} s; "
            "not counted as losses; in a wire file they are an [[event]] with cut"
        )
    if series.parts > 1:
        told.append(f"{series.parts} parts, joined: losses between two parts are not known")
    return told


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"

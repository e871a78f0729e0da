"""Verifies the claims of receivers and sensor against the receivers' own reports and the router's journal.

For the recorded trials a receiver reports everything that enters its digests, so the recorder computes the digests again.
For all trials it reports whether it received a packet in each slot, and so does the router. Claims that can be checked
neither way rest on the receiver's word alone.

Source: docs/results.md, what is verified.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import numpy as np

from evedrop.errors import Contradiction
from evedrop.live.protocol.telemetry import Extent, Report
from evedrop.model.digest import Blocks, PartialDigests
from evedrop.model.kernels.current import kernels
from evedrop.model.process import Floats
from evedrop.model.receiver import Action, Belief, Flags
from evedrop.model.slot.records import LinkSlots, ReceiverSlots
from evedrop.names import ROUTER, SENSOR
from evedrop.scenario.closed_loop import monitor_of
from evedrop.scenario.tables import Scenario
from evedrop.score.links import chart_of
from evedrop.score.slots import Slots

_ROUNDING = 1e-9  # sums of a thousand traces in different orders differ by less


@final
class Verifier:
    """Checks the reports of all receivers of a run, in the order of their slots."""

    def __init__(self, blocks: Mapping[str, Blocks], recorded: int, first_trial: int) -> None:
        """blocks: receiver → its digests' blocks; recorded: how many trials are reported in full; first_trial: their first."""
        self._block_sums: dict[str, tuple[Floats, float]] = {}
        self._blocks, self._recorded, self._first_trial = blocks, recorded, first_trial
        self._digests: dict[str, PartialDigests] = {}
        self._leaving: dict[tuple[str, int], Belief] = {}
        """Receiver and first slot of its absence → its final belief, until its report of the slot before is there."""
        self._reported: dict[str, ReceiverSlots] = {}
        """Receiver → its latest report."""

    def left(self, name: str, k: int, belief: Belief) -> None:
        """Take a receiver's final belief before slot k, the first slot of its absence. Raises Contradiction as `report` does."""
        latest = self._reported.get(name)
        if latest is not None and latest.slots.stop == k:
            self._check_leaving(name, latest, belief)
        else:
            self._leaving[name, k] = belief

    @np.errstate(over="ignore", invalid="ignore")  # a receiver may have made its numbers up
    def report(self, name: str, report: Report) -> None:
        """Check a receiver's next report. Raises Contradiction if the report contradicts itself."""
        slots = report.slots
        self._check_traces(name, slots)
        end = slots.slots.stop
        if (left := self._leaving.pop((name, end), None)) is not None:
            self._check_leaving(name, slots, left)
        self._reported[name] = slots
        first, blocks = slots.first, self._blocks[name]
        some = slice(0, self._recorded)
        while first < end:
            stop = min(end, blocks.end(first))
            rows = slots.rows(slice(first - slots.first, stop - slots.first))
            partial = self._digests.setdefault(name, PartialDigests(self._recorded))
            partial.add(rows.x_hat[..., some], rows.P, rows.action[:, some])
            if rows.x_hat.shape[2] > self._recorded:
                self._add_to_block(name, rows)
                if stop == blocks.end(first):
                    self._check_block_sums(name, report, blocks.start(first), stop)
            if stop == blocks.end(first):
                self._check_digests(name, report, blocks.start(first), stop)
            first = stop

    def _check_digests(self, name: str, report: Report, start: int, stop: int) -> None:
        digests = self._digests[name].finished()
        claimed = report.digests[start][: self._recorded]
        if place := _first((digests != claimed).any(axis=1)):
            (r,) = place
            raise Contradiction(
                name,
                f"its digest of slots {start} to {stop - 1} of trial {self._first_trial + r} is {claimed[r].tobytes().hex()}, "
                f"and what it reported of these slots gives {digests[r].tobytes().hex()}",
            )

    def _add_to_block(self, name: str, slots: ReceiverSlots) -> None:
        """Add slots of one block to the sums of tr P of the recorded trials, and to the sum over all trials."""
        before = self._block_sums.get(name, (np.zeros(self._recorded), 0.0))
        traces = kernels.traces(slots.P)
        self._block_sums[name] = (before[0] + traces.sum(axis=0), before[1] + float(_sums_of(slots)[:, 0].sum()))

    def _check_block_sums(self, name: str, report: Report, start: int, stop: int) -> None:
        """Check that the sums of tr P of a block's trials are those of the recorded trials, and of all trials together."""
        of_recorded, of_all = self._block_sums.pop(name)
        claimed = report.trace_sums[start]
        sums = np.append(of_recorded, of_all)
        stated = np.append(claimed[: self._recorded], claimed.sum())
        if place := _first(~(np.abs(stated - sums) <= _ROUNDING * np.maximum(np.abs(sums), np.abs(stated)))):
            which = "all trials" if place == (self._recorded,) else f"trial {self._first_trial + place[0]}"
            raise Contradiction(
                name,
                f"its sum of tr P over slots {start} to {stop - 1} of {which} is {stated[place]:.17g}, and what it reported of "
                f"these slots gives {sums[place]:.17g}",
            )

    def _check_traces(self, name: str, slots: ReceiverSlots) -> None:
        """Check that the sums of tr P over all trials are possible given the recorded trials; equal, if all are recorded."""
        traces = kernels.traces(slots.P)
        trials, claimed = slots.x_hat.shape[2], _sums_of(slots)
        others = trials - traces.shape[1]
        sums_ = kernels.sums(traces)
        size = np.stack([np.sqrt(trials * np.abs(claimed[:, 1])), np.abs(claimed[:, 1])], axis=1)
        left = claimed - sums_
        if others == 0:
            wrong = (np.abs(left) > _ROUNDING * np.maximum(size, np.abs(sums_))).any(axis=1)
        else:
            # For any numbers: |sum| ≤ √(count · sum of squares). The remaining sum of squares is known within rounding.
            squares = left[:, 1] + _ROUNDING * size[:, 1]
            room = np.sqrt(others * np.maximum(squares, 0.0)) + _ROUNDING * size[:, 0]
            wrong = (squares < 0.0) | (np.abs(left[:, 0]) > room)
        if place := _first(wrong):
            (row,) = place
            sums = [f"{value:.17g}" for value in (*claimed[row], *sums_[row])]
            raise Contradiction(
                name,
                f"its sums of tr P and of (tr P)² in slot {slots.first + row} are {sums[0]} and {sums[1]}, and those of the "
                f"recorded trials, {traces.shape[1]} of {trials}, are {sums[2]} and {sums[3]}",
            )

    def _check_leaving(self, name: str, slots: ReceiverSlots, left: Belief) -> None:
        """Check that a receiver's final belief is the one in its report of its last slot."""
        end = slots.slots.stop
        for quantity, on_leaving, reported in (
            ("x_hat", left.x_hat, slots.x_hat[-1]),
            ("P", left.P[..., : self._recorded], slots.P[-1]),
        ):
            if on_leaving.tobytes() != np.ascontiguousarray(reported).tobytes():
                place = _first(on_leaving != reported) or (0,)
                raise Contradiction(
                    name,
                    f"before slot {end}, with which it goes away, its {quantity} of trial {self._first_trial + place[-1]} is "
                    f"{on_leaving[place]}, and in its report of slot {end - 1} it is {reported[place]}",
                )

    def joined(self, slots: Slots) -> None:
        """Check joined slots against the journal. Raises Contradiction if they disagree."""
        for name, receiver in slots.receivers.items():
            self._check_received(name, receiver, slots.links[name])
            if slots.sensor.sent is not None:
                self._check_sent(slots.sensor.sent, slots.links[name])

    def _check_received(self, name: str, receiver: ReceiverSlots, link: LinkSlots) -> None:
        received = receiver.action != int(Action.LOST)
        if place := _first(received != link.delivered):
            row, r = place
            says = "that it received the packet" if received[row, r] else "that it received nothing"
            journal = "that it was delivered" if link.delivered[row, r] else "that it was not delivered"
            raise Contradiction(
                name,
                f"in slot {link.first + row}, trial {self._first_trial + r}, it says {says} (action "
                f"{int(receiver.action[row, r])}), but the journal says {journal}",
                ROUTER,
            )
        if receiver.late is None or link.late is None:
            return
        if place := _first(receiver.late != link.late):
            row, r = place
            raise Contradiction(
                name,
                f"in slot {link.first + row}, trial {self._first_trial + r}, it says that {int(receiver.late[row, r])} late "
                f"packets arrived, but the journal says {int(link.late[row, r])}",
                ROUTER,
            )

    def _check_sent(self, sent: Flags, link: LinkSlots) -> None:
        """Check the sensor's report of the packets that it sent, (c, R), against the journal."""
        silent = np.count_nonzero(~sent, axis=1)
        if place := _first((silent != link.unsent) | (link.delivered & ~sent).any(axis=1)):
            (row,) = place
            raise Contradiction(
                SENSOR,
                f"in slot {link.first + row} it says that {int(silent[row])} trials sent nothing, but the journal says "
                f"{int(link.unsent[row])}, or that a packet of one of them was delivered",
                ROUTER,
            )


def _first(wrong: Flags) -> tuple[int, ...] | None:
    """The first place where something is wrong; None if nothing is."""
    return tuple(np.argwhere(wrong)[0].tolist()) if wrong.any() else None


def _sums_of(slots: ReceiverSlots) -> Floats:
    """The sums of traces over all trials, (c, 2), which every report has."""
    assert slots.trace is not None  # noqa: S101 - else the message would have been refused
    return slots.trace


def extent_of(scenario: Scenario, batch: int) -> Extent:
    """The dimensions of a run, which its messages must have; batch: slots of a report."""
    plant = scenario.driven
    return Extent(
        scenario.slots,
        batch,
        len(scenario.process.A),
        scenario.trials,
        scenario.record_trials,
        0 if plant is None or scenario.controller is None else plant.inputs,
        plant is not None and plant.output_matrix is not None,
        monitor_of(scenario) is not None,
        scenario.scheme.may_be_silent,
        chart_of(scenario) is not None,
    )

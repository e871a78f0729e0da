"""Theory's expectation for each receiver of a scenario, as far as theory covers its link.

A receiver whose slots differ has a closed form, as the scheme's class states it.

Source: docs/mathematics/schemes.md, acknowledged references, schedules by holding time and noise packets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, final

import numpy as np

from evedrop.model import modulated
from evedrop.model.acknowledgements import heed_rule_of, rates_of
from evedrop.model.links import loss_of
from evedrop.model.links.trace import RecordedLoss
from evedrop.model.modulated import modulated_streaks
from evedrop.model.outcomes import eavesdropper_outcomes, legitimate_outcomes, uses_of
from evedrop.model.process import Floats, Process, parts_of
from evedrop.model.schedule import in_slot
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link_distribution import LinkDistribution, distribution_of
from evedrop.model.theory import covariances as theory
from evedrop.model.theory.closed_forms import ClosedForm, Hijack, ReceiverConditions
from evedrop.model.theory.covariances import Growth, Outcomes, OutcomesAt, SlotOutcomes, TheoreticalCovariance, growth
from evedrop.model.theory.rare_events import Streaks, rare_in_slots, streaks, total_of
from evedrop.names import LEGITIMATE
from evedrop.scenario.tables import Scenario

Split = tuple[float, float]


def closed_of(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """A receiver's closed form; None if scheme and strategy have none, or the links violate its assumptions."""
    form = stated_form(scenario, receiver)
    return _of_scheme(scenario, receiver) if form is None else form


def stated_form(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """The closed form that the scheme's class states for a receiver in `Scheme.closed_forms`; None as for `closed_of`."""
    reader = LEGITIMATE if receiver == LEGITIMATE else scenario.eavesdroppers[receiver].strategy
    make = SCHEMES[scenario.encoding.scheme].closed_forms.get(reader)
    if make is None:
        return None
    return make(scenario.make_scheme(), conditions_of(scenario, receiver))


def _of_scheme(scenario: Scenario, receiver: str) -> ClosedForm | None:
    """What the scheme itself knows of an eavesdropper's strategy; None for one that learns more than packets tell."""
    if receiver == LEGITIMATE or receiver in scenario.leaks:
        return None
    scheme, table = scenario.make_scheme(), scenario.eavesdroppers[receiver]
    received = scenario.quality[receiver] if _independent(scenario, receiver) else None
    return scheme.closed_form(table.reads_as or table.strategy, received, scenario.slots)


def conditions_of(scenario: Scenario, receiver: str) -> ReceiverConditions:
    """What theory knows of a receiver's link and of the acknowledgements."""
    eavesdropper = None if receiver == LEGITIMATE else scenario.eavesdroppers[receiver]
    return ReceiverConditions(
        slots=scenario.slots,
        legitimate=receiver == LEGITIMATE,
        received=scenario.quality[receiver] if _independent(scenario, receiver) else None,
        uses=None if eavesdropper is None else uses_of(eavesdropper.strategy, eavesdropper.parameters),
        acknowledged=_split(scenario, receiver) if _alike(scenario, receiver) else None,
        forged=scenario.forges_acknowledgements,
        hijack=_hijack(scenario, receiver),
    )


def _alike(scenario: Scenario, receiver: str) -> bool:
    """Whether there are acknowledgements with the same probabilities in all slots, and the receiver hears as often in all slots.

    They have these with links of independent losses without delay, and an attack that is always on or always off.
    """
    table = scenario.acknowledgements
    if table is None or (table.attack != "none" and scenario.timeline.jams is not None):
        return False
    needed = {LEGITIMATE, receiver} | ({table.jammer} if table.jammer is not None else set())
    return all(_independent(scenario, name) for name in needed)


def _hijack(scenario: Scenario, receiver: str) -> Hijack | None:
    """The hijacked sensor, if it depends on more than the last packet: if α > μ_e, and some acknowledgements are lost."""
    table, quality = scenario.acknowledgements, scenario.quality
    if table is None or table.jammer is None:
        return None
    jammer = table.jammer
    heed_rule = heed_rule_of(table.attack, table.link.quality, quality[jammer])
    if heed_rule is None or heed_rule.patience == 0:
        return None

    def hears(legitimate: bool, served: bool) -> float:
        if receiver == LEGITIMATE:
            return float(legitimate)
        return float(served) if receiver == jammer else quality[receiver]

    return Hijack(quality[LEGITIMATE], quality[jammer], heed_rule, hears)


def _split(scenario: Scenario, receiver: str) -> Split:
    table, quality = scenario.acknowledgements, scenario.quality
    assert table is not None  # noqa: S101 - asked by the caller
    mu, alpha, flip = quality[LEGITIMATE], table.link.quality, table.flip or 0.0
    if receiver == LEGITIMATE:
        mu_e = 1.0 if table.jammer is None else quality[table.jammer]
        return rates_of(table.attack, mu, mu_e, alpha, flip).legitimate
    if table.jammer in (None, receiver):
        return rates_of(table.attack, mu, quality[receiver], alpha, flip).eavesdropper
    arrives = rates_of(table.attack, mu, quality[table.jammer], alpha, flip).arrives
    return arrives * quality[receiver], arrives * (1.0 - quality[receiver])


def _independent(scenario: Scenario, receiver: str) -> bool:
    """Whether a link loses packets independently, and neither delays nor changes; colluding links count as one."""
    schedule = scenario.schedule(receiver)
    link = distribution_of(schedule)
    if link is None or link.alike is None or schedule.correlation is not None or schedule.outages or schedule.changes:
        return False
    return set(schedule.settings) == {"loss"} and scenario.link(receiver).model.chain is not None


_ROUNDING = 1e-12  # of an error, relative to the state
_SMALL = 1e-15  # of a squared error, relative to those of the first slots: above it none is rounding


class TheoreticalTraceStream(Protocol):
    """Theoretical traces, a number of slots at a time."""

    def next_traces(self, slots: int) -> Floats:
        """The traces of the next slots, (slots,)."""


@final
class KnownTraces:
    """The stream of traces that have been computed, (slots,)."""

    def __init__(self, traces: Floats) -> None:
        self._left = traces

    def next_traces(self, slots: int) -> Floats:
        """The traces of the next slots, (slots,)."""
        traces, self._left = self._left[:slots], self._left[slots:]
        return traces


@final
class _Unknown:
    """The stream of a receiver that no theory covers."""

    def next_traces(self, slots: int) -> Floats:
        """NaN for each slot, (slots,)."""
        return np.full(slots, np.nan)


@dataclass(frozen=True)
class Expectation:
    """One receiver's theoretical error covariance, by the chain that its link's losses follow."""

    process: Process
    link: LinkDistribution | None
    """None: theory does not cover the link."""
    outcomes_at: OutcomesAt | None
    """Maps a link's quality to the frequencies of the receiver's actions; None if these are unknown."""
    bound_at: OutcomesAt | None = None
    """For a receiver without the secret and without a theory of its own: one that it cannot outperform, such as the genie."""
    bound_slots_at: SlotOutcomes | None = None
    """The same as `slots_at` for `bound_at`."""
    closed: ClosedForm | None = None
    """The closed form of a receiver whose slots differ."""
    closed_bound: ClosedForm | None = None
    """A lower bound for such a receiver, in place of a closed form."""
    slots_at: SlotOutcomes | None = None
    """The outcomes of each slot, where μ_d differs from slot to slot; `outcomes_at` is then their mean, and there is no limit."""
    of_model: bool = False
    """Whether the process is only a model of what moves the states: then it is not the errors of a run that theory expects."""
    assumed: bool = False
    """Whether it is only what receivers assume: then theory expects nothing."""
    recorded_loss: float = math.nan
    """Of a link that theory does not cover, but whose losses are recorded: the probability that it loses the first packet."""

    @property
    def known(self) -> bool:
        """Whether there is a theory for the link and for the receiver's actions."""
        return self.closed is not None or self._known is not None

    @property
    def first_loss(self) -> float:
        """The probability that the packet of slot 0 is not delivered, in time or late; NaN if it is not known."""
        if self.link is None:
            return self.recorded_loss
        first = self.link.segments[0]
        in_the_end = replace(self.link, segments=(replace(first, arrived=first.arrived[-1:]),))
        return 1.0 - float(in_the_end.rates(range(1))[0])

    @property
    def _known(self) -> tuple[LinkDistribution, OutcomesAt] | None:
        return None if self.link is None or self.outcomes_at is None else (self.link, self.outcomes_at)

    @property
    def _outcomes(self) -> Outcomes | None:
        """The outcomes behind a link whose losses are independent, as in the paper."""
        if self._known is None or self.slots_at is not None:
            return None
        link, outcomes_at = self._known
        alike = link.alike
        return None if alike is None else outcomes_at(float(alike.quality[0]))

    @property
    def bound(self) -> Expectation | None:
        """A lower bound on the receiver's error, if theory knows only that."""
        if self.closed_bound is not None:
            return Expectation(self.process, self.link, None, closed=self.closed_bound)
        if self.known or self.link is None or self.bound_at is None:
            return None
        return Expectation(self.process, self.link, self.bound_at, slots_at=self.bound_slots_at)

    @property
    def has_limit(self) -> bool:
        """Whether there may be a limit: slots continue as they are, and do not follow a list that ends."""
        return self.slots_at is None

    @property
    def alike(self) -> Alike:
        """The expectation as a key, equal to that of a receiver with the same outcomes."""
        outcomes, process = self._outcomes, self.process
        if self.closed is not None or outcomes is None or outcomes.leaked:
            return Alike(object(), self)
        matrices = (np.float64(M).tobytes() for M in (process.A, process.Q, process.initial_covariance))
        return Alike((*matrices, outcomes), self)

    def stream(self) -> TheoreticalTraceStream:
        """The theoretical traces from slot 0 on; NaN without a theory."""
        if self.closed is not None:
            return KnownTraces(self.closed.traces)
        if self._outcomes is not None:
            return TheoreticalCovariance(self.process, self._outcomes)
        if self._known is None:
            return _Unknown()
        return modulated.ModulatedCovariance(self.process, *self._known, self.slots_at)

    def traces(self, slots: int) -> Floats:
        """The theoretical traces of slots 0 … slots−1, (slots,); NaN without a theory."""
        return self.stream().next_traces(slots)

    @property
    def limit(self) -> float:
        """Trace of the limit, for the link in its last state; inf if unbounded, NaN without a theory or a limit."""
        if not self.has_limit:
            return math.nan
        if self.closed is not None:
            return self.closed.limit
        if self._outcomes is not None:
            return theory.limit_trace(self.process, self._outcomes)
        return math.nan if self._known is None else modulated.limit_of(self.process, *self._known)

    def along(self, v: Floats, slots: int) -> Floats | None:
        """The expected squared error of vᵀx, v (n,), in slots 0 … slots−1; None unless it is known by single slots."""
        outcomes = None if self.closed is not None else self._outcomes
        if outcomes is None:
            return None
        return variances_along(TheoreticalCovariance(self.process, outcomes), v, slots)

    def is_rounding(self, error: float, slots: int) -> bool:
        """Whether a mean squared error over slots 0 … slots−1 is only rounding: below 1e-24 of the state's own square."""
        process = self.process
        if error > _SMALL * float(np.trace(process.initial_covariance) + np.trace(process.Q)):
            return False  # the horizon of runs keeps the state from growing so far
        own = total_of(TheoreticalCovariance(process, theory.NOBODY).next_traces, slots) / slots
        return error < _ROUNDING**2 * own

    @property
    def growth(self) -> Growth | None:
        """The directions in which the expected error grows without bound; None if theory knows none."""
        closed = self.closed_bound if self.closed is None else self.closed
        if closed is not None:
            return closed.growth
        outcomes = self._outcomes
        return None if outcomes is None else growth(self.process, outcomes)

    def streaks(self, slots: int) -> Streaks | None:
        """What streaks carry of its error in slots 0 … slots−1; None unless there is a closed form.

        Source: docs/mathematics/verdicts.md, rare events.
        """
        if self.closed is not None or self._known is None:
            return None
        if self._outcomes is not None and not self._outcomes.leaked:
            return streaks(self.process, self._outcomes, slots)
        total = total_of(self.stream().next_traces, slots)
        return modulated_streaks(self.process, *self._known, slots, total, self.slots_at)

    def rare(self, slots: int, trials: int) -> Floats | None:
        """What rare events carry of its error in each of the slots 0 … slots−1, (slots,), if this number of trials is simulated.

        None unless the error of the run itself is expected, behind a link with independent losses.

        Source: docs/mathematics/verdicts.md, rare events.
        """
        if self.closed is not None or self.of_model or self._outcomes is None:
            return None
        fractions = rare_in_slots(self.process, self._outcomes, slots, trials)
        return None if fractions is None else fractions * self.traces(slots)

    @property
    def infinite_variance(self) -> bool:
        """Whether the variance of tr P over trials has no bound (docs/mathematics/model.md, heavy tails)."""
        if self.bound is not None:
            return self.bound.infinite_variance
        if self.closed is not None:
            return self.closed.infinite_variance
        if self._known is None or not self.has_limit:
            return False
        if self._outcomes is not None:
            return theory.has_infinite_variance(self.process, self._outcomes)
        link, outcomes_at = self._known
        return theory.has_infinite_variance(self.process, modulated.tail_outcomes(link.last, outcomes_at))


@dataclass(frozen=True)
class Alike:
    """An expectation as a key of what is computed from its traces and streaks alone: a run may have many equal receivers."""

    key: object
    expectation: Expectation = field(compare=False)


def outcomes_of(scenario: Scenario, receiver: str) -> OutcomesAt | None:
    """Maps the quality of a receiver's link to the frequencies of its actions; None if these are unknown."""
    return _outcomes_of(scenario, receiver, scenario.make_scheme())


def _outcomes_of(scenario: Scenario, receiver: str, scheme: Scheme) -> OutcomesAt | None:
    if receiver == LEGITIMATE:
        loses = LEGITIMATE in scheme.closed_forms and _may_lose_reference(scenario)
        return None if loses else legitimate_outcomes(scheme)
    eavesdropper = scenario.eavesdroppers[receiver]
    return eavesdropper_outcomes(scheme, eavesdropper.strategy, eavesdropper.parameters)


def _may_lose_reference(scenario: Scenario) -> bool:
    """Whether the legitimate estimator may lack what the sensor takes it to have: by forged acknowledgements, or a restart.

    A restart loses nothing if it had acknowledged nothing yet, and one at the end of the run needs nothing any more.
    """
    restarts = [away for away in scenario.timeline.outages[LEGITIMATE] if not away.keeps_state]
    return scenario.forges_acknowledgements or any(away.start > 0 and away.stop < scenario.slots for away in restarts)


def bound_of(scenario: Scenario, receiver: str) -> OutcomesAt | None:
    """The same for a receiver that knows the types of packets, behind the same link, where it bounds this one: without leaks."""
    scheme = scenario.make_scheme()
    if receiver == LEGITIMATE or receiver in scenario.leaks or scheme.bound_outcomes(0.5) is None:
        return None
    return partial(_bound, scheme)


def expectations_of(scenario: Scenario) -> dict[str, Expectation]:
    """Receiver → theory's expectation of it."""
    table = scenario.process
    if table.given and not table.theory:
        return dict.fromkeys(scenario.receivers, Expectation(table.process, None, None, of_model=True, assumed=True))
    expectations = {}
    scheme, mu_d = scenario.make_scheme(), scenario.encoding.state_probabilities
    for name in scenario.receivers:
        closed = closed_of(scenario, name)
        bound = closed is not None and closed.bound
        expectations[name] = Expectation(
            scenario.process.process,
            distribution_of(scenario.schedule(name)),
            outcomes_of(scenario, name),
            bound_of(scenario, name),
            closed=None if bound else closed,
            closed_bound=closed if bound else None,
            slots_at=None if mu_d is None else _in_slots(mu_d, partial(_known_in_slot, scenario, name, scheme)),
            bound_slots_at=None if mu_d is None else lambda k: partial(_bound, scheme.in_slot(k)),
            of_model=scenario.of_model,
            recorded_loss=_recorded_loss(scenario, name),
        )
    return expectations


def _recorded_loss(scenario: Scenario, receiver: str) -> float:
    """The probability that a link which only replays a recording loses the first packet; NaN for others.

    Source: docs/mathematics/verdicts.md, verdicts.
    """
    schedule = scenario.schedule(receiver)
    if set(schedule.settings) != {"loss"} or schedule.changes or schedule.outages:
        return math.nan
    loss = loss_of(schedule.settings["loss"])
    return 1.0 - float(loss.quality_at(range(1))[0]) if isinstance(loss, RecordedLoss) else math.nan


def replays_a_recording(scenario: Scenario, receiver: str) -> bool:
    """Whether all trials replay the same losses of a recording, so that results hold for these losses only."""
    loss = loss_of(scenario.schedule(receiver).settings["loss"])
    return isinstance(loss, RecordedLoss) and loss.memoryless


def error_floor_of(scenario: Scenario, receiver: str) -> tuple[Floats, bool] | None:
    """The scheme's lower bound on an eavesdropper's error, (slots,), and whether it grows without bound; None if it has none."""
    assumed = scenario.process.given and not scenario.process.theory
    if receiver == LEGITIMATE or receiver in scenario.leaks or assumed:
        return None
    return scenario.make_scheme().error_floor(scenario.slots)


def _in_slots(mu_d: tuple[float, ...], outcomes_in: SlotOutcomes) -> SlotOutcomes:
    """The outcomes of each slot, asked for once for each value of μ_d."""
    outcomes_of: dict[float, OutcomesAt] = {}

    def at(k: int) -> OutcomesAt:
        value = in_slot(mu_d, k)
        if value not in outcomes_of:
            outcomes_of[value] = outcomes_in(k)
        return outcomes_of[value]

    return at


def _known_in_slot(scenario: Scenario, receiver: str, scheme: Scheme, k: int) -> OutcomesAt:
    outcomes = _outcomes_of(scenario, receiver, scheme.in_slot(k))
    assert outcomes is not None  # noqa: S101 - the mean over the slots has outcomes, so each slot has
    return outcomes


def _bound(scheme: Scheme, quality: float) -> Outcomes:
    outcomes = scheme.bound_outcomes(quality)
    assert outcomes is not None  # noqa: S101 - checked before
    return outcomes


def theoretical_traces_of(scenario: Scenario) -> dict[str, Floats]:
    """Receiver → trace of the theoretical error covariance in every slot, (slots,); NaN without a theory."""
    return {name: expectation.traces(scenario.slots) for name, expectation in expectations_of(scenario).items()}


def variances_along(stream: TheoreticalCovariance, v: Floats, slots: int) -> Floats:
    """The expected squared error of vᵀx, v (n,), in the next `slots` slots of a stream."""
    variances = np.empty(slots)
    for part in parts_of(range(slots)):
        variances[part.start : part.stop] = np.einsum("i,kij,j->k", v, stream.next(len(part)), v)
    return variances

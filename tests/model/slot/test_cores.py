"""The cores of live processes and memory: no number depends on where blocks of slots begin; states that are given."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.detection import Chart, CusumBatch
from evedrop.model.links.loss_model import Fate
from evedrop.model.local_filter import LocalFilter
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, product
from evedrop.model.receiver import Receiver
from evedrop.model.record import columns
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.innovation import InnovationEncoder, SharedSecret
from evedrop.model.schemes.plain import PlainEncoder
from evedrop.model.schemes.scheme import Packet, PacketBlock
from evedrop.model.slot.cores import (
    GivenStates,
    PlantCore,
    ReceiverCore,
    SensorCore,
    Sent,
    deviations,
    recorded,
)
from evedrop.model.slot.link import Change, LinkSchedule, ReceiverOutage, streams_of
from evedrop.model.slot.link_core import Arrivals, LinkCore
from evedrop.model.slot.records import ReceiverSlots, SensorSlots
from evedrop.model.streams import Batch, stream_key
from tests.builders import MARGINAL, stream_keys
from tests.model.slot_loop import ROOT, keys_of

BATCH = Batch(30, 4)
EDGES = ((0, 30), (0, 1, 2, 9, 10, 30), tuple(range(31)))
PLANT = Plant(
    input_matrix=np.array([[0.0], [1.0]]),
    disturbance_matrix=np.array([[0.5], [0.0]]),
    noise=0.1 * np.eye(2),
    start=np.array([1.0, -1.0]),
    input_lower=np.array([-1.0]),
    input_upper=np.array([1.0]),
    state_lower=np.full(2, -np.inf),
    state_upper=np.full(2, np.inf),
    output_matrix=np.eye(2),
    measurement_noise=0.01 * np.eye(2),
)
LINK: dict[str, Any] = {
    "loss": {"model": "bernoulli", "quality": 0.7}, "delay": {"model": "normal", "mean": 1.2, "standard_deviation": 1.0},
    "duplicate": 0.2,
}  # fmt: skip
SENSORS = [
    (name, driven)
    for name, kind in SCHEMES.items()
    for driven in (False, True)
    if not (kind.needs_acknowledgements or (driven and kind.decides_initial_state()))
]
"""Schemes, with a process alone and with a plant and a filter; a filter cannot follow a state that the secret decides."""


def ranges(edges: tuple[int, ...]) -> Iterator[range]:
    """The blocks between the edges."""
    return (range(first, stop) for first, stop in pairwise(edges))


def sensor(scheme: str, plant: Plant | None = None) -> SensorCore:
    """A sensor's core; with a plant, one that filters."""
    kind = scheme_of(MARGINAL, {"scheme": scheme, **SCHEMES[scheme].parameters})
    keys = keys_of((*kind.secret_streams, "measurement"))
    disturbances = None if plant is None else np.sin(np.arange(BATCH.slots))[:, None]
    local = None if plant is None else LocalFilter(MARGINAL, plant, keys["measurement"], BATCH)
    states = PlantCore(
        MARGINAL, stream_key(ROOT, "process"), BATCH, kind.initial_state(keys, BATCH), plant, disturbances
    )
    return SensorCore(kind.encoder(keys, BATCH), states, local)


def same(value: Any, other: Any) -> bool:
    """Whether two arrays, or the lack of them, are the same to the bit."""
    if value is None or other is None:
        return value is other
    return bool(value.tobytes() == other.tobytes())


@pytest.mark.parametrize(("scheme", "driven"), SENSORS)
def test_what_is_sent_does_not_depend_on_blocks(scheme: str, driven: bool) -> None:
    """States, packets, headers, what is sent, and the schedule."""
    made = []
    for edges in EDGES:
        core = sensor(scheme, PLANT if driven else None)
        parts = []
        for slots in ranges(edges):
            parts.append(core.send(slots))
            if slots.stop == 10:
                core.set_inputs(np.full((1, BATCH.trials), 0.5))
        made.append(Sent.joined(parts))
    if driven:  # the inputs came at another slot
        made = made[1:]
    for sent in made[1:]:
        assert (sent.slots.true is not None) is driven
        assert all(
            same(getattr(sent.slots, column.name), getattr(made[0].slots, column.name))
            for column in columns(SensorSlots)
        )
        assert all(same(*pair) for pair in zip(sent.packets, made[0].packets, strict=True))
    rows = made[0].slots.rows(slice(3, 5))
    assert rows.slots == range(3, 5)
    assert same(rows.x, made[0].slots.x[3:5])
    assert same(made[0].packets.rows(slice(3, 5)).at(1).z, made[0].packets.at(4).z)


def link(schedule: LinkSchedule) -> LinkCore:
    """A link's core."""
    return LinkCore(schedule, "it", stream_keys(6, streams_of("it", schedule)), BATCH)


@pytest.mark.parametrize("window", [0, 3])
def test_arrivals_and_beliefs_do_not_depend_on_blocks(window: int) -> None:
    """With losses, delays and second copies; late packets are counted alike."""
    schedule = LinkSchedule(LINK, window)
    sent = sensor("innovation").send(range(BATCH.slots))
    followed: list[ReceiverSlots] = []
    for edges in EDGES:
        core, receiver = link(schedule), ReceiverCore(estimator(), window)
        parts = []
        for batch in (range(20), range(20, 30)):
            core.plan(batch)
            for slots in ranges(edges):
                part = range(max(slots.start, batch.start), min(slots.stop, batch.stop))
                if part:
                    parts.append(receiver.take_slots(part, core.arrivals(part, sent.packets.z[part.start : part.stop])))
        followed.append(ReceiverSlots.joined(parts))
    assert (followed[0].late is None) is (window == 0)
    for divided in followed[1:]:
        assert all(
            same(getattr(divided, column.name), getattr(followed[0], column.name)) for column in columns(ReceiverSlots)
        )
    assert window == 0 or (followed[0].late is not None and followed[0].late.any())
    beliefs = followed[0].beliefs
    some = beliefs.rows(slice(3, 5))
    assert same(some.x_hat, beliefs.x_hat[3:5])
    assert same(some.P, beliefs.P[3:5])
    assert same(some.action, beliefs.action[3:5])


def estimator() -> Receiver:
    """The estimator of the paper's scheme."""
    scheme = scheme_of(MARGINAL, {"scheme": "innovation", **SCHEMES["innovation"].parameters})
    return scheme.estimator(keys_of(scheme.estimator_streams), BATCH)


def test_a_link_is_silenced_and_amended_in_its_batch() -> None:
    """Packets that are not sent count as unsent; what is decided again begins at its slot."""
    core = link(
        LinkSchedule({"loss": {"model": "bernoulli", "quality": 1.0}}, 0, (), (ReceiverOutage(25, 27, Fate.DOWN),))
    )
    core.plan(range(10, 20))
    sent = np.array([[True, False, True, True], [False] * 4])
    core.silence(range(12, 14), sent)
    assert core.gamma(12).tolist() == sent[0].tolist()
    assert not core.gamma(13).any()
    assert core.gamma(14).all()
    assert (core.part(range(12, 14)).codes == Fate.UNSENT).tolist() == (~sent).tolist()
    assert core.rest(12) is None
    core.amend(15, [Change(15, cut=True)])
    assert core.slots == range(15, 20)
    assert not core.in_time.any()
    assert [k for k in range(24, 29) if not core.present(k)] == [25, 26]


def test_a_link_that_only_loses_packets_passes_the_others_on() -> None:
    """Silenced one slot after the other, it delivers what was sent and not lost."""
    core, z = link(LinkSchedule({"loss": {"model": "bernoulli", "quality": 0.7}})), np.ones((4, 2, BATCH.trials))
    core.plan(range(4))
    heard, sent = core.in_time.copy(), np.array([[True, False] * 2] * 4)
    for k in range(4):
        core.silence(range(k, k + 1), sent[k : k + 1])
    arrivals = core.arrivals(range(4), z)
    assert arrivals.plain
    assert arrivals.z is z
    assert same(arrivals.gamma, heard & sent)
    assert heard.any()
    assert not heard.all()


def test_delays_have_rests_even_where_packets_are_not_sent() -> None:
    """The fraction of a slot by which a paced run delays a delivery."""
    core = link(LinkSchedule(LINK, 3))
    core.plan(range(10))
    before = [core.rest(k) for k in range(10)]
    core.silence(range(1), np.ones((1, BATCH.trials), np.bool_))
    assert before == [core.rest(k) for k in range(10)]
    assert all(rest is not None and 0.0 <= rest < 1.0 for rest in before)


class Changed(InnovationEncoder):
    """A subclass that changes a slot, and says nothing of blocks."""

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:
        """Twice the packet."""
        packet = super().encode(k, x, predicted)
        return packet._replace(z=2.0 * packet.z)


def test_a_subclass_that_changes_a_packet_changes_blocks_too() -> None:
    """And not the block of the class below."""
    secret = SharedSecret(MARGINAL, 0.4, keys_of(("schedule", "noise")), BATCH)
    x = np.ones((3, 2, BATCH.trials))
    once, twice = (kind(secret).encode_block(range(3), x, x) for kind in (InnovationEncoder, Changed))
    assert np.array_equal(twice.z, 2.0 * once.z)


def test_acknowledgements_reach_scheme_and_watch() -> None:
    """Without a chart, missing acknowledgements go unnoticed; with one, they raise an alarm."""
    everyone, nobody = np.ones(BATCH.trials, np.bool_), np.zeros(BATCH.trials, np.bool_)
    plain = sensor("plain")
    assert plain.acknowledged(0, nobody, None) is None
    states = PlantCore(MARGINAL, stream_key(ROOT, "process"), BATCH)
    watching = SensorCore(PlainEncoder(), states, watch=CusumBatch(Chart(0, 1, 1), BATCH.trials))
    assert not np.any(watching.acknowledged(0, everyone, None))
    assert np.all(watching.acknowledged(1, nobody, None))


def test_single_packets_become_one_block_and_back() -> None:
    """With and without what only some schemes have."""
    full = [
        Packet(np.ones((2, 3)) * k, np.zeros(3, np.bool_), np.full((1, 3), k), np.ones(3, np.bool_)) for k in range(3)
    ]
    block = PacketBlock.of(full)
    assert [part.shape for part in block if part is not None] == [(3, 2, 3), (3, 3), (3, 1, 3), (3, 3)]
    assert all(same(*pair) for pair in zip(block.at(2), full[2], strict=True))
    bare = PacketBlock.joined([block.rows(slice(0, 1)), block.rows(slice(1, 3))])
    assert all(same(*pair) for pair in zip(bare, block, strict=True))
    assert PacketBlock.of([Packet(np.ones((2, 3)), np.zeros(3, np.bool_))]).header is None


def test_a_slot_with_more_than_its_packet_is_not_plain() -> None:
    """Headers, late packets and a betrayed state are taken slot by slot."""
    gamma, z = np.ones((2, 3), np.bool_), np.ones((2, 2, 3))
    plain = Arrivals(gamma, z)
    assert plain.plain
    assert not plain._replace(header=np.ones((2, 1, 3), np.int64)).plain
    assert not plain._replace(late={1: ()}).plain
    betrayed = plain._replace(truth={1: z[1]})
    assert not betrayed.plain
    assert betrayed.at(0).heard.truth is None
    assert same(betrayed.at(1).heard.truth, z[1])


level = st.floats(-1e12, 1e12)


@settings(deadline=None)
@given(level, level)
def test_recorded_levels_have_the_same_deviations(value: float, reference: float) -> None:
    """The levels that tables hold give back every bit."""
    r = np.array([reference])
    x = deviations(np.array([[value]]), r)
    assert np.array_equal(deviations(x + r, r), x)


def test_a_plain_difference_would_not_have_them() -> None:
    """It is rare that it does not: all numbers of half precision show it, for some references."""
    levels: Any = np.arange(2**16, dtype=np.uint16).view(np.float16)
    with np.errstate(invalid="ignore", over="ignore"):
        levels = levels[np.abs(levels) < 3e4]
        references: list[Any] = [np.array([r], np.float16) for r in np.random.default_rng(0).choice(levels, 80)]
        plain = [(((levels - r) + r) - r != levels - r).sum() for r in references]
        again = [(deviations(deviations(levels, r) + r, r) != deviations(levels, r)).sum() for r in references]
    assert sum(plain) > 0
    assert sum(again) == 0


def test_trials_share_the_states_however_they_are_read() -> None:
    """Blocks of any lengths; A x of the slot before, and 0 in slot 0."""
    rows = np.random.default_rng(2).standard_normal((7, 2))
    core = PlantCore(MARGINAL, bytes(32), Batch(7, 3), given=GivenStates(MARGINAL, recorded(rows), 3))
    advances = [core.advance(slots) for slots in (range(3), range(3, 4), range(4, 7))]
    x = np.concatenate([advance.x for advance in advances])
    predicted = np.concatenate([advance.predicted for advance in advances])
    assert all(advance.pushed is None for advance in advances)
    assert np.array_equal(x, np.repeat(rows[:, :, None], 3, axis=2))
    assert np.array_equal(predicted[1:], product(MARGINAL.A, x[:-1]))
    assert not predicted[0].any()

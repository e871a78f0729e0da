"""Fates of messages: determined by seed, link, kind, key and number, for every model; and changes of a link's settings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.delays import DELAY_MODELS, delay_of
from evedrop.model.links import LOSS_MODELS, loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.model.slot.link import Change, Link
from evedrop.model.streams import Stream, normals, root_of_seed, stream_key, uniforms
from evedrop.wire.running_link import KeyFates, MessageFate, PerKeyLinks
from tests.examples import examples
from tests.wire.wire_links import DELAYS, LOSSES, key_fates, wire_link

SEED = 7
FULL: dict[str, Any] = {
    "loss": LOSSES["gilbert-elliott"],
    "delay": DELAYS["normal"],
    "reorder": 0.1,
    "duplicate": 0.2,
    "corrupt": 0.05,
}
POOR: dict[str, Any] = {"loss": {"model": "bernoulli", "quality": 0.2}, "corrupt": 0.1}


def taken(fates: KeyFates, count: int) -> list[MessageFate]:
    """The fates of the next messages."""
    return [fates.next() for _ in range(count)]


def of_scan(given: dict[str, Any], key: str = "robot/scan", **more: Any) -> KeyFates:
    """The fates of the puts of a key on the link scan."""
    return key_fates(wire_link(given), key, "put", SEED, **more)


def test_every_model_is_among_them() -> None:
    """A new model must be added to the links of these tests."""
    assert set(LOSSES) == set(LOSS_MODELS)
    assert set(DELAYS) == set(DELAY_MODELS)


@pytest.mark.parametrize("model", LOSSES)
def test_losses_are_those_of_the_model(model: str) -> None:
    """The model itself, given the numbers of the documented stream, has the same losses."""
    loss = loss_of(LOSSES[model])
    key = stream_key(root_of_seed(SEED), "wire/link/scan/put/robot/scan")
    u = uniforms(Stream(key, range(1), loss.uniforms_per_slot).words(range(3000))).transpose(0, 2, 1)
    expected = [(code, 0.0, False) for code in loss.fates(0, u)[:, 0].tolist()]
    assert taken(of_scan({"loss": LOSSES[model]}), 3000) == expected


@pytest.mark.parametrize("model", DELAYS)
def test_delays_are_those_of_the_model_in_seconds(model: str) -> None:
    """The model itself, given the numbers of the documented stream, has the same delays; none is too long."""
    delay = delay_of(DELAYS[model])
    words = Stream(stream_key(root_of_seed(SEED), "wire/delay/scan/put/robot/scan"), range(1), 1).words(range(3000))
    numbers = (normals(words) if delay.normal else uniforms(words))[:, :, 0]
    result = taken(of_scan({"loss": {"model": "bernoulli", "quality": 1.0}, "delay": DELAYS[model]}), 3000)
    assert [fate[1] for fate in result] == delay.delays(0, numbers)[:, 0].tolist()
    assert {fate[0] for fate in result} == {Fate.DELIVERED}


def test_duplicates_corruption_and_overtaking() -> None:
    """Each has its probability; only delivered messages have a copy, and a message that overtakes has no delay."""
    count = 20_000
    result = taken(of_scan({**FULL, "loss": {"model": "bernoulli", "quality": 1.0}}), count)
    codes, delays, again = (np.array(column) for column in zip(*result, strict=True))
    for rate, probability in (
        ((codes == Fate.CORRUPTED).mean(), 0.05),
        ((delays == 0.0).mean(), 0.1),
        (again.mean(), 0.2 * 0.95),
    ):
        assert abs(rate - probability) < 4.9 * (probability * (1 - probability) / count) ** 0.5
    assert not again[codes != Fate.DELIVERED].any()


def test_rate_and_queue_are_left_out() -> None:
    """They depend on time, so the fates do not change with them."""
    assert taken(of_scan({**FULL, "rate": 0.5, "queue": 1}), 500) == taken(of_scan(FULL), 500)


def test_other_keys_kinds_links_and_seeds_have_other_fates() -> None:
    """And reading them in turn changes nothing."""
    several = [
        of_scan(FULL),
        of_scan(FULL, key="robot/pose"),
        key_fates(wire_link(FULL), "robot/scan", "query", SEED),
        key_fates(wire_link(FULL), "robot/scan", "put", SEED + 1),
        key_fates(wire_link(FULL, "other"), "robot/scan", "put", SEED),
    ]
    in_turn = list(zip(*([fates_.next() for fates_ in several] for _ in range(300)), strict=True))
    assert len(set(in_turn)) == 5
    assert list(in_turn[0]) == taken(of_scan(FULL), 300)


@pytest.mark.parametrize("changes", [(), (Change(0, POOR), Change(5, FULL))])
def test_keys_that_share_their_links_have_fates_of_their_own(changes: tuple[Change, ...]) -> None:
    """However they come in turns: no key's losses go on with the memory of another one."""
    links = PerKeyLinks(wire_link(FULL), SEED, changes)
    shared = [KeyFates(links, "put", f"robot/{n}") for n in range(4)]
    in_turn = list(zip(*([fates.next() for fates in shared] for _ in range(100)), strict=True))
    assert [list(fates) for fates in in_turn] == [
        taken(of_scan(FULL, key=f"robot/{n}", changes=changes), 100) for n in range(4)
    ]


def test_the_history_of_a_key_has_the_same_fates_in_every_session() -> None:
    """The Zenoh id of a session in a key of an advanced publisher changes no fate; the key that it publishes on does."""
    histories = ("scan/@adv/pub/1af/7/_", "scan/@adv/*/88/12/**", "scan/@adv/**")
    fates = [taken(of_scan(FULL, key=key), 300) for key in histories]
    assert fates[0] == fates[1] == fates[2]
    loss = loss_of(FULL["loss"])
    key = stream_key(root_of_seed(SEED), "wire/link/scan/put/scan/@adv")
    u = uniforms(Stream(key, range(1), loss.uniforms_per_slot).words(range(300))).transpose(0, 2, 1)
    assert taken(of_scan({"loss": FULL["loss"]}, key=histories[0]), 300) == [
        (code, 0.0, False) for code in loss.fates(0, u)[:, 0].tolist()
    ]
    assert fates[0] != taken(of_scan(FULL, key="scan"), 300)
    assert fates[0] != taken(of_scan(FULL, key="pose/@adv/**"), 300)


@settings(deadline=None, max_examples=examples(40))
@given(
    model=st.sampled_from(sorted(LOSSES)),
    start=st.integers(0, 3000),
    changes=st.lists(st.integers(0, 3000), max_size=3),
)
def test_a_wire_that_is_started_again_goes_on(model: str, start: int, changes: list[int]) -> None:
    """After any number of messages, and changes, the fates are those of a wire that was never stopped."""
    made = [Change(at, (POOR, FULL, {"loss": LOSSES["markov"]})[i]) for i, at in enumerate(changes) if at <= start]
    whole = of_scan({"loss": LOSSES[model]}, changes=made)
    taken(whole, start)
    again = of_scan({"loss": LOSSES[model]}, start=start, changes=made)
    assert again.n == whole.n == start
    assert taken(again, 200) == taken(whole, 200)


def test_many_messages_before_the_start() -> None:
    """They are passed in several parts."""
    bursts = {"loss": LOSSES["gilbert-elliott"]}
    whole = of_scan(bursts)
    taken(whole, 70_000)
    assert taken(of_scan(bursts, start=70_000), 50) == taken(whole, 50)


@pytest.mark.parametrize(("first", "decided"), [(POOR, 100), (FULL, 40_100)])
def test_messages_without_memory_are_not_decided_again(
    first: dict[str, Any], decided: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A key that comes back after very many messages holds up no other one; bursts before a change are the past."""
    counted: list[int] = []
    decide = Link._unchanged

    def count(link: Link, slots: range) -> Any:
        counted.append(len(slots))
        return decide(link, slots)

    monkeypatch.setattr(Link, "_unchanged", count)
    changes = (Change(40_000, POOR), Change(60_000, {**POOR, "duplicate": 0.1}))
    fates = of_scan(first, start=10**9, changes=changes)
    result = taken(fates, 20)
    assert sum(counted) <= decided
    loss = loss_of(POOR["loss"])
    key = stream_key(root_of_seed(SEED), "wire/link/scan/put/robot/scan")
    u = uniforms(Stream(key, range(1), loss.uniforms_per_slot).words(range(10**9, 10**9 + 20))).transpose(0, 2, 1)
    lost = loss.fates(10**9, u)[:, 0] == Fate.LOST
    assert [code == Fate.LOST for code, _, _ in result] == lost.tolist()


@settings(deadline=None, max_examples=examples(40))
@given(st.lists(st.tuples(st.integers(0, 1200), st.integers(0, 3)), max_size=4))
def test_changes_while_messages_pass(turns: list[tuple[int, int]]) -> None:
    """A change holds from the next message on, as if it had been known from the beginning."""
    choices = (POOR, FULL, {"loss": LOSSES["markov"], "delay": DELAYS["pareto"]}, {"loss": LOSSES["distance"]})
    fates, passed, made = of_scan(FULL), [], []
    for wait, choice in turns:
        passed += taken(fates, wait)
        assert fates.change(choices[choice]) == len(passed)
        made.append(Change(len(passed), choices[choice]))
    passed += taken(fates, 100)
    assert fates.n == len(passed)
    assert passed == taken(of_scan(FULL, changes=made), len(passed))


def test_correlated_links_lose_together() -> None:
    """With strength 1 a link has the losses of the other one, for each key; with strength 0 it has its own."""
    loss = {"loss": {"model": "bernoulli", "quality": 0.5}}
    other = taken(key_fates(wire_link(loss, "other"), "k", "put", SEED), 500)
    tied = {s: key_fates(wire_link(loss, correlation=("other", s)), "k", "put", SEED) for s in (0.0, 0.5, 1.0)}
    assert taken(tied[1.0], 500) == other
    assert taken(tied[0.0], 500) == taken(key_fates(wire_link(loss), "k", "put", SEED), 500)
    alike = np.mean([a == b for a, b in zip(taken(tied[0.5], 500), other, strict=True)])
    assert alike == pytest.approx(0.75, abs=0.1)

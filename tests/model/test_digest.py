"""Digests, recomputed from their definition with struct, number by number; sums over blocks, the same however slots are added."""

from __future__ import annotations

import itertools
import struct
from hashlib import sha256

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from xxhash import xxh3_128, xxh3_128_digest

from evedrop.model.digest import (
    BLOCK_SLOTS,
    BlockDigests,
    Blocks,
    BlockSums,
    DigestLog,
    InputLog,
    PartialDigests,
    RunDigest,
    added_in_order,
)
from evedrop.model.receiver import Belief, Beliefs
from tests.builders import one_slot
from tests.examples import examples


def random_beliefs(slots: int, n: int, trials: int, seed: int) -> list[Belief]:
    """Any beliefs."""
    rng = np.random.default_rng(seed)
    return [
        Belief(
            rng.standard_normal((n, trials)),
            rng.standard_normal((n, n, trials)),
            rng.integers(0, 4, trials, np.uint8),
        )
        for _ in range(slots)
    ]


def defined(beliefs: list[Belief], r: int) -> list[bytes]:
    """The digests of a trial's blocks, number by number."""
    blocks = []
    for start in range(0, len(beliefs), 256):
        whole = xxh3_128()
        for x_hat, P, action, _ in beliefs[start : start + 256]:
            n = len(x_hat)
            whole.update(struct.pack("<B", 1 if action[r] else 0))
            for i in range(n):
                whole.update(struct.pack("<d", x_hat[i, r]))
            for i in range(n):
                for j in range(i, n):
                    whole.update(struct.pack("<d", P[i, j, r]))
        blocks.append(whole.digest())
    return blocks


def logged(beliefs: list[Belief], trials: int) -> dict[int, np.ndarray]:
    """Block, by its first slot → digests (R, 16), by the program, slot by slot."""
    log = BlockDigests(trials, len(beliefs))
    blocks = {}
    for k, belief in enumerate(beliefs):
        digests = log.add(range(k, k + 1), one_slot(belief))
        assert list(digests) == ([k // 256 * 256] if k % 256 == 255 or k == len(beliefs) - 1 else [])
        blocks.update(digests)
    return blocks


@settings(max_examples=examples(25), deadline=None)
@given(st.sampled_from([1, 5, 255, 256, 257, 512, 600]), st.integers(1, 3), st.integers(1, 5), st.integers(0, 2**31))
def test_digests_are_as_defined(slots: int, n: int, trials: int, seed: int) -> None:
    """Every block of every trial, and the receiver's digest ordered by trial, then block."""
    beliefs = random_beliefs(slots, n, trials, seed)
    blocks = logged(beliefs, trials)
    expected = [defined(beliefs, r) for r in range(trials)]
    assert {block: [bytes(row) for row in rows] for block, rows in blocks.items()} == {
        256 * block: [digests[block] for digests in expected] for block in range(-(-slots // 256))
    }
    whole = RunDigest()
    whole.add(blocks)
    assert whole.hexadecimal == sha256(b"".join(b"".join(digests) for digests in expected)).hexdigest()


@pytest.mark.parametrize(("n", "trials"), [(2, 1), (2, 24), (2, 25), (2, 130), (20, 7), (20, 8), (20, 17)])
def test_digests_of_many_trials(n: int, trials: int) -> None:
    """Trials are digested in groups of a size that depends on that of their records; none is mistaken for another."""
    beliefs = random_beliefs(256, n, trials, 3)
    rows = logged(beliefs, trials)[0]
    assert [bytes(row) for row in rows] == [defined(beliefs, r)[0] for r in range(trials)]


def test_trials_may_come_in_parts() -> None:
    """A run's digest does not depend on how many trials were computed at once, only on their order."""
    beliefs = random_beliefs(300, 2, 6, 9)
    blocks = logged(beliefs, 6)
    whole, parts, swapped = RunDigest(), RunDigest(), RunDigest()
    whole.add(blocks)
    for digest, order in ((parts, (slice(0, 2), slice(2, 6))), (swapped, (slice(2, 6), slice(0, 2)))):
        for part in order:
            digest.add({block: rows[part] for block, rows in reversed(blocks.items())})
    assert parts.hexadecimal == whole.hexadecimal
    assert swapped.hexadecimal != whole.hexadecimal


@settings(deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["x_hat", "P", "gamma"]), st.data())
def test_any_bit_counts(seed: int, case: str, data: st.DataObject) -> None:
    """One changed bit of one trial in one slot changes that trial's digest and no other's."""
    beliefs = random_beliefs(5, 2, 3, seed)
    before = logged(beliefs, 3)[0]
    k, r = data.draw(st.integers(0, 4)), data.draw(st.integers(0, 2))
    x_hat, P, action, _ = beliefs[k]
    if case == "gamma":
        action[r] = 0 if action[r] else 1
    else:
        changed = x_hat[1] if case == "x_hat" else P[0, 1]
        changed[r] = np.nextafter(changed[r], np.inf)
    after = logged(beliefs, 3)[0]
    assert [not np.array_equal(digest, other) for digest, other in zip(before, after, strict=True)] == [
        i == r for i in range(3)
    ]


def test_the_lower_triangle_does_not_count() -> None:
    """A covariance is its own transpose, except for rounding; `asymmetry` finds those that are not."""
    beliefs = random_beliefs(5, 3, 2, 4)
    before = logged(beliefs, 2)[0]
    for _, P, _, _ in beliefs:
        P[np.tril_indices(3, -1)] += 1.0
    assert np.array_equal(logged(beliefs, 2)[0], before)


def test_the_hash_is_the_published_one() -> None:
    """XXH3-128 of no bytes, in the canonical order of the bytes: the vector of the specification."""
    assert xxh3_128_digest(b"").hex() == "99aa06d3014798d86001c324468d497f"


@given(cuts=st.lists(st.integers(1, 39), max_size=9), trials=st.sampled_from([3, 700, 3000]), seed=st.integers(0, 99))
@settings(max_examples=examples(30), deadline=None)
def test_a_block_may_be_digested_in_parts(cuts: list[int], trials: int, seed: int) -> None:
    """Parts of any slots, held or hashed at once, give the digests of the whole block."""
    beliefs = random_beliefs(40, 2, trials, seed)
    parts = PartialDigests(trials)
    bounds = [0, *sorted(set(cuts)), 40]
    for first, end in itertools.pairwise(bounds):
        x_hat, P, action = (np.array([belief[i] for belief in beliefs[first:end]]) for i in range(3))
        parts.add(x_hat, P, action)
    whole = PartialDigests(trials)
    whole.add(*(np.array([belief[i] for belief in beliefs]) for i in range(3)))
    finished = whole.finished()
    assert np.array_equal(parts.finished(), finished)
    assert bytes(finished[-1]) == defined(beliefs, trials - 1)[0]


def test_what_is_held_is_a_copy() -> None:
    """The caller may overwrite the arrays that it has added."""
    beliefs = random_beliefs(40, 2, 3, 6)
    parts, place = PartialDigests(3), Beliefs(np.empty((1, 2, 3)), np.empty((1, 2, 2, 3)), np.empty((1, 3), np.uint8))
    for belief in beliefs:
        place.x_hat[0], place.P[0], place.action[0] = belief.x_hat, belief.P, belief.action
        parts.add(*place)
    assert np.array_equal(parts.finished(), logged(beliefs, 3)[0])


@given(cuts=st.sets(st.integers(1, 699), max_size=4))
def test_blocks_know_where_each_slot_belongs(cuts: set[int]) -> None:
    """Blocks follow one another from slot 0 to the end, and end where a multiple of 256 slots or a cut is."""
    blocks = Blocks(700, sorted(cuts))
    starts = sorted({0, 256, 512, *cuts})
    for k in range(700):
        assert blocks.start(k) == max(start for start in starts if start <= k)
        assert blocks.end(k) == min([start for start in starts if start > k], default=700)


def test_blocks_of_a_run_with_an_outage() -> None:
    """They end where the outage begins and ends, and at multiples of 256 slots."""
    blocks = Blocks(300, [40, 50])
    assert [(blocks.start(k), blocks.end(k)) for k in (0, 39, 40, 49, 50, 255, 256, 299)] == [
        (0, 40), (0, 40), (40, 50), (40, 50), (50, 256), (50, 256), (256, 300), (256, 300),
    ]  # fmt: skip
    assert [blocks.ended(first, end) for first, end in ((0, 39), (0, 40), (39, 50), (40, 300), (299, 300))] == [
        [], [0], [0, 40], [40, 50, 256], [256],
    ]  # fmt: skip


@pytest.mark.parametrize("bounds", [(0, 1, 30, 40), (0, 1, 30, 256), (0, 256), (0, 130, 131)])
def test_parts_of_a_block_have_its_digests(bounds: tuple[int, ...]) -> None:
    """Small parts are held, large ones are hashed at once."""
    beliefs = random_beliefs(bounds[-1], 2, 3, 5)
    parts = PartialDigests(3)
    for first, end in itertools.pairwise(bounds):
        parts.add(*(np.array([belief[i] for belief in beliefs[first:end]]) for i in range(3)))
    assert [bytes(row) for row in parts.finished()] == [defined(beliefs, r)[0] for r in range(3)]


@pytest.mark.parametrize("slots", [5, 256, 300])
def test_digests_of_inputs_are_as_defined(slots: int) -> None:
    """For each slot whether the decision failed, one byte, and the inputs as little-endian float64."""
    rng = np.random.default_rng(2)
    u, failed = rng.standard_normal((slots, 2, 3)), rng.random((slots, 3)) < 0.5
    log, blocks = InputLog(2, 3, slots), {}
    for k in range(slots):
        if (digests := log.add(k, u[k], failed[k])) is not None:
            blocks[digests[0]] = [bytes(row) for row in digests[1]]
    assert list(blocks) == list(range(0, slots, BLOCK_SLOTS))
    for start, rows in blocks.items():
        block = range(start, min(start + BLOCK_SLOTS, slots))
        for r, row in enumerate(rows):
            record = b"".join(struct.pack("<Bdd", int(failed[k, r]), *u[k, :, r]) for k in block)
            assert row == xxh3_128_digest(record)


def test_a_run_has_one_digest_of_all_its_blocks() -> None:
    """Ordered by trial, then block; a block may have ended at an outage."""
    beliefs = random_beliefs(300, 2, 3, 8)
    whole = RunDigest()
    whole.add(logged(beliefs, 3))
    expected = b"".join(digest for r in range(3) for digest in defined(beliefs, r))
    assert whole.hexadecimal == sha256(expected).hexdigest()


def test_a_log_of_digests_is_a_mapping_of_them() -> None:
    """For any starts of the blocks, and any number of blocks added at a time."""
    random = np.random.default_rng(1)
    blocks = {start: random.integers(0, 256, (3, 16), np.uint8) for start in (0, 100, 256, 300, 512)}
    log = DigestLog()
    assert not log
    assert 0 not in log
    log.add({start: blocks[start] for start in (100, 0)})
    assert list(log.after(0)) == [0, 100]
    log.add({})
    log.add({start: blocks[start] for start in (256, 300, 512)})
    assert list(log) == list(blocks)
    assert all(np.array_equal(log[start], values) for start, values in blocks.items())
    later = log.after(2)
    assert list(later) == [256, 300, 512]
    assert np.array_equal(later[300], blocks[300])
    for missing in (-1, 99, 101, 513):
        assert missing not in log
    whole, from_log = RunDigest(), RunDigest()
    whole.add(blocks)
    from_log.add(log)
    assert whole.hexadecimal == from_log.hexadecimal


SLOTS, CUTS = 700, (300, 310)
STARTS = [0, 256, 300, 310, 512]


@settings(deadline=None)
@given(st.lists(st.integers(1, 400), max_size=8), st.sampled_from([1, 2, 3, 64]))
def test_parts_do_not_change_the_sums(lengths: list[int], trials: int) -> None:
    """Slot by slot from 0, to the bit, for a single trial as well; a block that has not ended is not among them."""
    numbers = np.random.default_rng(3).lognormal(sigma=8.0, size=(SLOTS - 50, trials))
    sums, complete, k = BlockSums(trials, SLOTS, CUTS), dict[int, np.ndarray](), 0
    for length in [*lengths, SLOTS]:
        stop = min(k + length, len(numbers))
        complete |= sums.add(range(k, stop), numbers[k:stop])
        k = stop
    assert list(complete) == STARTS[:-1]
    for start, end in zip(STARTS, [*STARTS[1:], len(numbers)], strict=True):
        expected = np.zeros(trials)
        for row in numbers[start:end]:
            expected = expected + row
        assert np.array_equal(complete.get(start, sums.unfinished), expected)


def test_another_process_continues_with_a_block() -> None:
    """From the slot after an outage on its sums are those of one process."""
    numbers = np.random.default_rng(4).random((SLOTS, 2))
    whole = BlockSums(2, SLOTS, CUTS).add(range(SLOTS), numbers)
    later = BlockSums(2, SLOTS, CUTS).add(range(310, SLOTS), numbers[310:])
    assert all(np.array_equal(later[start], whole[start]) for start in STARTS[3:])


def test_few_and_many_trials_are_added_in_the_same_order() -> None:
    """A trial's sum has the same bits alone and among many: one slot after the other, however it is computed."""
    rng = np.random.default_rng(5)
    numbers = rng.standard_normal((40, 200)) * 10.0 ** rng.integers(-8, 9, (40, 200))
    total = rng.standard_normal(200)
    together = added_in_order(total, numbers)
    alone = [added_in_order(total[[i]], numbers[:, [i]])[0] for i in range(200)]
    assert together.tolist() == alone

"""Digests, recomputed from their definition with struct and hashlib."""

from __future__ import annotations

import itertools
import struct
from hashlib import sha256

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.model.digest import BLOCK_SLOTS, BeliefLog, Blocks, PartialDigests, RunDigest
from evedrop.model.receiver import Belief


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
        whole = sha256()
        for x_hat, P, action, _ in beliefs[start : start + 256]:
            n = len(x_hat)
            whole.update(struct.pack("<B", 1 if action[r] else 0))
            for i in range(n):
                whole.update(struct.pack("<d", x_hat[i, r]))
            for i in range(n):
                for j in range(n):
                    whole.update(struct.pack("<d", P[i, j, r]))
        blocks.append(whole.digest())
    return blocks


def logged(beliefs: list[Belief], n: int, trials: int) -> dict[int, np.ndarray]:
    """Block, by its first slot → digests (R, 32), by the program."""
    log = BeliefLog(n, trials, len(beliefs))
    found = {}
    for k, belief in enumerate(beliefs):
        digests = log.add(k, belief)
        assert (digests is not None) == (k % 256 == 255 or k == len(beliefs) - 1)
        if digests is not None:
            block, rows = digests
            assert block == k // BLOCK_SLOTS * BLOCK_SLOTS
            found[block] = rows.copy()
    return found


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([1, 5, 255, 256, 257, 512, 600]), st.integers(1, 3), st.integers(1, 5), st.integers(0, 2**31))
def test_digests_are_as_defined(slots: int, n: int, trials: int, seed: int) -> None:
    """Every block of every trial, and the receiver's digest ordered by trial, then block."""
    beliefs = random_beliefs(slots, n, trials, seed)
    found = logged(beliefs, n, trials)
    expected = [defined(beliefs, r) for r in range(trials)]
    assert {block: [bytes(row) for row in rows] for block, rows in found.items()} == {
        256 * block: [one[block] for one in expected] for block in range(-(-slots // 256))
    }
    whole = RunDigest()
    whole.add(found)
    assert whole.hexadecimal == sha256(b"".join(b"".join(one) for one in expected)).hexdigest()


@pytest.mark.parametrize("trials", [1, 63, 64, 65, 130])
def test_digests_of_many_trials(trials: int) -> None:
    """Trials are digested in groups; no trial is mistaken for another at their edges."""
    beliefs = random_beliefs(7, 2, trials, 3)
    rows = logged(beliefs, 2, trials)[0]
    assert [bytes(row) for row in rows] == [defined(beliefs, r)[0] for r in range(trials)]


def test_trials_may_come_in_parts() -> None:
    """A run's digest does not depend on how many trials were computed at once, only on their order."""
    beliefs = random_beliefs(300, 2, 6, 9)
    found = logged(beliefs, 2, 6)
    whole, parts, swapped = RunDigest(), RunDigest(), RunDigest()
    whole.add(found)
    for digest, order in ((parts, (slice(0, 2), slice(2, 6))), (swapped, (slice(2, 6), slice(0, 2)))):
        for part in order:
            digest.add({block: rows[part] for block, rows in reversed(found.items())})
    assert parts.hexadecimal == whole.hexadecimal
    assert swapped.hexadecimal != whole.hexadecimal


@settings(deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["x_hat", "P", "gamma"]), st.data())
def test_any_bit_counts(seed: int, what: str, data: st.DataObject) -> None:
    """One changed bit of one trial in one slot changes that trial's digest and no other's."""
    beliefs = random_beliefs(5, 2, 3, seed)
    before = logged(beliefs, 2, 3)[0]
    k, r = data.draw(st.integers(0, 4)), data.draw(st.integers(0, 2))
    x_hat, P, action, _ = beliefs[k]
    if what == "gamma":
        action[r] = 0 if action[r] else 1
    else:
        changed = x_hat[1] if what == "x_hat" else P[1, 0]
        changed[r] = np.nextafter(changed[r], np.inf)
    after = logged(beliefs, 2, 3)[0]
    assert [not np.array_equal(one, other) for one, other in zip(before, after, strict=True)] == [
        i == r for i in range(3)
    ]


def test_rows_are_what_was_added() -> None:
    """The log gives back beliefs of the block at hand as they were added."""
    beliefs = random_beliefs(300, 2, 3, 1)
    log = BeliefLog(2, 3, 300)
    for k, belief in enumerate(beliefs):
        log.add(k, belief)
        if k in {0, 100, 255, 299}:
            first = max(k - 20, k // 256 * 256)
            rows = log.rows(first, k + 1)
            for field in ("x_hat", "P", "action"):
                assert np.array_equal(getattr(rows, field), [getattr(one, field) for one in beliefs[first : k + 1]])


@given(cuts=st.lists(st.integers(1, 39), max_size=4), seed=st.integers(0, 99))
@settings(max_examples=20)
def test_a_block_may_be_digested_in_parts(cuts: list[int], seed: int) -> None:
    """Whatever slots the parts have, its digests are those of the whole block."""
    beliefs = random_beliefs(40, 2, 3, seed)
    parts = PartialDigests(3)
    bounds = [0, *sorted(set(cuts)), 40]
    for first, end in itertools.pairwise(bounds):
        x_hat, P, action = (np.array([one[i] for one in beliefs[first:end]]) for i in range(3))
        parts.add(x_hat, P, action)
    assert np.array_equal(parts.digests(), logged(beliefs, 2, 3)[0])


@given(cuts=st.sets(st.integers(1, 699), max_size=4))
def test_blocks_know_where_each_slot_belongs(cuts: set[int]) -> None:
    """Blocks follow one another from slot 0 to the end, and end where a multiple of 256 slots or a cut is."""
    blocks = Blocks(700, sorted(cuts))
    starts = sorted({0, 256, 512, *cuts})
    for k in range(700):
        assert blocks.start(k) == max(start for start in starts if start <= k)
        assert blocks.end(k) == min([start for start in starts if start > k], default=700)

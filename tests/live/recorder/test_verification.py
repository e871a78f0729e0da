"""The recorder verifies reports: honest ones pass, and each kind of contradiction is found, with both values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.errors import Contradiction, MalformedMessage
from evedrop.live.protocol.codec import Reader
from evedrop.live.protocol.telemetry import Extent, Journal, Report, read_journal, read_report
from evedrop.live.recorder.verification import Verifier
from evedrop.model.digest import BlockDigests, Blocks, BlockSums
from evedrop.model.links.loss_model import REASONS
from evedrop.model.receiver import Belief
from evedrop.model.slot.link import COUNTED_BURSTS, Account
from evedrop.model.slot.records import LinkSlots, ReceiverSlots, SensorSlots
from evedrop.score.slots import Slots
from tests.builders import mirrored, one_slot

TRIALS, N, SLOTS, RECORDED = 4, 2, 600, 2
CUTS = (300, 310)


def beliefs(slots: int = SLOTS, trials: int = TRIALS) -> list[Belief]:
    """Any beliefs, with large and small ones next to each other."""
    rng = np.random.default_rng(5)
    P = rng.standard_normal((slots, N, N, trials)) * np.exp(4.0 * rng.standard_normal((slots, 1, 1, trials)))
    x_hat, action = rng.standard_normal((slots, N, trials)), rng.integers(0, 4, (slots, trials), np.uint8)
    return [Belief(x_hat[k], mirrored(P[k]), action[k]) for k in range(slots)]


def reports(batch: int, recorded: int = RECORDED, trials: int = TRIALS) -> list[Report]:
    """The reports of a receiver that ends them at the ends of batches and of blocks."""
    log, made, first = BlockDigests(trials, SLOTS, CUTS), [], 0
    sums, ended = BlockSums(trials, SLOTS, CUTS), dict[int, np.ndarray]()
    followed = beliefs(trials=trials)
    for k, belief in enumerate(followed):
        digests = log.add(range(k, k + 1), one_slot(belief))
        ended |= sums.add(range(k, k + 1), np.trace(belief.P)[None])
        if (k + 1) % batch and k + 1 < SLOTS and not digests:
            continue
        rows = followed[first : k + 1]
        traces = np.array([np.trace(row.P) for row in rows])
        made.append(
            Report(
                ReceiverSlots(
                    first,
                    np.array([row.x_hat for row in rows]),
                    np.array([row.action for row in rows]),
                    np.ascontiguousarray(np.array([row.P for row in rows])[..., :recorded]),
                    np.stack([traces.sum(axis=1), (traces**2).sum(axis=1)], axis=1),
                ),
                digests,
                ended if recorded < trials else {},
            )
        )
        first, ended = k + 1, {}
    return made


def verified(given: list[Report], recorded: int = RECORDED) -> None:
    """Have all reports checked."""
    verifier = Verifier({"eve": Blocks(SLOTS, CUTS)}, recorded, 10)
    for report in given:
        verifier.report("eve", report)


@pytest.mark.parametrize("recorded", [1, 2, TRIALS - 1, TRIALS])
@pytest.mark.parametrize("batch", [1, 7, 256, 600])
def test_an_honest_receiver_passes(batch: int, recorded: int) -> None:
    """However its slots are batched, with blocks that an outage cuts, and whether some or all trials are recorded."""
    verified(reports(batch, recorded), recorded)


def changed(place: int, **how: Callable[[Any], Any]) -> list[Report]:
    """Reports, one of them with other columns."""
    made = reports(100)
    for name, change in how.items():
        report = made[place]
        made[place] = with_columns(
            report, **{name: change(getattr(report if name in OF_BLOCKS else report.slots, name))}
        )
    return made


OF_BLOCKS = ("digests", "trace_sums")


def with_columns(report: Report, **changes: Any) -> Report:
    """A report with other columns, or other digests."""
    of_blocks = {name: changes.pop(name) for name in OF_BLOCKS if name in changes}
    return replace(report, slots=replace(report.slots, **changes), **of_blocks)


def at(where: tuple[int, ...], change: Callable[[Any], Any]) -> Callable[[np.ndarray], np.ndarray]:
    """An array with one number changed."""

    def done(array: np.ndarray) -> np.ndarray:
        copy = array.copy()
        copy[where] = change(copy[where])
        return copy

    return done


LIES = {
    "x_hat by one bit": (changed(1, x_hat=at((3, 0, 1), lambda x: np.nextafter(x, 9.0))), "slots 0 to 255 of trial 11"),
    "P by one bit": (changed(1, P=at((3, 0, 1, 0), lambda x: np.nextafter(x, 9.0))), "slots 0 to 255 of trial 10"),
    "gamma": (changed(0, action=at((0, 0), lambda code: 0 if code else 2)), "slots 0 to 255 of trial 10"),
    "digest": (
        changed(2, digests=lambda blocks: {k: at((1, 15), lambda byte: byte ^ 1)(one) for k, one in blocks.items()}),
        "slots 0 to 255 of trial 11",
    ),
    "less squares than are known": (changed(0, trace=lambda trace: trace * [1.0, 1e-9]), "its sums of tr P"),
    "a sum that the squares do not allow": (
        changed(0, trace=lambda trace: trace + np.array([1e9, 0.0])),
        "its sums of tr P",
    ),
}
"""What was changed → the reports, and the expected message."""


@pytest.mark.parametrize("case", LIES)
def test_a_receiver_that_contradicts_itself_is_found_out(case: str) -> None:
    """One bit of one recorded trial is enough, and so are sums that no trials have."""
    given, message = LIES[case]
    with pytest.raises(Contradiction, match=f"eve contradicts itself: .*{message}") as raised:
        verified(given)
    assert raised.value.at_fault == ("eve",)


def test_what_is_not_recorded_rests_on_its_own_word() -> None:
    """The digest of a trial that is not recorded cannot be computed: this is what `own_word` in the summary says."""
    verified(
        changed(2, digests=lambda blocks: {k: at((3, 0), lambda byte: byte ^ 1)(block) for k, block in blocks.items()})
    )


@pytest.mark.parametrize("factor", [[1.0 + 1e-6, 1.0], [1.0, 1.0 + 1e-6]])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_traces_of_recorded_trials_are_theirs(scale: float, factor: list[float]) -> None:
    """Where all trials are recorded the sums are known to within rounding, however large they are."""
    made = reports(100, TRIALS)
    slots = made[0].slots
    assert slots.trace is not None
    made[0] = with_columns(made[0], P=scale * slots.P, trace=slots.trace * [scale, scale**2] * factor)
    with pytest.raises(Contradiction, match="its sums of tr P"):
        verified(made, TRIALS)


@given(st.floats(-1e150, 1e150), st.floats(-1e300, 1e300))
def test_any_sums_are_judged(first: float, second: float) -> None:
    """Any numbers claimed as sums either pass or are a contradiction."""
    report = with_columns(reports(1)[0], trace=np.array([[first, second]]))
    try:
        Verifier({"eve": Blocks(SLOTS, CUTS)}, RECORDED, 0).report("eve", report)
    except Contradiction:
        return
    assert second >= 0.0
    assert abs(first) <= np.sqrt(TRIALS * second) * (1.0 + 1e-6)


@pytest.mark.parametrize("first", [True, False], ids=["before the report", "after it"])
@pytest.mark.parametrize(
    ("column", "place", "message"),
    [("x_hat", (1, 3), "its x_hat of trial 13 is"), ("P", (0, 0, 1), "its P of trial 11 is"), ("P", (0, 0, 3), None)],
)
def test_a_receiver_leaves_with_what_it_reported(
    column: str, place: tuple[int, ...], message: str | None, first: bool
) -> None:
    """Its last word before an outage, from which it is carried on, is what its report of the slot before says.

    The covariance of a trial that is not recorded is not in the report.
    """
    verifier, followed = Verifier({"eve": Blocks(SLOTS, CUTS)}, RECORDED, 10), beliefs()
    last = followed[299]
    other = at(place, lambda x: x + 1.0)(getattr(last, column))
    left = last._replace(x_hat=other) if column == "x_hat" else last._replace(P=other)
    *before, of_last = [report for report in reports(100) if report.slots.first < 300]
    for report in before:
        verifier.report("eve", report)
    two: list[Callable[[], None]] = [
        lambda: verifier.left("eve", 300, left),
        lambda: verifier.report("eve", of_last),
    ]
    earlier, later = two if first else two[::-1]
    earlier()
    if message is None:
        later()
        return
    with pytest.raises(Contradiction, match=f"before slot 300, with which it goes away, {message}"):
        later()


def slots_of(**changes: Any) -> Slots:
    """Two slots from 8 on, in which everybody says the same."""
    delivered = np.array([[True, False, True, True], [False, True, True, True]])
    late = np.zeros((2, TRIALS), np.uint16)
    action = np.where(delivered, 2, 0).astype(np.uint8)
    columns = {"action": action, "late": late, "late_used": late, "late_delivered": late, "sent": None, **changes}
    unsent = columns.get("unsent", np.zeros(2, np.uint32))
    receiver = ReceiverSlots(
        8,
        np.zeros((2, N, TRIALS)),
        columns["action"],
        np.zeros((2, N, N, 1)),
        np.zeros((2, 2)),
        columns["late"],
        columns["late_used"],
    )
    link = LinkSlots(8, delivered, np.zeros((2, len(REASONS)), np.uint32), unsent, columns["late_delivered"])
    sensor = SensorSlots(8, np.zeros((2, N, TRIALS)), np.zeros((2, TRIALS), bool), columns["sent"])
    return Slots(sensor, {"eve": receiver}, {"eve": link})


CLAIMS: dict[str, tuple[dict[str, Any], str]] = {
    "received": ({"action": np.array([[2, 0, 2, 2], [0, 0, 2, 2]], np.uint8)}, "eve contradicts router: in slot 9, trial 11, it "
                 r"says that it received nothing \(action 0\), but the journal says that it was delivered"),
    "lost": ({"action": np.array([[2, 3, 2, 2], [0, 2, 2, 2]], np.uint8)}, "eve contradicts router: in slot 8, trial 11, it "
             r"says that it received the packet \(action 3\), but the journal says that it was not delivered"),
    "late": ({"late": np.eye(2, TRIALS, dtype=np.uint16)}, "eve contradicts router: in slot 8, trial 10, it says that 1 late "
             "packets arrived, but the journal says 0"),
    "sent": ({"sent": np.ones((2, TRIALS), bool) & (np.arange(TRIALS) > 0)}, "sensor contradicts router: in slot 8 it says that "
             "1 trials sent nothing, but the journal says 0"),
    "delivered": ({"sent": np.ones((2, TRIALS), bool) & (np.arange(TRIALS) > 0), "unsent": np.ones(2, np.uint32)}, "in slot 8 it "
                  "says that 1 trials sent nothing, but the journal says 1, or that a packet of one of them was delivered"),
}  # fmt: skip
"""What a process claims against the journal → the columns, and the expected message."""


def test_slots_in_which_all_say_the_same_pass() -> None:
    """Nobody is accused."""
    Verifier({}, 1, 10).joined(slots_of())
    Verifier({}, 1, 10).joined(slots_of(sent=np.ones((2, TRIALS), bool)))
    Verifier({}, 1, 10).joined(slots_of(late=None, late_used=None, late_delivered=None))
    silent = np.array([[True, False, True, True], [False, True, True, True]])
    Verifier({}, 1, 10).joined(slots_of(sent=silent, unsent=np.ones(2, np.uint32)))


@pytest.mark.parametrize("case", CLAIMS)
def test_who_contradicts_the_journal_is_found_out(case: str) -> None:
    """In one trial of one slot, recorded or not: the process, the slot, the trial and both values are named."""
    changes, message = CLAIMS[case]
    with pytest.raises(Contradiction, match=message):
        Verifier({}, 1, 10).joined(slots_of(**changes))


EXTENT = Extent(SLOTS, 300, N, TRIALS, RECORDED)
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "a block that does not end": (
        {"digests": {1: np.zeros((4, 32), np.uint8)}},
        r"digests of block 1; expected none: no block",
    ),
    "a block of no run": ({"digests": {2**63: np.zeros((4, 32), np.uint8)}}, "digests of block 9223372036854775808"),
    "a block before the run": ({"digests": {-5: np.zeros((4, 32), np.uint8)}}, "digests of block -5"),
    "late beyond the window": (
        {"late": np.full((100, 4), 4, np.uint16), "late_used": np.zeros((100, 4), np.uint16)},
        "late of 4; expected numbers from 0 to 3",
    ),
    "late, and nothing of their use": (
        {"late": np.zeros((100, 4), np.uint16)},
        "late_used of None; expected 800 bytes",
    ),
    "used that never came": (
        {"late": np.zeros((100, 4), np.uint16), "late_used": np.ones((100, 4), np.uint16)},
        "more in late_used than in late",
    ),
    "another shape": ({"x_hat": np.zeros((100, N, 3))}, "x_hat of 4800 bytes; expected 6400 bytes"),
    "more slots than a batch": ({"x_hat": np.zeros((301, N, 4))}, "c = 301; expected an integer c from 1 to 300"),
}
"""What is wrong with a report → its columns, and the expected message."""


@pytest.mark.parametrize("case", WRONG)
def test_a_report_that_no_run_has_is_refused(case: str) -> None:
    """Blocks, slots, shapes and counts are held to what the run has."""
    changes, message = WRONG[case]
    raw = with_columns(reports(100)[0], **changes).pack()
    window = 3 if "late" in changes else 0
    with pytest.raises(MalformedMessage, match=f"telemetry/eve: {message}") as raised:
        read_report(Reader("evedrop/r/telemetry/eve", raw), 0, EXTENT, Blocks(SLOTS, CUTS), window)
    assert raised.value.at_fault == ("eve",)


def test_digests_that_are_due_are_missed() -> None:
    """A report without the digests of a block that ends in it is refused, or its metrics could never be verified."""
    raw = with_columns(reports(100)[2], digests={}).pack()
    with pytest.raises(
        MalformedMessage, match=r"digests of blocks \[\]; expected those of \[0\], which end in these slots"
    ):
        read_report(Reader("evedrop/r/telemetry/eve", raw), 200, EXTENT, Blocks(SLOTS, CUTS))


@pytest.mark.parametrize("first", [600, 2**40])
def test_nothing_follows_the_last_slot(first: int) -> None:
    """A report of slots after the run's last is refused, even where it is the next one."""
    raw = with_columns(reports(100)[0], first=first).pack()
    with pytest.raises(MalformedMessage, match="c = 100; expected an integer c from 1 to"):
        read_report(Reader("evedrop/r/telemetry/eve", raw), first, EXTENT, Blocks(SLOTS, CUTS))


JOURNALS: dict[str, tuple[dict[str, Any], str]] = {
    "more fates than packets": ({"lost": np.eye(1, len(REASONS), dtype=np.uint32)},
                                r"5 fates of eve's packets of slot 7; expected 4 fates"),
    "fewer fates than packets": ({"delivered": np.array([[True, True, False, True]])},
                                 r"3 fates of eve's packets of slot 7; expected 4 fates"),
    "more bursts than packets": ({"bursts": np.full(COUNTED_BURSTS, 5, np.uint32)}, "bursts of 5; expected numbers from 0 to 4"),
    "more delays than packets": ({"delays": np.full(2, 3, np.uint32)},
                                 r"delays of eve's packets for \[3, 0, 3\] .*; expected those of \[4, 0, 0\]"),
}  # fmt: skip
"""What is wrong with a journal → the columns of its link, and the expected message."""


@pytest.mark.parametrize("case", JOURNALS)
def test_a_journal_that_does_not_add_up_is_refused(case: str) -> None:
    """Every packet has one fate; a journal in which one has none, or two, is malformed."""
    of_case, message = JOURNALS[case]
    changes = dict(of_case)
    no_loss, none = np.zeros((1, len(REASONS)), np.uint32), np.zeros(1, np.uint32)
    histograms = {"bursts": np.zeros(COUNTED_BURSTS, np.uint32), "delays": np.array([4, 0], np.uint32)}
    histograms |= {name: changes.pop(name) for name in histograms if name in changes}
    slots = replace(LinkSlots(7, np.ones((1, 4), bool), no_loss, none), **changes)
    link = Account(slots, **histograms)
    raw = Journal(7, 1, {"eve": link}).pack()
    with pytest.raises(MalformedMessage, match=message) as raised:
        read_journal(Reader("evedrop/r/journal", raw), 7, {"eve": 0}, EXTENT)
    assert raised.value.at_fault == ("router",)


@pytest.mark.parametrize(
    ("trial", "message"),
    [
        (1, r"sum of tr P over slots 0 to 255 of trial 11 is .*, and what it reported of these slots gives"),
        (3, r"sum of tr P over slots 0 to 255 of all trials is .*, and what it reported of these slots gives"),
    ],
)
def test_wrong_sums_over_blocks(trial: int, message: str) -> None:
    """Of a recorded trial, and of another one, by the sum over all trials; both values are named."""

    def more(sums: dict[int, Any]) -> dict[int, Any]:
        return {block: np.where(np.arange(TRIALS) == trial, 1.5 * values, values) for block, values in sums.items()}

    with pytest.raises(Contradiction, match=message):
        verified(changed(2, trace_sums=more))

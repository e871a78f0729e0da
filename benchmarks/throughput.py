"""How many slots a second live runs carry into the results, over raw Zenoh carrying the same messages.

    python benchmarks/throughput.py [--quick]

A run and its yardstick take turns, and the median of the ratios is quoted.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator

import raw
from live_run import rate
from table import Row, judged, run_alone

SCENARIO = "eavesdroppers"
RECEIVERS = 4


def carried(trials: int, slots: int, rounds: int) -> tuple[float, float, float]:
    """Slots a second of a run and of raw Zenoh, and the ratio."""
    pairs = [
        (
            rate(SCENARIO, "--pace", "0", "--slots", str(slots), "--trials", str(trials)),
            raw.throughput(slots, trials, RECEIVERS),
        )
        for _ in range(rounds)
    ]
    ours, bare = zip(*pairs, strict=True)
    return statistics.median(ours), statistics.median(bare), statistics.median(a / b for a, b in pairs)


def one_trial(slots: int, rounds: int) -> Row:
    """One trial, compared with raw Zenoh."""
    ours, bare, ratio = carried(1, slots, rounds)
    return Row(
        f"one trial, sensor and {RECEIVERS} receivers, into the results",
        f"{ours:,.0f} slots/s, {ratio:.2f} of raw Zenoh",
        f"raw Zenoh: {bare:,.0f} slots/s",
        "12,000 slots/s",
        "20,000 slots/s, 0.3 of raw Zenoh",
        judged(ours >= 12_000, ours >= 20_000 and ratio >= 0.3),
    )


def web_view(slots: int, rounds: int) -> Row:
    """One trial with the web view, which no browser looks at, compared with one without a view."""
    options = ("--pace", "0", "--slots", str(slots))
    pairs = [(rate(SCENARIO, *options, "--view", "web"), rate(SCENARIO, *options)) for _ in range(rounds)]
    ratio = statistics.median(a / b for a, b in pairs)
    web, off = (statistics.median(column) for column in zip(*pairs, strict=True))
    return Row(
        "the same with the web view",
        f"{web:,.0f} slots/s, {ratio:.2f} of without",
        f"without a view: {off:,.0f} slots/s",
        "0.8",
        "0.95",
        judged(ratio >= 0.8, ratio >= 0.95),
    )


def thousand_trials(slots: int, rounds: int) -> Row:
    """A batch of a thousand trials, compared with raw Zenoh."""
    each = 1000 * RECEIVERS / 1e6
    ours, bare, ratio = carried(1000, slots, rounds)
    return Row(
        f"1000 trials, {RECEIVERS} receivers",
        f"{ours * each:.2f} million deliveries/s, {ratio:.2f} of raw Zenoh",
        f"raw Zenoh: {bare * each:.2f} million deliveries/s",
        "6 million deliveries/s",
        "10 million deliveries/s",
        judged(ours * each >= 6, ours * each >= 10),
    )


def closed_loop(slots: int, rounds: int) -> Row:
    """A run in which sensor and controller wait for each other."""
    ours = statistics.median(rate("microgrid", "--pace", "0", "--slots", str(slots)) for _ in range(rounds))
    return Row(
        f"closed loop in lock-step, `microgrid --slots {slots}`, one trial",
        f"{ours:,.0f} slots/s, {ours / 870:.1f} × 870",
        "870 slots/s",
        "3 × 870 slots/s",
        "5 × 870 slots/s",
        judged(ours >= 3 * 870, ours >= 5 * 870),
    )


def rows(quick: bool) -> Iterator[Row]:
    """The four rates."""
    rounds = 1 if quick else 5
    yield one_trial(500 if quick else 60_000, rounds)
    yield web_view(500 if quick else 60_000, rounds)
    yield thousand_trials(50 if quick else 8_000, rounds)
    yield closed_loop(300 if quick else 20_000, 1 if quick else 3)


if __name__ == "__main__":
    run_alone(rows)

"""How many slots a second live runs carry into the results, over raw Zenoh carrying the same messages.

    python benchmarks/throughput.py [--quick]

A run and its yardstick take turns, and the median of the ratios is quoted.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Iterator
from typing import Any

import raw
from live_run import rate, scenario_file
from table import Row, judged, run_alone

SCENARIO = "eavesdroppers"
RECEIVERS = 4
_MANY = {4: 48_980, 16: 16_500, 63: 3_832}
"""Number of eavesdroppers → the least slots a second."""


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
        "66,600 slots/s",
        "100,000 slots/s, 0.5 of raw Zenoh",
        judged(ours >= 66_600, ours >= 100_000 and ratio >= 0.5),
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
        "0.9",
        "0.95",
        judged(ratio >= 0.9, ratio >= 0.95),
    )


def thousand_trials(slots: int, rounds: int) -> Row:
    """A batch of a thousand trials, compared with raw Zenoh."""
    each = 1000 * RECEIVERS / 1e6
    ours, bare, ratio = carried(1000, slots, rounds)
    return Row(
        f"1000 trials, {RECEIVERS} receivers",
        f"{ours * each:.2f} million deliveries/s, {ratio:.2f} of raw Zenoh",
        f"raw Zenoh: {bare * each:.2f} million deliveries/s",
        "12 million deliveries/s",
        "20 million deliveries/s",
        judged(ours * each >= 12, ours * each >= 20),
    )


def closed_loop(slots: int, rounds: int) -> Row:
    """A run in which sensor and controller wait for each other."""
    ours = statistics.median(rate("microgrid", "--pace", "0", "--slots", str(slots)) for _ in range(rounds))
    return Row(
        f"closed loop in lock-step, `microgrid --slots {slots}`, one trial",
        f"{ours:,.0f} slots/s",
        "none",
        "9,400 slots/s",
        "14,100 slots/s",
        judged(ours >= 9_400, ours >= 14_100),
    )


def many_eavesdroppers(number: int, slots: int, rounds: int) -> Row:
    """One trial with many eavesdroppers, half smart, half naive."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = scenario_file(folder, eavesdroppers(number, slots))
        ours = statistics.median(rate(scenario) for _ in range(rounds))
    least = _MANY[number]
    return Row(
        f"one trial, {number} eavesdroppers, half smart, half naive",
        f"{ours:,.0f} slots/s, {ours * (number + 1):,.0f} deliveries/s",
        "none",
        f"{least:,.0f} slots/s",
        f"{2 * least:,.0f} slots/s",
        judged(ours >= least, ours >= 2 * least),
    )


def eavesdroppers(number: int, slots: int) -> dict[str, Any]:
    """The entries of a scenario with so many eavesdroppers."""
    strategies = ("smart", "naive")
    tables = {f"e{i}": {"strategy": strategies[i % 2], "link": {"quality": 0.9}} for i in range(number)}
    return {"slots": slots, "trials": 1, "pace": 0.0, "eavesdroppers": tables}


def rows(quick: bool) -> Iterator[Row]:
    """The rates; the least ones are twice, with 1000 trials 1.5 times, those of dd03e67 on two processors of an Intel Xeon."""
    rounds = 1 if quick else 5
    yield one_trial(500 if quick else 60_000, rounds)
    yield web_view(500 if quick else 60_000, rounds)
    yield thousand_trials(50 if quick else 16_000, rounds)
    yield closed_loop(300 if quick else 20_000, 1 if quick else 3)
    for number, slots in ((4, 40_000), (16, 16_000), (63, 8_000)):
        yield many_eavesdroppers(number, 200 if quick else slots, 1 if quick else 3)


if __name__ == "__main__":
    run_alone(rows)

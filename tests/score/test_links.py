"""The channel's check of itself: right links pass it, wrong ones do not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evedrop.model.slot.link import Accountant, Link
from evedrop.model.streams import Batch
from evedrop.scenario.loading import checked
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.score.links import RATE_CONFIDENCE, Detection, interval, link_summary_of
from evedrop.score.sums import Tally
from tests.builders import scalar_tables

LINKS: dict[str, dict[str, Any]] = {
    "coins": {"quality": 0.9},
    "bursts": {"loss": {"model": "gilbert-elliott", "p": 0.02, "r": 0.3}},
    "pattern": {"loss": {"model": "pattern", "outcomes": "1101"}},
    "far": {
        "loss": {
            "model": "distance",
            "sender": [0.0, 0.0],
            "receiver": [[0, 50.0, 0.0], [300, 250.0, 0.0]],
            "reference_snr": 80.0,
            "exponent": 3.0,
            "threshold": 10.0,
            "shadowing": 6.0,
            "shadowing_block": 20,
        }
    },
    "slow": {"quality": 0.8, "delay": {"model": "normal", "mean": 2.0, "standard_deviation": 1.0}},
    "narrow": {"quality": 0.8, "rate": 0.7, "queue": 4},
    "never": {"quality": 0.0},
    "always": {"quality": 1.0},
}


def linked(seed: int, events: list[dict[str, Any]] | None = None) -> Scenario:
    """A scenario with an eavesdropper behind each of these links."""
    return checked(
        scalar_tables(
            1.0,
            0.1,
            slots=400,
            trials=20,
            seed=seed,
            encoding={"scheme": "plain"},
            eavesdroppers={name: {"strategy": "naive", "link": link, "window": 4} for name, link in LINKS.items()},
            event=events or [],
        ),
        "scenario",
    )


def tally_of(scenario: Scenario, name: str) -> Tally:
    """What a run would have counted."""
    schedule = scenario.schedule(name)
    batch, accountant = Batch(scenario.slots, scenario.trials), Accountant(schedule.window, scenario.trials)
    fates = Link(schedule, name, StreamKeys.from_scenario(scenario).link(name, schedule), batch).fates(
        range(scenario.slots)
    )
    account = accountant.account(range(scenario.slots), fates)
    tally = Tally(scenario.slots, scenario.trials, done=scenario.slots, offered=scenario.slots * scenario.trials)
    tally.account(account.slots, account.slots.delivered.astype(np.uint8))
    tally.count(account)
    return tally


def test_right_links_are_within_their_intervals() -> None:
    """Every link that runs by its model, over 12 seeds: of 96 intervals of 99.9 % none is missed, or one."""
    outside = 0
    for seed in range(12):
        right = linked(
            seed,
            [
                {"from": 100, "to": 150, "link": "coins", "set": {"quality": 0.3}},
                {"from": 200, "to": 220, "cut": "bursts"},
            ],
        )
        for name in LINKS:
            outside += link_summary_of(right, name, tally_of(right, name)).within_interval is False
    assert outside <= 1


@pytest.mark.parametrize("name", ["coins", "bursts", "pattern", "far", "slow"])
def test_a_link_with_another_model_is_flagged(name: str) -> None:
    """The counts of one link are outside the interval of a model with other losses."""
    right = linked(3)
    changed = linked(3, [{"at": 1, "link": name, "set": {"quality": 0.45}}])
    assert link_summary_of(changed, name, tally_of(right, name)).within_interval is False


def test_the_packets_that_a_full_queue_refuses_do_not_count() -> None:
    """The interval is that of the independent packets that reached the loss model."""
    right = linked(3, [{"at": 0, "link": "coins", "set": {"rate": 0.2, "queue": 1}}])
    tally = tally_of(right, "coins")
    met = right.slots * right.trials - tally.lost["overflow"]
    assert met < 0.25 * right.slots * right.trials
    summary = link_summary_of(right, "coins", tally)
    assert summary.rate == 1 - tally.lost["lost"] / met
    assert summary.interval == pytest.approx(interval(summary.rate, 0.9, 0.09 / met), rel=1e-12)


@pytest.mark.parametrize("name", ["pattern", "bursts"])
def test_no_rate_where_a_full_queue_picks_the_packets_of_a_model_with_a_memory(name: str) -> None:
    """Every other packet may be one that the pattern lets through."""
    right = linked(3, [{"at": 0, "link": name, "set": {"rate": 0.5, "queue": 1}}])
    summary = link_summary_of(right, name, tally_of(right, name))
    assert summary.lost_by["overflow"] > 0
    assert (summary.rate, summary.expected_rate, summary.interval, summary.within_interval) == (None,) * 4


def test_no_rate_where_a_link_with_a_full_queue_is_cut() -> None:
    """A packet that the queue refuses during a cut is counted as refused."""
    right = linked(3, [{"at": 10, "cut": "narrow"}, {"at": 390, "heal": "narrow"}])
    assert link_summary_of(right, "narrow", tally_of(right, "narrow")).rate is None


def test_a_chain_goes_on_while_other_settings_change() -> None:
    """Its slots are correlated across the changes, so that the interval stays as wide as without them."""
    plain = linked(3)
    events = [{"from": k, "to": k + 2, "link": "bursts", "set": {"corrupt": 0.1}} for k in range(2, 398, 4)]
    changed = linked(3, events)
    summaries = [link_summary_of(right, "bursts", tally_of(right, "bursts")) for right in (plain, changed)]
    assert summaries[1].lost_by["corrupted"] > 0
    assert summaries[0].rate == summaries[1].rate
    assert summaries[0].interval == summaries[1].interval


def test_a_chain_goes_on_during_a_cut() -> None:
    """The variance of the rate against a sum over all pairs of slots."""
    right = linked(3, [{"from": k, "to": k + 2, "cut": "bursts"} for k in range(2, 398, 4)])
    summary = link_summary_of(right, "bursts", tally_of(right, "bursts"))
    mean, fading = 0.3 / 0.32, 1 - 0.02 - 0.3
    up = np.array([k for k in range(400) if k < 2 or k % 4 < 2 or k >= 398])
    variance = mean * (1 - mean) * (fading ** np.abs(up[:, None] - up)).mean() / right.trials
    assert summary.rate is not None
    assert summary.interval == pytest.approx(interval(summary.rate, mean, variance), rel=1e-9)


def test_every_loss_has_a_reason_in_a_run_cut_short() -> None:
    """Late packets that the receiver has not taken when the run ends are under way."""
    lossy = linked(3)
    tally = tally_of(lossy, "slow")
    assert tally.late_sent > tally.late == 0
    account = link_summary_of(lossy, "slow", tally)
    assert account.lost_by["underway"] == tally.late_sent + tally.lost["underway"]
    assert sum(account.lost_by.values()) == account.lost


def test_the_interval_is_clopper_and_pearsons() -> None:
    """By its defining tails, of a binomial distribution, against summed probabilities."""
    from scipy.stats import binom

    count, received, expected = 200, 150, 0.8
    low, high = interval(received / count, expected, expected * (1 - expected) / count)
    tail = (1 - RATE_CONFIDENCE) / 2
    assert binom.sf(received - 1, count, low) == pytest.approx(tail, rel=1e-6)
    assert binom.cdf(received, count, high) == pytest.approx(tail, rel=1e-6)
    assert interval(0.75, 0.75, 0.0) == (0.75, 0.75)


def test_bursts_and_delays_stand_beside_their_models() -> None:
    """Mean burst length 1/r of a Gilbert link, within what 12 runs scatter; delay fractions within 5 standard errors."""
    summaries = [link_summary_of(right := linked(seed), "bursts", tally_of(right, "bursts")) for seed in range(12)]
    lengths = np.array([summary.mean_burst for summary in summaries])
    assert summaries[0].expected_mean_burst == pytest.approx(1 / 0.3, rel=0.02)
    assert abs(lengths.mean() - summaries[0].expected_mean_burst) < 5 * lengths.std(ddof=1) / np.sqrt(12)
    right = linked(5)
    slow = link_summary_of(right, "slow", tally_of(right, "slow"))
    total = 0.8 * right.slots * right.trials
    assert slow.delays is not None
    assert slow.expected_delays is not None
    for fraction, expected in zip(slow.delays, slow.expected_delays, strict=True):
        assert abs(fraction - expected) < 5 * np.sqrt(expected * (1 - expected) / total) + 1e-12
    assert slow.delay_quantiles == {"0.5": 1, "0.9": 3, "0.99": 4}


@pytest.mark.parametrize("events", [[], [{"at": 12, "cut": "bursts"}]])
def test_bursts_of_a_short_run_are_compared_with_those_that_a_short_run_has(events: list[dict[str, Any]]) -> None:
    """The long ones end too late more often: 2.6 packets on average in 12 slots, 2.8 if a cut ends all of them, not 1/0.3."""
    tables = scalar_tables(
        1.0,
        0.1,
        slots=16 if events else 12,
        trials=20_000,
        encoding={"scheme": "plain"},
        eavesdroppers={"bursts": {"strategy": "naive", "link": LINKS["bursts"]}},
        event=events,
    )
    short = checked(tables, "scenario")
    tally = tally_of(short, "bursts")
    summary, number = link_summary_of(short, "bursts", tally), tally.bursts.sum()
    mean, expected = summary.mean_burst, summary.expected_mean_burst
    assert mean is not None
    assert expected is not None
    error = np.sqrt((tally.bursts @ np.arange(1, 65) ** 2 / number - mean * mean) / number)
    assert abs(mean - expected) < 4.0 * error
    assert abs(mean - 1 / 0.3) > 8.0 * error


def test_no_burst_is_expected_of_a_sensor_that_stays_silent() -> None:
    """A slot without a packet ends a burst, which would last for 1/0.3 slots otherwise."""
    right = linked(3)
    tally = tally_of(right, "bursts")
    tally.unsent += 1
    assert link_summary_of(right, "bursts", tally).expected_mean_burst is None


def test_packets_that_a_receiver_misses_and_those_that_the_end_cuts_off_count_by_their_delays() -> None:
    """Slow ones would be missing more often: the fractions are within 5 standard errors of the model all the same."""
    right = linked(5, [{"from": k, "to": k + 2, "pause": "slow"} for k in range(4, 396, 6)])
    slow = link_summary_of(right, "slow", tally_of(right, "slow"))
    assert slow.lost_by["paused"] > 0
    assert slow.lost_by["underway"] > 0
    assert slow.delays is not None
    assert slow.expected_delays is not None
    total = slow.delivered + sum(slow.lost_by[reason] for reason in ("late", "paused", "underway"))
    for fraction, expected in zip(slow.delays, slow.expected_delays, strict=True):
        assert abs(fraction - expected) < 5 * np.sqrt(expected * (1 - expected) / total) + 1e-12


def test_a_quantile_that_is_met_exactly_is_met() -> None:
    """Of ten packets three are in time and six a slot late: nine of ten, although 0.3 + 0.6 is less than 0.9 in doubles."""
    right = linked(1)
    tally = Tally(right.slots, right.trials)
    tally.delays = np.array([3, 6, 1, 0, 0, 0])
    assert link_summary_of(right, "slow", tally).delay_quantiles == {"0.5": 1, "0.9": 1, "0.99": 2}


def test_nothing_is_said_of_what_was_not_measured() -> None:
    """Of a run that did not begin."""
    right = linked(1)
    summary = link_summary_of(right, "coins", Tally(right.slots, right.trials))
    assert (summary.rate, summary.interval, summary.within_interval, summary.mean_burst) == (None, None, None, None)


def test_the_first_alarm_of_a_trial_counts() -> None:
    """Whichever slots come together: of two alarms in one message, and of those in later ones."""
    detection = Detection(3)
    for first, alarms in (
        (0, [[False, False, False]]),
        (1, [[True, False, False], [True, False, True]]),
        (3, [[True] * 3]),
    ):
        detection.add_alarms(first, np.array(alarms))
    assert detection.first.tolist() == [1, 3, 2]

"""A scenario in a few lines."""

from __future__ import annotations

from evedrop import Scenario
from tests.builders import GOOD


def test_a_scenario_is_shown_in_lines() -> None:
    """Units, slots in seconds, parameters, several links, models; of a long list its length, of other tables their names."""
    scenario = Scenario(GOOD).replace(
        title='A "small" one',
        slots=4000,
        trials=20,
        seed=7,
        slot_seconds=0.5,
        process={
            "A": [[1.0, 0.1], [0.0, 1.0]],
            "Q": [[0.1, 0.0], [0.0, 0.1]],
            "initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
            "states": ["position", "speed"],
            "units": ["m", "m/s"],
        },
        encoding={"scheme": "innovation", "state_probability": [0.4] * 4000},
        legitimate={"link": {"loss": {"model": "gilbert-elliott", "p": 0.05, "r": 0.25}}, "window": 3},
        eavesdroppers={
            "ring": {"strategy": "colluding", "reads_as": "smart", "links": [{"quality": 0.6}, {"quality": 0.5}]},
            "lone": {"strategy": "suspicious", "use_state": 0.8, "use_innovation": 0.2, "link": {"quality": 0.7}},
        },
        event=[{"at": 5, "cut": "legitimate"}],
    )
    assert repr(scenario) == str(scenario)
    assert repr(scenario).splitlines() == [
        r'Scenario "A \"small\" one"',
        "  slots       4,000 of 0.5 s, 20 trials, seed 7",
        "  process     2 states: position (m), speed (m/s)",
        "  scheme      innovation (state_probability of 4,000 values)",
        "  legitimate  (window 3), link loss gilbert-elliott (p 0.05, r 0.25)",
        "  ring        colluding (reads_as smart), link quality 0.6, link quality 0.5",
        "  lone        suspicious (use_state 0.8, use_innovation 0.2), link quality 0.7",
        "  also given  event",
    ]


def test_a_line_of_a_scenario_is_cut() -> None:
    """What is long stands in the file."""
    names = [f"state{i:02}" for i in range(20)]
    unit = [[float(i == j) for j in range(20)] for i in range(20)]
    process = {"A": unit, "Q": unit, "initial_covariance": unit, "states": names}
    lines = repr(Scenario(GOOD).replace(process=process)).splitlines()
    assert max(map(len, lines)) <= 120
    assert "20 states: state00, state01" in lines[2]
    assert lines[2].endswith("…")

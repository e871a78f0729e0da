"""A sensor that measures and filters, and a singular Q: what `evedrop check` refuses, and why."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest

from evedrop.model.local_filter import settled
from evedrop.scenario.loading import checked
from evedrop.scenarios import shipped
from tests.builders import changed, mistakes_of, places_of
from tests.golden.pages import Golden

MEASURED = {**tomllib.loads(shipped()["measured"].read_text(encoding="utf-8")), "expect": []}
FORCE = [[2.5e-5, 5e-4], [5e-4, 1e-2]]


EVE = {"eve": {"strategy": "bayesian", "link": {"quality": 0.9}}}
NO_PLANT: dict[str, Any] = {
    "plant": None,
    "process__Q": FORCE,
    "process__singular_noise": True,
    "process__initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
}
STEERED = {
    "plant__inputs": ["force"],
    "plant__input_matrix": [[0.005], [0.1]],
    "controller": {"strategy": "lqr", "state_weights": [1.0, 1.0], "input_weights": [1.0]},
}

WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "the velocity alone": (
        {"plant__output_matrix": [[0.0, 1.0]]},
        "plant.output_matrix",
    ),
    "nothing": (
        {"plant__output_matrix": [[0.0, 0.0]]},
        "plant.output_matrix",
    ),
    "the same twice, exactly": (
        {
            "plant__output_matrix": [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]],
            "plant__measurement_noise": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.01]],
        },
        "plant.measurement_noise",
    ),
    "an unstable mode unseen": (
        {
            "process__A": [[1.2, 0.0], [0.0, 0.5]],
            "plant__output_matrix": [[0.0, 1.0]],
            "plant__noise": [[1.0, 0.0], [0.0, 1.0]],
        },
        "plant.output_matrix",
    ),
    "no noise": (
        {"plant__noise": [[0.0, 0.0], [0.0, 0.0]]},
        "plant.noise",
    ),
    "a stable plant at rest": (
        {"process__A": [[0.9, 0.1], [0.0, 0.9]], "plant__noise": [[0.0, 0.0], [0.0, 0.0]]},
        "plant.output_matrix",
    ),
    "not settled": (
        {"process__initial_covariance": [[1.0, 0.0], [0.0, 1.0]], "eavesdroppers": EVE},
        "eavesdroppers.eve.strategy",
    ),
    "inputs": (
        {**STEERED, "eavesdroppers": {"eve": {**EVE["eve"], "strategy": "likelihood"}}},
        "eavesdroppers.eve.strategy",
    ),
    "another noise": (
        {
            "plant": {"noise": [[1e-4, 0.0], [0.0, 1e-4]]},
            "process__Q": FORCE,
            "process__singular_noise": True,
            "process__initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
        },
        "eavesdroppers.bayesian.strategy",
    ),
    "singular twice": (
        {**NO_PLANT, "process__A": [[1.0, 1.0], [1.0, 1.0]], "slots": 20},
        "eavesdroppers.genie.strategy",
    ),
    "a track of its own": (
        {**NO_PLANT, "eavesdroppers": {"eve": {"strategy": "tracker", "link": {"quality": 0.9}}}},
        "eavesdroppers.eve.strategy",
    ),
    "too near": (
        {
            **NO_PLANT,
            "process__A": [[2.0, 0.0], [1.5, 0.5]],
            "process__Q": [[1.0, 1.0], [1.0, 1.0]],
            "slots": 44,
        },
        "slots",
    ),
    "nothing moves": (
        {**NO_PLANT, "process__Q": [[0.0, 0.0], [0.0, 0.0]]},
        "process.Q",
    ),
    "too long": (
        {**NO_PLANT, "process__A": [[2.0, 0.0], [1.5, 0.5]], "process__Q": [[1.0, 1.0], [1.0, 1.0]], "slots": 100},
        "slots",
    ),
    "no filter": (
        {"plant": None},
        "process.initial_covariance",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_says_where_what_and_what_instead(case: str, golden: Golden) -> None:
    """Path, what was found, what was expected."""
    changes, place = WRONG[case]
    mistakes = mistakes_of(checked, changed(MEASURED, **changes), "file")
    assert place in places_of(mistakes)
    golden("check", mistakes)


@pytest.mark.parametrize(
    "noise",
    [
        [[-1.0, 0.1]],
        [[1.0], [1.0]],
        [[1.0, 0.0], [0.0]],
        [[-1.0, 0.0], [0.0, 1.0]],
        [[1.0, 0.5], [0.0, 1.0]],
    ],
)
def test_a_plants_noise_that_is_no_covariance_is_the_only_mistake(noise: list[list[float]]) -> None:
    """No filter is computed with it, so nothing is said of the filter's measurements."""
    (line,) = mistakes_of(checked, changed(MEASURED, plant__noise=noise), "file")
    assert line.startswith("plant.noise: ")


NONSINGULAR: dict[str, Any] = {
    "process__Q": [[2.5e-5 + 1e-9, 5e-4], [5e-4, 1e-2 + 1e-9]],
    "process__singular_noise": None,
}
SETTLED = {"plant__output_matrix": [[1.0, 0.0], [0.0, 1.0]], "plant__measurement_noise": [[0.01, 0.0], [0.0, 0.01]]}
TRACKER: dict[str, Any] = {"eavesdroppers": {"eve": {**EVE["eve"], "strategy": "tracker"}}}


@pytest.mark.parametrize(
    ("refused", "strategy", "more"),
    [
        (WRONG["a track of its own"][0], "smart", NONSINGULAR),
        (
            {**WRONG["singular twice"][0], "eavesdroppers": {"eve": {**EVE["eve"], "strategy": "genie"}}},
            "smart",
            NONSINGULAR,
        ),
        ({**WRONG["another noise"][0], "eavesdroppers": EVE}, "genie", NONSINGULAR),
        (TRACKER, "smart", SETTLED),
    ],
)
def test_a_strategy_that_cannot_use_a_singular_Q_is_refused_with_what_can_be_done(
    refused: dict[str, Any], strategy: str, more: dict[str, Any]
) -> None:
    """Another strategy, noise in every direction, or as many measurements as states: what the message names works."""
    (line,) = mistakes_of(checked, changed(MEASURED, **refused), "file")
    assert strategy in line.partition("; expected ")[2]
    assert "add a small variance to the diagonal of Q and leave out singular_noise" in line
    assert "as many measurements as states" in line
    assert checked(
        changed(MEASURED, **{**refused, "eavesdroppers": {"eve": {**EVE["eve"], "strategy": strategy}}}), "file"
    )
    assert checked(changed(MEASURED, **{**refused, **more}), "file")


RIGHT: dict[str, dict[str, Any]] = {
    "as it is": {},
    "a genie before the filter has settled": {
        "process__initial_covariance": [[1.0, 0.0], [0.0, 1.0]],
        "eavesdroppers": {"eve": {**EVE["eve"], "strategy": "genie"}},
    },
    "a stable mode that is not seen": {
        "process__A": [[1.0, 0.0], [0.0, 0.5]],
        "plant__noise": [[1e-2, 0.0], [0.0, 1e-2]],
    },
    "without a plant": NO_PLANT,
    "no inverse of Q": {**NO_PLANT, "process__Q": [[1e-3, 0.0], [0.0, 1e-3]], "eavesdroppers": EVE},
    "a plant of its own": {**NO_PLANT, "plant": {"noise": FORCE}},
    "many slots": {"slots": 3000},
}


@pytest.mark.parametrize("case", RIGHT)
def test_what_is_right_is_not_refused(case: str) -> None:
    """Neither the eavesdroppers nor the filter."""
    assert checked(changed(MEASURED, **RIGHT[case]), "file")


def test_a_filter_may_begin_settled() -> None:
    """`initial_covariance = "filter"` is the covariance before a measurement in the steady state, and Q its innovations' own."""
    scenario = checked(changed(MEASURED), "file")
    process, plant = scenario.process.process, scenario.driven
    assert plant is not None
    assert plant.output_matrix is not None
    assert plant.measurement_noise is not None
    A, C, P = process.A, plant.output_matrix, process.initial_covariance
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + plant.measurement_noise)
    after = P - gain @ C @ P
    assert np.allclose(A @ after @ A.T + plant.noise, P, rtol=1e-12)
    assert np.allclose(gain @ (C @ P @ C.T + plant.measurement_noise) @ gain.T, process.Q, rtol=1e-12)
    assert process.singular_noise
    begun = settled(process, plant)
    assert np.allclose(begun.gain, gain, rtol=1e-12)
    assert np.array_equal(begun.innovation, process.Q)

"""The covariance of noise packets in a scenario: given, that of the states, or that of the sensor's filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import EavesdropperPart
from evedrop.model.local_filter import settled
from evedrop.model.schedule import PACKETS, NoiseDistribution
from evedrop.scenario.loading import checked, load
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from tests.builders import mistakes_of, part_of

_TASK = RecorderTask(Path("nowhere"), False)


def noise_tables(**entries: Any) -> dict[str, Any]:
    """The tables of `noise-before`; entries replace or add."""
    tables = {**load("noise-before").model_dump(mode="json", exclude_none=True), "expect": [], "slots": 20}
    return {**tables, **entries}


def test_filter_is_the_covariance_of_its_error() -> None:
    """In the limit, in a scenario that says Q = "filter" and in one that has a matrix; it is written as a matrix."""
    scenario = load("noise-before")
    driven = scenario.driven
    assert driven is not None
    step = settled(scenario.process.process, driven)
    covariance = scenario.encoding.parameters["noise_covariance"]
    np.testing.assert_allclose(covariance, step.covariance, rtol=1e-9)
    assert float(np.trace(covariance)) == pytest.approx(0.0109457, rel=1e-5)
    np.testing.assert_allclose(scenario.process.Q, step.innovation, rtol=1e-9)
    encoding = {**scenario.encoding.spec, "noise_covariance": "filter"}
    again = checked(noise_tables(encoding=encoding), "again")
    np.testing.assert_allclose(again.encoding.parameters["noise_covariance"], covariance, rtol=1e-12)
    assert Scenario.model_validate(again.model_dump(mode="json")) == again


def test_a_covariance_that_does_not_fit_is_refused() -> None:
    """A sensor without a filter, other dimensions, and a filter with a mistake of its own, which alone is reported."""
    encoding = {"scheme": "noise", "state_probability": 0.5, "noise_covariance": "filter"}
    bare = noise_tables(encoding=encoding)
    del bare["plant"]
    (mistake,) = mistakes_of(checked, bare, "file")
    assert mistake.startswith(
        'encoding.noise_covariance: is "filter", but the sensor has no filter; expected output_matrix and'
    )
    small = noise_tables(encoding={**encoding, "noise_covariance": [[0.1]]})
    assert mistakes_of(checked, small, "file") == ["encoding.noise_covariance: is 1 × 1; expected 2 × 2, as A is"]
    torn = noise_tables(encoding=encoding)
    torn["plant"]["measurement_noise"] = [[0.01]]
    assert [line.partition(":")[0] for line in mistakes_of(checked, torn, "file")] == ["plant.measurement_noise"]


def test_an_eavesdropper_knows_the_distribution_of_the_noise_and_no_more() -> None:
    """Its brief has the covariance, which is public, and no key; a scheme without noise packets leaves the entry out."""
    for name, distribution in (("noise-before", "matrix"), ("noise", PACKETS), ("bayesian", None)):
        scenario = load(name)
        brief = briefs_of(scenario, endpoints_at("tcp/127.0.0.1:1"), _TASK)["bayesian"]
        part = part_of(brief, EavesdropperPart)
        assert brief.keys == {}
        if distribution is None:
            assert part.noise_distribution is None
            assert "noise_covariance" not in brief.text
        else:
            given = scenario.encoding.parameters["noise_covariance"]
            assert part.noise_distribution == NoiseDistribution(given)


def test_theory_covers_those_that_take_noise_behind_independent_losses() -> None:
    """It has a limit; with bursts it has none, and receivers that can tell the types of packets are bounded by smart."""
    link = {"quality": 0.8}
    bursts = {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.4}}
    eavesdroppers = {
        "naive": {"strategy": "naive", "link": link},
        "bursts": {"strategy": "naive", "link": bursts},
        "power": {"strategy": "power-test", "link": link},
        "smart": {"strategy": "smart", "link": link},
    }
    expectations = expectations_of(checked(noise_tables(eavesdroppers=eavesdroppers), "file"))
    assert expectations["naive"].known
    assert not expectations["naive"].infinite_variance
    assert expectations["naive"].limit == pytest.approx(0.0270464, rel=1e-5)  # by the published recursion, minus tr P̄
    assert expectations["naive"].traces(20)[-1] == pytest.approx(expectations["naive"].limit, rel=1e-3)
    assert not expectations["bursts"].known
    bound = expectations["power"].bound
    assert bound is not None
    assert np.array_equal(bound.traces(20), expectations["smart"].traces(20))

"""The day that is kept: that it is the one its provenance tells of, that it can be made again, and that it is a house's."""

from __future__ import annotations

import gzip
import json
import warnings
from dataclasses import asdict
from hashlib import sha256
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from evedrop.scenario.recordings.disturbance_file import read_disturbances
from evedrop.studies.applications.microgrid import day
from evedrop.studies.applications.microgrid.day import Draws

KEPT = Path(str(resources.files("evedrop.scenarios")))
TOLD = json.loads((KEPT / f"{day.NAME}.json").read_text(encoding="utf-8"))


def read(folder: Path) -> np.ndarray:
    """The day in a folder, (2, 86 400)."""
    rows = read_disturbances(folder / f"{day.NAME}.csv.gz", ("P_solar", "P_load"), ("kW", "kW"), 86_400)
    return np.array(rows).T


def kept() -> tuple[np.ndarray, np.ndarray]:
    """P_solar and P_load of the day that is kept."""
    solar, load = read(KEPT)
    return solar, load


def test_the_day_is_the_one_that_is_told_of() -> None:
    """Checksum, recipe and energies of the provenance are those of the file and of the code."""
    text = gzip.decompress((KEPT / f"{day.NAME}.csv.gz").read_bytes())
    assert TOLD["sha256"] == sha256(text).hexdigest()
    assert TOLD["recipe"] == json.loads(json.dumps(asdict(day.Recipe())))
    solar, load = kept()
    assert np.isclose(solar.sum() / 3600.0, TOLD["solar_energy"], atol=1e-3)
    assert np.isclose(load.sum() / 3600.0, TOLD["load_energy"], atol=1e-3)


def test_the_day_can_be_made_again(tmp_path: Path) -> None:
    """To a watt, which is what it is rounded to: other versions of the libraries may differ in the last digits."""
    pytest.importorskip("pvlib", reason="the generator of the day needs the extra `data`")
    pytest.importorskip("demandlib", reason="the generator of the day needs the extra `data`")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations between pvlib and pandas are not ours
        day.write(tmp_path, day.Recipe())
    made = read(tmp_path)
    assert np.abs(made - kept()).max() <= 0.0011
    again = json.loads((tmp_path / f"{day.NAME}.json").read_text(encoding="utf-8"))
    if again["versions"] == TOLD["versions"]:
        assert again == TOLD


def test_the_load_is_a_houses() -> None:
    """Quiet at night but for the refrigerator; over the day it goes above a kilowatt some dozens of times, never for hours."""
    _, load = kept()
    assert 0.05 < load.min() < 0.2
    assert 2.0 < load.max() < 7.0
    night = load[: 4 * 3600]
    assert night.max() < 1.0
    assert 10 <= np.sum(np.diff(night) > 0.3) + np.sum(np.diff(night) < -0.05) <= 60
    high = load > 1.0
    assert 0.02 < high.mean() < 0.2
    minutes = load.reshape(1440, 60).mean(axis=1) > 1.0
    starts = np.sum(np.diff(minutes.astype(int)) == 1)
    assert 10 <= starts <= 60


def test_the_sun_is_a_days_with_clouds() -> None:
    """Dark at night, high at noon, never above the panels' peak by much, with drops by clouds of more than one depth."""
    solar, _ = kept()
    assert solar[: 5 * 3600].max() == solar[23 * 3600 :].max() == 0.0
    assert 3.0 < solar.max() < 4.2
    around_noon = solar[12 * 3600 : 16 * 3600]
    top = np.quantile(around_noon, 0.95)
    depths = around_noon[around_noon < 0.9 * top] / top
    assert len(depths) > 600
    assert depths.min() < 0.5
    assert depths.max() > 0.75


def test_clouds_leave_a_fraction() -> None:
    """Of a clear sky's power, between their depth and all of it, but for the flicker; the same for a seed."""
    fraction = day.fraction_left(day.Clouds(), Draws(11, "clouds"))
    assert fraction.shape == (86_400,)
    assert 0.2 < fraction.min() < 0.6
    assert 1.0 < fraction.max() < 1.2
    assert np.array_equal(fraction, day.fraction_left(day.Clouds(), Draws(11, "clouds")))


def test_appliances_follow_the_profile() -> None:
    """Nobody puts the kettle on when the profile is at its least; energy is that of the appliances, not of the profile."""
    profile = np.full(86_400, 0.1)
    profile[18 * 3600 : 20 * 3600] = 1.0
    days = np.mean([day.load_power(profile, seed) for seed in range(12)], axis=0)
    assert days[: 18 * 3600].max() < 0.5
    assert days[18 * 3600 : 20 * 3600].mean() > 5 * days[: 18 * 3600].mean()
    doubled = day.load_power(2.0 * profile, 3)
    assert np.array_equal(doubled, day.load_power(profile, 3))


def test_draws_are_in_order() -> None:
    """Numbers of a stream do not depend on how many are asked for at once; waiting times have their mean."""
    first, two = Draws(5, "a"), Draws(5, "a")
    assert np.array_equal(first.uniforms(7), [two.uniform() for _ in range(7)])
    times = Draws(5, "b").times(np.full(100_000, 0.01))
    assert abs(len(times) - 1000) < 4 * 1000**0.5
    assert times == sorted(times)

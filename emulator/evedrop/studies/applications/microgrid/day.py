"""The day that the microgrid's scenarios use: made by this module, stored in the repository with its provenance.

`python -m evedrop.studies.applications.microgrid.day FOLDER` makes it again; this needs the extra `data` (pvlib, demandlib).
A run does not.

The load of the house comes from its appliances: when they are switched on, and the power that each draws. The standard load
profile says when people use appliances: demandlib gives the household profile of the German energy association (BDEW). An
appliance is switched on as often as its entry says, more likely where the profile is high. The powers are our own, of the order
of those on name plates.

The power of the roof's solar panels comes from the clear sky over a real place, with simulated clouds: pvlib gives sun,
irradiance and cell temperature. The clouds alternate between clear and cloudy spells; each cloudy spell has a depth of its own,
edges that take some seconds to cross the panels, and a flicker.

Source: docs/microgrid.md, the day; docs/mathematics/numerics.md, random numbers.
"""

from __future__ import annotations

import argparse
import gzip
import json
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, final

import numpy as np

from evedrop.model.kernels.elementary import log
from evedrop.model.process import Floats
from evedrop.model.streams import Stream, normals, root_of_seed, stream_key, uniforms


@final
class Draws:
    """The numbers of one stream, in order."""

    def __init__(self, seed: int, name: str) -> None:
        self._stream = Stream(stream_key(root_of_seed(seed), name), range(1), 1)
        self._next = 0

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """A number between low and high."""
        return float(low + (high - low) * self.uniforms(1)[0])

    def uniforms(self, count: int) -> Floats:
        """Numbers in [0, 1), (count,)."""
        return uniforms(self._stream.words(self._ahead(count)))[:, 0, 0]

    def normals(self, count: int) -> Floats:
        """Standard normals, (count,)."""
        return normals(self._stream.words(self._ahead(count)))[:, 0, 0]

    def exponential(self, mean: float) -> float:
        """An exponentially distributed time."""
        return float(-mean * log(1.0 - self.uniforms(1))[0])

    def times(self, rate: Floats) -> list[int]:
        """Places of a Poisson process, in order: `rate` is the expected number at each, (places,)."""
        total = np.cumsum(rate)
        times, reached = [], self.exponential(1.0)
        while reached < total[-1]:
            times.append(int(np.searchsorted(total, reached, side="right")))
            reached += self.exponential(1.0)
        return times

    def _ahead(self, count: int) -> range:
        self._next += count
        return range(self._next - count, self._next)


SECONDS = 86_400
STANDBY = 0.07
"""kW that the house draws when everybody is asleep."""


@dataclass(frozen=True)
class Appliance:
    """An appliance that is switched on for a while.

    `cycle` and `duty`: a thermostat switches the heater of an oven or a hob on for `duty` of every `cycle` seconds.
    """

    name: str
    power: float
    """kW while it draws."""
    seconds: float
    """How long it stays on, on average."""
    times: float
    """How often a day it is switched on, on average."""
    cycle: int = 1
    duty: float = 1.0
    programme: tuple[tuple[float, float], ...] = ()
    """Instead of power and seconds: (kW, seconds) of each phase."""


APPLIANCES = (
    Appliance("kettle", 2.0, 150, 6),
    Appliance("microwave oven", 1.2, 180, 3),
    Appliance("hob", 1.8, 1200, 2.5, cycle=45, duty=0.55),
    Appliance("oven", 2.2, 2100, 0.8, cycle=60, duty=0.5),
    Appliance("hair dryer", 1.6, 300, 1),
    Appliance("vacuum cleaner", 0.9, 900, 0.6),
    Appliance("lamp", 0.04, 5400, 16),
    Appliance("television or computer", 0.15, 7200, 5),
    Appliance("washing machine", 0, 0, 0.8, programme=((2.0, 900), (0.15, 1500), (0.35, 300), (0.15, 900), (0.5, 420))),
    Appliance("dishwasher", 0, 0, 0.8, programme=((0.1, 300), (1.9, 840), (0.1, 1500), (1.9, 660), (0.05, 900))),
)


def household_profile(date: str, yearly: float) -> Floats:
    """Mean power in kW of every second of a day by the BDEW profile H25, for kWh a year, (86 400,). Needs demandlib."""
    import pandas as pd  # noqa: PLC0415 - of an extra that only this function needs
    from demandlib import bdew  # noqa: PLC0415 - the same

    quarters = pd.date_range(f"{date[:4]}-01-01", f"{date[:4]}-12-31 23:45", freq="15min")
    profile = bdew.H25(timeindex=quarters)
    mean = (profile / profile.sum() * yearly * 4.0).loc[date].to_numpy()
    every_second: Floats = np.interp(np.arange(SECONDS), 900.0 * np.arange(96) + 450.0, mean, period=SECONDS)
    return every_second


def load_power(profile: Floats, seed: int) -> Floats:
    """Load in kW of every second of a day, (86 400,), of a house whose people follow the profile, in any unit."""
    draws = Draws(seed, "appliances")
    load = STANDBY + refrigerator(draws)
    active = profile - profile.min()  # nobody uses appliances at the profile's minimum, at night
    weight = active / active.sum()
    for appliance in APPLIANCES:
        for start in draws.times(appliance.times * weight):
            drawn = _drawn(appliance, draws)[: SECONDS - start]
            load[start : start + len(drawn)] += drawn
    return load


def refrigerator(draws: Draws) -> Floats:
    """A compressor's power in kW: about 15 minutes of every 45, with a peak at each start, (86 400,)."""
    power = np.zeros(SECONDS)
    k = -draws.uniform(0.0, 2700.0)
    while k < SECONDS:
        on, off = 900.0 * draws.uniform(0.8, 1.2), 1800.0 * draws.uniform(0.8, 1.2)
        power[max(0, int(k)) : max(0, int(k + on))] = 0.085
        power[max(0, int(k)) : max(0, int(k) + 2)] = 0.4
        k += on + off
    return power


def _drawn(appliance: Appliance, draws: Draws) -> Floats:
    """The power it draws, second by second, from the moment it is switched on."""
    level = draws.uniform(0.85, 1.1)
    if appliance.programme:
        parts = [np.full(int(seconds * draws.uniform(0.9, 1.1)), level * kw) for kw, seconds in appliance.programme]
        return np.concatenate(parts)
    seconds = np.arange(max(20, int(draws.exponential(appliance.seconds))))
    on = seconds % appliance.cycle < appliance.duty * appliance.cycle
    drawn: Floats = np.where(on, level * appliance.power, 0.0)
    return drawn


@dataclass(frozen=True)
class Roof:
    """Location and orientation of the panels. Angles in degrees, altitude in metres, peak power in kW."""

    latitude: float = 37.4
    longitude: float = -6.0
    altitude: float = 10.0
    time_zone: str = "Europe/Madrid"
    tilt: float = 30.0
    azimuth: float = 180.0
    peak_power: float = 4.0
    inverter_efficiency: float = 0.96
    temperature_coefficient: float = -0.004
    """The change of power per kelvin of the cells' temperature."""


@dataclass(frozen=True)
class Clouds:
    """Spells in seconds, means of exponential times; depth is the remaining fraction of the clear sky's power."""

    clear: float = 900.0
    cloudy: float = 240.0
    shortest: float = 20.0
    least: float = 0.25
    most: float = 0.8
    edge: float = 15.0
    flicker: float = 0.01
    flicker_time: float = 60.0


def clear_sky(roof: Roof, date: str) -> Floats:
    """Power in kW of every second of a day without clouds, (86 400,). Needs pvlib, of the extra `data`."""
    import pandas as pd  # noqa: PLC0415 - of an extra that only this function needs
    import pvlib  # noqa: PLC0415 - the same

    place = pvlib.location.Location(roof.latitude, roof.longitude, roof.time_zone, roof.altitude)
    minutes = pd.date_range(date, periods=1441, freq="60s", tz=roof.time_zone)
    sun = place.get_solarposition(minutes)
    sky = place.get_clearsky(minutes, model="simplified_solis", solar_position=sun)
    plane = pvlib.irradiance.get_total_irradiance(
        roof.tilt, roof.azimuth, sun["apparent_zenith"], sun["azimuth"], sky["dni"], sky["ghi"], sky["dhi"]
    )["poa_global"].fillna(0.0)
    cells = pvlib.temperature.pvsyst_cell(plane, 22.0, 2.0)
    direct = pvlib.pvsystem.pvwatts_dc(plane, cells, roof.peak_power, roof.temperature_coefficient)
    power: Floats = np.clip(direct.to_numpy() * roof.inverter_efficiency, 0.0, None)
    every_second: Floats = np.interp(np.arange(SECONDS), 60.0 * np.arange(len(minutes)), power)
    return every_second


def fraction_left(clouds: Clouds, draws: Draws) -> Floats:
    """Fraction of the clear sky's power that clouds leave, every second, (86 400,): at least 0."""
    spells = np.ones(SECONDS)
    k = 0.0
    while k < SECONDS:
        k += draws.exponential(clouds.clear)
        length = draws.exponential(clouds.cloudy) + clouds.shortest
        spells[int(k) : int(k + length)] = draws.uniform(clouds.least, clouds.most)
        k += length
    forget = 1.0 / clouds.edge
    steady = np.sqrt(2.0 / clouds.flicker_time) * clouds.flicker * draws.normals(SECONDS)
    fraction = np.empty(SECONDS)
    edge, flicker = 1.0, 0.0
    for k, (target, kick) in enumerate(zip(spells.tolist(), steady.tolist(), strict=True)):
        edge += forget * (target - edge)
        flicker += kick - flicker / clouds.flicker_time
        fraction[k] = edge + flicker
    return np.clip(fraction, 0.0, None)


def solar_power(roof: Roof, clouds: Clouds, date: str, seed: int) -> Floats:
    """Power in kW of every second of a day, (86 400,). Needs pvlib, of the extra `data`."""
    return clear_sky(roof, date) * fraction_left(clouds, Draws(seed, "clouds"))


NAME = "microgrid-day"
_LIBRARIES = ("pvlib", "demandlib", "pandas", "numpy")


@dataclass(frozen=True)
class Recipe:
    """Everything that a day depends on, except the versions of the libraries."""

    date: str = "2024-05-15"
    seed: int = 4
    yearly_load: float = 3600.0
    """kWh a year, for the profile. The profile decides when appliances run, and not the power they draw."""
    roof: Roof = field(default_factory=Roof)
    clouds: Clouds = field(default_factory=Clouds)


def make(recipe: Recipe) -> Floats:
    """P_solar and P_load in kW of every second of the day, (2, 86 400). Needs pvlib and demandlib, of the extra `data`."""
    solar = solar_power(recipe.roof, recipe.clouds, recipe.date, recipe.seed)
    return np.stack([solar, load_power(household_profile(recipe.date, recipe.yearly_load), recipe.seed)])


def as_csv(powers: Floats) -> str:
    """The day as a table of seconds and kW, rounded to a watt; powers: (2, slots)."""
    rows = (f"{k},{solar:.3f},{load:.3f}" for k, (solar, load) in enumerate(powers.T.tolist()))
    return "\n".join(["time [s],P_solar [kW],P_load [kW]", *rows, ""])


def provenance(recipe: Recipe, text: str) -> dict[str, Any]:
    """The origin of a day: recipe, versions, checksum of the uncompressed table, and energies in kWh."""
    _, solar, load = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1, unpack=True)
    return {
        "made_by": "python -m evedrop.studies.applications.microgrid.day",
        "recipe": asdict(recipe),
        "versions": {name: version(name) for name in _LIBRARIES},
        "sha256": sha256(text.encode()).hexdigest(),
        "solar_energy": round(float(solar.sum()) / 3600.0, 3),
        "load_energy": round(float(load.sum()) / 3600.0, 3),
    }


def write(folder: Path, recipe: Recipe) -> None:
    """Write NAME.csv.gz and NAME.json into a folder."""
    text = as_csv(make(recipe))
    (folder / f"{NAME}.csv.gz").write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    told = json.dumps(provenance(recipe, text), indent=2) + "\n"
    (folder / f"{NAME}.json").write_text(told, encoding="utf-8")


if __name__ == "__main__":
    words = argparse.ArgumentParser(description="Make the day of the microgrid's scenarios again.")
    words.add_argument("folder", type=Path)
    words.add_argument("--date", default=Recipe.date)
    words.add_argument("--seed", type=int, default=Recipe.seed)
    asked = words.parse_args()
    write(asked.folder, Recipe(asked.date, asked.seed))

"""The power of a roof's solar panels over a day: the clear sky over a real place, with simulated clouds.

pvlib gives sun, irradiance and cell temperature. The clouds alternate between clear and cloudy spells; each cloudy spell has a
depth of its own, edges that take some seconds to cross the panels, and a flicker.
Source: docs/microgrid.md, the day.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evedrop.model.process import Floats
from evedrop.studies.applications.microgrid.appliances import SECONDS
from evedrop.studies.applications.microgrid.draws import Draws


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

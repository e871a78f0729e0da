"""The load of a house over a day, from its appliances: when they are switched on, and the power that each draws.

The standard load profile says when people use appliances: demandlib gives the household profile of the German energy
association (BDEW). An appliance is switched on as often as its entry says, more likely where the profile is high. The
powers are our own, of the order of those on name plates.
Source: docs/microgrid.md, the day.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evedrop.model.process import Floats
from evedrop.studies.applications.microgrid.draws import Draws

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

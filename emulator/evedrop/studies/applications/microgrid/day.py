"""The day that the microgrid's scenarios use: made by this module, stored in the repository with its provenance.

`python -m evedrop.studies.applications.microgrid.day FOLDER` makes it again; this needs the extra `data` (pvlib, demandlib).
A run does not.
Source: docs/microgrid.md, the day.
"""

from __future__ import annotations

import argparse
import gzip
import json
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from evedrop.model.process import Floats
from evedrop.studies.applications.microgrid.appliances import household_profile, load_power
from evedrop.studies.applications.microgrid.sun import Clouds, Roof, solar_power

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

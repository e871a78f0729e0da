"""Disturbances from a file: what is read, and the messages about a file that cannot be read."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pytest

from evedrop.errors import DisturbanceError
from evedrop.scenario.recordings import disturbance_file as plant_data
from evedrop.scenario.recordings.disturbance_file import read_disturbances, recorded_states, table_text
from tests.builders import mistakes_of
from tests.golden.pages import Golden

NAMES = ("P_solar", "P_load")
UNITS = ("kW", "kW")
GOOD = "time [s], P_solar [kW], P_load [kW]\n0,0.5,0.2\n1,0.6,0.2\n2,0.7,1.25\n"


def write(folder: Path, text: str, name: str = "day.csv") -> Path:
    """A file in a folder."""
    path = folder / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


def read(path: Path, slots: int = 3, slot_seconds: float = 1.0) -> object:
    """What is read of a file."""
    return read_disturbances(path, NAMES, UNITS, slots, slot_seconds)


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        GOOD.replace("\n", "\r\n") + "\n\n",
        "\ufeff" + GOOD,
        "time [s],P_load [W],who,P_solar [kW]\n0,200,a,.5\n1,200,b,6e-1\n2,1250,,0.7\n3,0,,0\n",
    ],
)
@pytest.mark.parametrize("name", ["day.csv", "day.csv.gz"])
def test_a_day_is_read(tmp_path: Path, text: str, name: str) -> None:
    """Watts and kilowatts, columns in any order and more than are asked for, more lines than slots, compressed or not."""
    values = np.array(read_disturbances(write(tmp_path, text, name), NAMES, UNITS, 3))
    assert np.allclose(values[:3], [[0.5, 0.2], [0.6, 0.2], [0.7, 1.25]], rtol=1e-15)


def test_slots_may_last_longer(tmp_path: Path) -> None:
    """Times advance by the length of a slot, which need not be a binary fraction."""
    rows = "".join(f"{0.1 * k:.1f},1,2\n" for k in range(1000))
    path = write(tmp_path, f"time [s],P_solar [kW],P_load [kW]\n{rows}")
    assert len(read_disturbances(path, NAMES, UNITS, 1000, 0.1)) == 1000
    assert "expected 60 s, for slots of 60 s" in mistakes_of(read, path, 10, 60.0)[0]


def test_a_number_that_is_too_large_in_the_unit_of_the_plant_is_said(tmp_path: Path) -> None:
    """Its line is not left out, which would move all later ones forward by a slot."""
    path = write(tmp_path, "P_solar [kW]\n1\n1e308\n2\n3\n")
    with pytest.raises(DisturbanceError, match='line 3: P_solar is "1e308"; expected a finite number'):
        read_disturbances(path, ["P_solar"], ["W"], 3)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("", "is"),
        ("time [s],P_solar [kW],P_load [kW]\n", "has"),
        (GOOD.replace("[kW], P_l", "[A], P_l"), "line 1"),
        (GOOD.replace("P_load [kW]", "P_load"), "line 1"),
        (GOOD.replace("time [s]", "time [h]"), "line 1"),
        (GOOD.replace("P_load", "load"), "line 1"),
        (GOOD.replace("P_solar [kW], P_load", "P_load [kW], P_load"), "line 1"),
        (GOOD.replace("1,0.6,0.2", "1,0.6"), "line 3"),
        (GOOD.replace("1,0.6,0.2", "1,sun,0.2"), "line 3"),
        (GOOD.replace("1,0.6,0.2", "1,,0.2"), "line 3"),
        (GOOD.replace("1,0.6,0.2", "1,nan,0.2"), "line 3"),
        (GOOD.replace("1,0.6,0.2\n", ""), "line 3"),
        (GOOD.replace("2,0.7", "2.05,0.7"), "line 4"),
        (GOOD.replace("2,0.7", "1,0.7"), "line 4"),
        (GOOD.replace("0,0.5,0.2\n", ""), "line 2"),
        (GOOD.replace("2,0.7,1.25\n", ""), "has"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_day_is_said(tmp_path: Path, text: str, place: str, golden: Golden) -> None:
    """With the line, what was found there, and what was expected."""
    mistakes = mistakes_of(read, write(tmp_path, text))
    assert any(re.match(rf"{place}\b", line) for line in mistakes)
    golden("check", mistakes)


def test_all_that_is_wrong_is_said_at_once(tmp_path: Path) -> None:
    """Every column that is wrong, and the first lines that are with the number of them all."""
    header = mistakes_of(read, write(tmp_path, "time [h],P_solar [A],P_load\n0,1,2\n"))
    assert [line.split(";")[0] for line in header] == [
        'line 1: the column "time" is in [h]',
        'line 1: the column "P_solar" is in [A]',
        'line 1: the column "P_load" has no unit',
    ]
    rows = "".join(f"{k},x,{'y' if k == 1 else 1}\n" for k in range(20))
    mistakes = mistakes_of(read, write(tmp_path, f"time [s],P_solar [kW],P_load [kW]\n{rows}"), 20)
    assert mistakes[1:3] == [
        'line 3: P_solar is "x"; expected a finite number',
        'line 3: P_load is "y"; expected a finite number',
    ]
    assert mistakes[-1] == "and more such mistakes, in 20 of 20 lines"
    assert len(mistakes) == plant_data.MOST_REPORTED + 1


@pytest.mark.parametrize(
    ("name", "content"), [("day.csv", None), ("day.csv.gz", b"no gzip"), ("day.csv", b"\xff\xfe1"), ("day.csv.gz", b"")]
)
def test_what_is_no_file_is_said(tmp_path: Path, name: str, content: bytes | None) -> None:
    """It is not there, not compressed as its name says, or no text."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    (line,) = mistakes_of(read, tmp_path / name)
    assert line.startswith(("cannot be read (", "is empty"))
    assert "expected a" in line


def test_without_units_in_the_scenario_none_are_asked_for(tmp_path: Path) -> None:
    """Numbers are taken as they are, with or without a unit after the name; lines that begin with # are skipped."""
    path = write(tmp_path, "# measured\nP_load [W], P_solar\n7, 8\n# a pause\n9, 10\n")
    assert read_disturbances(path, NAMES) == [[8.0, 7.0], [10.0, 9.0]]


def test_units_of_any_kind_must_be_the_scenarios(tmp_path: Path) -> None:
    """Powers may be changed from one to the other, anything else must be what is asked for."""
    path = write(tmp_path, "wind [m/s], P [kW]\n3, 2\n")
    assert read_disturbances(path, ("wind", "P"), ("m/s", "W")) == [[3.0, 2000.0]]
    with pytest.raises(DisturbanceError, match=r'the column "wind" is in \[m/s\]; expected wind \[kn\]$'):
        read_disturbances(path, ("wind", "P"), ("kn", "kW"))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    """To the same bits, with units and without."""
    rows = [[0.1, 1 / 3], [1e-300, -0.0]]
    for units in (None, UNITS):
        path = write(tmp_path, table_text(NAMES, units, rows))
        assert read_disturbances(path, NAMES, units) == rows


def test_states_without_a_line_of_names_are_refused(tmp_path: Path) -> None:
    """The first states would be taken for names."""
    (tmp_path / "pose.csv").write_text("0.1,0.2\n0.3,0.4\n")
    with pytest.raises(DisturbanceError, match="line 1 has only numbers; expected a line of names first"):
        recorded_states(tmp_path / "pose.csv")

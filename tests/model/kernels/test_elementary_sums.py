"""No metric depends on the version of Python: `sum` compensates their rounding since 3.12."""

from __future__ import annotations

import builtins
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import pytest

from evedrop import montecarlo
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import load
from evedrop.scenarios import shipped
from evedrop.wire.deliveries import KeyDeliveries, bounds
from tests.examples import mostly_long

PLAIN = builtins.sum
SHADOWED = {"receiver": [120.0, 0.0], "sender": [0.0, 0.0], "reference_snr": 72.0, "exponent": 3.0, "threshold": 10.0}


def checked(numbers: Iterable[Any], start: Any = 0) -> Any:
    """In the place of `sum`. Raises AssertionError where the package adds more than two floats, which may be rounded twice."""
    every = list(numbers)
    caller = sys._getframe(1).f_globals.get("__name__", "")
    floats = PLAIN(type(number) is float for number in every)
    assert not caller.startswith("evedrop.") or floats <= 2, (
        f"{caller} adds {floats} floats with sum(); use sum_in_order()"
    )
    return PLAIN(every, start)


@pytest.fixture
def sums(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Sums of floats are refused."""
    monkeypatch.setattr(builtins, "sum", checked)
    yield
    monkeypatch.undo()


def test_numbers_are_added_in_order() -> None:
    """As + adds them: ten tenths are less than 1, with every Python."""
    tenths = [0.1] * 10
    assert sum_in_order(tenths) == float(np.cumsum(tenths)[-1]) < 1.0
    assert sum_in_order([1e308, 1e308]) == np.inf
    assert sum_in_order([]) == 0.0


@pytest.mark.usefixtures("sums")
@pytest.mark.parametrize(
    "name", mostly_long(sorted(shipped()), ["eavesdroppers", "heated-room", "microgrid", "nemesis"])
)
def test_no_metric_of_a_study_is_a_compensated_sum(name: str, tmp_path: Path) -> None:
    """Warnings, trials, theory and summary of every built-in scenario, cut to a few slots."""
    scenario = load(name)
    timed = scenario.event or scenario.nemesis is not None
    changes: dict[str, Any] = {"expect": []} if timed else {"slots": min(60, scenario.slots), "expect": []}
    warnings_of(load(name, changes))
    assert montecarlo(name, trials=2, workers=1, out=tmp_path / "out", **changes).trials


@pytest.mark.usefixtures("sums")
@pytest.mark.parametrize("loss", [{"model": "gilbert-elliott", "p": 0.1, "r": 0.3}, {"model": "distance", **SHADOWED}])
def test_no_metric_of_a_wire_is_a_compensated_sum(loss: dict[str, Any]) -> None:
    """The expected deliveries of a link that counted many pieces."""
    ranges = [range(start, start + 40) for start in range(0, 4000, 100)]
    stream = KeyDeliveries({"loss": loss, "corrupt": 0.1}, (), ranges)
    assert 0.0 < stream.mean < 1600.0
    assert stream.variance > 0.0
    assert bounds([stream], 1600) is not None


def test_a_sum_of_floats_is_noticed(sums: None) -> None:
    """The stand-in for `sum` refuses three floats of the package's, and adds all others."""
    del sums
    package = {"sum": builtins.sum, "__name__": "evedrop.model.somewhere"}
    add = FunctionType((lambda numbers: 0 + sum(numbers)).__code__, package)
    assert add([1, 2, 3]) == 6
    with pytest.raises(AssertionError, match=r"evedrop\.model\.somewhere adds 3 floats"):
        add([0.1] * 3)

from pathlib import Path

import numpy as np

from evedrop import montecarlo
from evedrop.model.process import Floats
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.show.view.telling_slot import most_telling, telling_slot


def errors_of(slots: int, **far: tuple[int, float]) -> dict[str, Floats]:
    """Receiver → its errors: 1 for eavesdroppers and 0 for the legitimate estimator, but in one slot."""
    errors = {"legitimate": np.zeros(slots)}
    for name, (slot, error) in far.items():
        errors.setdefault(name, np.ones(slots))[slot] = error
    return errors


def reported(errors: dict[str, Floats], **traces: float) -> dict[str, Floats]:
    """Receiver → the trace that it reports, 1 unless told otherwise."""
    return {name: np.full(len(column), traces.get(name, 1.0)) for name, column in errors.items()}


def test_the_slot_in_which_most_are_overconfident_is_chosen() -> None:
    """An eavesdropper that knows how far it may be off does not count, however far it is."""
    errors = errors_of(1000, naive=(400, 50.0), uncertain=(700, 900.0))
    assert most_telling(errors, reported(errors, uncertain=900.0), 0.1) == 400
    assert most_telling(errors, reported(errors), 0.1) == 700


def test_the_slots_before_it_count_first() -> None:
    """They are what the panels show: a single slot, however far the eavesdropper is, is not chosen before a long stretch."""
    errors = errors_of(1000, naive=(700, 1e6))
    errors["naive"][300:400] = 50.0
    errors["naive"][396] = 80.0
    assert most_telling(errors, reported(errors), 0.1) == 396


def test_where_the_legitimate_estimator_errs_as_well_there_is_nothing_to_see() -> None:
    """The separation is a ratio."""
    errors = errors_of(1000, naive=(400, 50.0))
    errors["naive"][600], errors["legitimate"][600] = 500.0, 500.0
    assert most_telling(errors, reported(errors), 0.1) == 400


def test_without_an_overconfident_eavesdropper_all_count() -> None:
    """If no eavesdropper is ever overconfident, uncertain ones count."""
    errors = errors_of(1000, uncertain=(700, 900.0))
    assert most_telling(errors, reported(errors, uncertain=900.0), 0.1) == 700


def test_without_an_eavesdropper_the_legitimate_estimator_counts() -> None:
    """The slot of its largest error is chosen."""
    errors = errors_of(1000, legitimate=(300, 2.0))
    assert most_telling(errors, reported(errors), 0.1) == 300


def test_the_slots_around_it_fill_the_panels() -> None:
    """Neither the beginning nor the end is chosen; of a short run, the last of the slots that show as much."""
    errors = errors_of(1000, naive=(20, 1e6), other=(990, 1e6))
    errors["naive"][500] = 100.0
    assert most_telling(errors, reported(errors), 0.1) == 500
    for slots in (1, 60, 105):
        errors = errors_of(slots, naive=(0, 5.0))
        assert most_telling(errors, reported(errors), 0.1) == slots - 1


def test_of_a_short_run_a_slot_in_which_every_eavesdropper_has_just_heard_the_state_is_not_chosen() -> None:
    """Such as the last two of `numerical`: no receiver is off there, and the picture would show nothing."""
    errors = errors_of(80, naive=(0, 5.0))
    errors["naive"][:78] = 50.0
    errors["naive"][77] = 80.0
    errors["naive"][78:] = 0.0
    assert most_telling(errors, reported(errors), 0.1) == 77


def test_the_first_recorded_trial_decides(tmp_path: Path) -> None:
    """It is the one that the view shows; the covariances are those that receivers report."""
    slots = []
    for trials in (1, 3):
        montecarlo("vehicle", slots=400, record_trials=trials, trials=trials, out=tmp_path / str(trials))
        slots.append(telling_slot(Results.read(tmp_path / str(trials))))
    assert slots[0] == slots[1]
    results = Results.read(tmp_path / "3")
    rows = [row for row in results.trials.to_pylist() if row["trial"] == 0]
    errors: dict[str, list[float]] = {}
    traces: dict[str, list[float]] = {}
    for row in sorted(rows, key=lambda row: row["slot"]):
        errors.setdefault(row["peer"], []).append(row["squared_error"])
        traces.setdefault(row["peer"], []).append(np.trace(np.array(row["P"]).reshape(len(row["x"]), -1)))
    noise = float(np.trace(load("vehicle").process.process.Q))
    seen, claimed = ({name: np.array(values) for name, values in by.items()} for by in (errors, traces))
    assert slots[1] == most_telling(seen, claimed, noise)


def test_a_closed_loop_is_shown_to_its_end(tmp_path: Path) -> None:
    """Its panels show the whole run, up to the slot; so there is no slot to choose."""
    montecarlo("heated-room", trials=1, out=tmp_path / "run")
    assert telling_slot(Results.read(tmp_path / "run")) is None

import numpy as np

from evedrop.model.process import Floats
from evedrop.view.telling_slot import most_telling


def errors_of(slots: int, **far: tuple[int, float]) -> dict[str, Floats]:
    """Receiver → its errors: 1 for eavesdroppers and 0 for the legitimate estimator, but in one slot."""
    errors = {"legitimate": np.zeros(slots)}
    for name, (slot, error) in far.items():
        errors.setdefault(name, np.ones(slots))[slot] = error
    return errors


def believed(errors: dict[str, Floats], **traces: float) -> dict[str, Floats]:
    """Receiver → the trace that it believes, 1 unless told otherwise."""
    return {name: np.full(len(column), traces.get(name, 1.0)) for name, column in errors.items()}


def test_the_slot_in_which_most_are_fooled_is_chosen() -> None:
    """An eavesdropper that knows how far it may be off does not count, however far it is."""
    errors = errors_of(1000, naive=(400, 50.0), drifting=(700, 900.0))
    assert most_telling(errors, believed(errors, drifting=900.0), 0.1) == 400
    assert most_telling(errors, believed(errors), 0.1) == 700


def test_where_the_legitimate_estimator_errs_as_well_there_is_nothing_to_see() -> None:
    """The separation is a ratio."""
    errors = errors_of(1000, naive=(400, 50.0))
    errors["naive"][600], errors["legitimate"][600] = 500.0, 500.0
    assert most_telling(errors, believed(errors), 0.1) == 400


def test_without_a_fooled_eavesdropper_all_count() -> None:
    """If no eavesdropper is ever fooled, drifting ones count."""
    errors = errors_of(1000, drifting=(700, 900.0))
    assert most_telling(errors, believed(errors, drifting=900.0), 0.1) == 700


def test_without_an_eavesdropper_the_legitimate_estimator_counts() -> None:
    """The slot of its largest error is chosen."""
    errors = errors_of(1000, legitimate=(300, 2.0))
    assert most_telling(errors, believed(errors), 0.1) == 300


def test_the_slots_around_it_fill_the_panels() -> None:
    """Neither the beginning nor the end is chosen; of a short run, the last slot is."""
    errors = errors_of(1000, naive=(20, 1e6), other=(990, 1e6))
    errors["naive"][500] = 100.0
    assert most_telling(errors, believed(errors), 0.1) == 500
    for slots in (1, 60, 105):
        errors = errors_of(slots, naive=(0, 5.0))
        assert most_telling(errors, believed(errors), 0.1) == slots - 1

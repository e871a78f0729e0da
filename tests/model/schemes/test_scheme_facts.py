"""The facts that a scheme's class declares about its packets. A subclass must declare its own: it does not inherit them."""

from __future__ import annotations

import numpy as np
import pytest

from evedrop.model.process import Process
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.acknowledged import Acknowledged
from evedrop.model.schemes.cipher import Cipher
from evedrop.model.schemes.plain import Plain
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.schemes.twin_track import TwinTrack
from evedrop.model.streams import Batch

PROCESS = Process(np.eye(2), np.eye(2), np.eye(2))


@pytest.mark.parametrize("base", [SCHEMES[name] for name in SCHEMES])
def test_theory_of_packets_is_not_inherited(base: type[Scheme]) -> None:
    """A subclass may send other packets: no bound, closed form or floor is claimed for it unless it claims it itself."""
    other: type[Scheme] = type("Other", (base,), {})
    assert not other.sends_states_and_innovations
    assert other.closed_forms == {}
    assert other.error_floor is Scheme.error_floor
    assert other.revealed_bits is Scheme.revealed_bits
    assert other.lost_reference is Scheme.lost_reference
    assert not other.sends_by_holding_time
    assert not other.meets_energy_budget
    own = {"naive": lambda scheme, conditions: None}  # noqa: ARG005 - it is only compared
    claims = {"sends_states_and_innovations": True, "closed_forms": own}
    again: type[Scheme] = type("Again", (other,), claims)
    assert again.sends_states_and_innovations
    assert again.closed_forms == own


def test_the_built_in_classes_say_what_theory_knows() -> None:
    """The facts are those of docs/mathematics/: packets of states and innovations, closed forms, floors."""
    assert {name for name in SCHEMES if SCHEMES[name].sends_states_and_innovations} == {"innovation", "plain"}
    assert {name for name in SCHEMES if SCHEMES[name].closed_forms} == {
        "acknowledged",
        "encrypted-schedule",
        "noise",
        "open-loop",
        "quantised-schedule",
        "scheduled",
    }
    assert {name for name in SCHEMES if SCHEMES[name].error_floor is not Scheme.error_floor} == {
        "cipher",
        "partial-encryption",
        "twin-track",
    }
    assert [name for name in SCHEMES if SCHEMES[name].sends_by_holding_time] == ["scheduled"]
    assert [name for name in SCHEMES if SCHEMES[name].meets_energy_budget] == ["quantised-schedule"]
    assert "legitimate" in Acknowledged.closed_forms
    assert Plain(PROCESS).error_floor(3) is None
    floor, grows = Cipher(PROCESS).error_floor(3)
    np.testing.assert_array_equal(floor, [2.0, 4.0, 6.0])  # tr Σ_k, Σ_k = Σ_{k−1} + Q
    assert grows


def test_a_scheme_with_its_own_start_is_known_by_its_method() -> None:
    """Also a subclass, and without a word of its author."""
    assert {name for name in SCHEMES if SCHEMES[name].decides_initial_state()} == {"twin-track"}
    other: type[Scheme] = type("Other", (TwinTrack,), {})
    assert other.decides_initial_state()


def test_a_scheme_without_innovations_shares_neither_types_nor_noise() -> None:
    """ν and χ are 0 in every slot and trial; sender and estimator are those of the scheme."""
    shared = Plain(PROCESS).shared({}, Batch(4, 3))
    for k in (0, 3):
        assert shared.nu(k).tolist() == [False] * 3
        assert np.array_equal(shared.chi(k), np.zeros((2, 3)))
    packet = shared.encoder().encode(0, np.ones((2, 3)), np.zeros((2, 3)))
    assert np.array_equal(packet.z, np.ones((2, 3)))
    assert shared.estimator().act(0, np.ones(3, np.bool_)).tolist() == [1, 1, 1]


def test_the_bits_of_packets_and_secrets_are_counted() -> None:
    """64 for each number: of two states, headers, and words of shared secret."""
    bits = {
        name: (scheme.packet_bits, scheme.secret_bits, scheme.initial_secret_bits)
        for name in SCHEMES
        for scheme in [scheme_of(PROCESS, {"scheme": name, **SCHEMES[name].parameters})]
    }
    assert bits == {
        "acknowledged": (192, 0, 0),
        "cipher": (128, 128, 0),
        "encrypted-schedule": (192, 128, 0),
        "innovation": (128, 192, 0),
        "noise": (128, 64, 0),
        "open-loop": (256, 0, 0),
        "partial-encryption": (192, 64, 0),
        "plain": (128, 0, 0),
        "quantised-schedule": (17, 128, 0),  # levels of 8 bits, and one bit that says whether they are encrypted
        "random-code": (256, 0, 0),
        "scheduled": (128, 0, 0),
        "threshold-code": (256, 0, 0),
        "twin-track": (128, 64, 256),
        "withholding": (128, 0, 0),
    }


def test_a_scheme_that_says_nothing_of_eavesdroppers_has_no_closed_form() -> None:
    """Its slots differ, or what the eavesdropper makes of its packets depends on more than their type."""
    names = {
        name
        for name in SCHEMES
        if scheme_of(PROCESS, {"scheme": name, **SCHEMES[name].parameters}).eavesdropper_outcomes(0.5, 1.0, 0.0)
    }
    assert names == {"innovation", "noise", "plain", "withholding"}

"""The energy of packets: what is sent, and what is encrypted."""

from __future__ import annotations

import numpy as np

from evedrop.model.energy import EnergyModel
from evedrop.model.process import Process
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.model.schemes.plain import Plain
from evedrop.model.schemes.scheme import PacketBlock
from evedrop.model.streams import Batch
from evedrop.simulate.chunk import PacketTally
from tests.model.slot_loop import coins, play

PROCESS = Process(np.eye(2), np.eye(2), np.eye(2))


def test_energy_is_linear_in_packets_bits_and_encryptions() -> None:
    """E = (E_p + E_b b) s + E_c f."""
    model = EnergyModel(packet=2.0, bit=0.25, encryption=5.0)
    assert model.sent(Plain(PROCESS)) == 2.0 + 0.25 * 128
    assert model.spent(Plain(PROCESS), 0.5, 0.1) == 0.5 * 34.0 + 0.5
    assert EnergyModel().spent(Plain(PROCESS), 1.0, 1.0) == 2.0


def test_every_scheme_says_which_packets_it_encrypts() -> None:
    """`cipher` all, `partial-encryption` states, the two with a schedule by the holding time, all others none."""
    gamma = coins(0.6, 20, 30)
    for name in SCHEMES:
        scheme = scheme_of(PROCESS, {"scheme": name, **SCHEMES[name].parameters})
        played = play(scheme, Batch(20, 30), {"legitimate": gamma})
        encrypted = scheme.encrypted(PacketBlock.of(played.packets))
        assert encrypted.shape == (20, 30)
        if name == "cipher":
            assert encrypted.all()
        elif name == "encrypted-schedule":
            assert encrypted[0].all()
            assert not encrypted.all()
            assert np.array_equal(encrypted[1:], ~gamma[:-1])  # θ = 2: where the packet before was lost
        elif name == "quantised-schedule":
            assert encrypted[0].all()
            assert encrypted[1:][~gamma[:-1]].all()  # θ = 1.5: there, and where a coin says so
            assert 0.4 < encrypted[1:][gamma[:-1]].mean() < 0.6
        elif name == "partial-encryption":
            assert np.array_equal(encrypted, ~np.array([packet.nu for packet in played.packets]))
        else:
            assert not encrypted.any()


def test_packets_that_are_not_sent_are_not_counted() -> None:
    """Slots add up, also in parts; an encrypted packet that is not sent costs nothing."""
    encrypted = np.array([[True, False, True], [True, True, True]])
    sent = np.array([[True, True, False], [True, False, True]])
    counts = PacketTally.zero(3)
    counts.add_slots(encrypted, sent)
    counts.add_slots(encrypted[:1], None)
    assert counts.sent.tolist() == [3, 2, 2]
    assert counts.encrypted.tolist() == [3, 0, 2]
    whole = PacketTally.merged([counts.part(slice(2, 3)), counts])
    assert whole.sent.tolist() == [2, 3, 2, 2]
    whole.add_counts(whole)
    assert whole.encrypted.tolist() == [4, 6, 0, 4]

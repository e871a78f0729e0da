"""Schemes that break a rule are told which."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evedrop.model.process import Floats
from evedrop.model.receiver import Belief, Flags, Reception
from evedrop.model.schemes.cipher import Cipher, CipherEstimator
from evedrop.model.schemes.innovation import Innovation, SharedSecret
from evedrop.model.schemes.plain import PlainEncoder, PlainEstimator
from evedrop.model.schemes.scheme import Packet, Scheme
from evedrop.model.theory.covariances import Outcomes
from evedrop.scenario.conformance.schemes import SchemeChecks
from tests.scenario.conformance.breaking import broken, plain_with


class Sent(PlainEncoder):
    """Something made of the state."""

    def of(self, k: int, x: Floats) -> Floats:
        """What is sent in slot k."""
        raise NotImplementedError

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet."""
        return Packet(self.of(k, x), np.zeros(x.shape[1], np.bool_))


class Centred(Sent):
    """Looks at all trials at once."""

    def of(self, k: int, x: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """Less the mean over trials."""
        centred: Floats = x - x.mean(axis=1, keepdims=True)
        return centred


class Counted(Sent):
    """Remembers in its class how often any of its kind was asked."""

    asked = 0

    def of(self, k: int, x: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """A little more each time."""
        Counted.asked += 1
        return x + 1e-9 * Counted.asked


class Negative(Sent):
    """Sends packets that the estimator cannot read."""

    def of(self, k: int, x: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """The negative."""
        return -x


class Remembers(PlainEstimator):
    """Keeps the last packet in itself."""

    last: Any = 0.0

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """As plain, and a little of the last slot's."""
        step = super().step(k, belief, heard._replace(z=heard.z + 1e-9 * self.last))
        self.last = heard.z[0] * heard.gamma
        return step


class Peeks(PlainEstimator):
    """Uses a small part of a packet that was never received."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """As plain, and more."""
        step = super().step(k, belief, heard)
        return step._replace(x_hat=step.x_hat + 1e-9 * heard.z)


class Discards(PlainEstimator):
    """Says that it uses packets that it ignores."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Other than `act`."""
        step = super().step(k, belief, heard)
        return step._replace(action=3 * step.action)


class AllInnovations(SharedSecret):  # type: ignore[misc]  # final: nobody should do this
    """Slot 0 as any other."""

    def nu_block(self, slots: range) -> Flags:
        """Always."""
        return np.ones_like(super().nu_block(slots))


class NoFirst(Innovation):
    """Sends innovations alone."""

    def shared(self, keys: Any, batch: Any) -> SharedSecret:
        """The shared secret, without a state in slot 0."""
        return AllInnovations(self.process, self.state_probability, keys, batch)


class Apart(Cipher):
    """Its estimator by itself has another mask."""

    def estimator(self, keys: Any, batch: Any) -> CipherEstimator:
        """Without the mask."""
        return super().estimator({"mask": bytes(32)} if keys else keys, batch)  # type: ignore[return-value]


SCHEME_RULES: dict[str, tuple[type[Scheme], str, str]] = {
    "independent trials": (plain_with(Centred), "slot 0, trial 0: Packet.z is ", "no sum over trials"),
    "same results when made again": (plain_with(Counted), "with another one of its kind", "keep no state outside"),
    "slots computed again": (plain_with(estimator=Remembers), "when the slot is asked for again", "Belief.memory"),
    "lost packets unused": (
        plain_with(estimator=Peeks),
        "depending on z where nothing was received",
        "where gamma is true alone",
    ),
    "actions predictable from receptions": (
        plain_with(estimator=Discards),
        "act() says STATE and step() did DISCARDED",
        "reads_packets",
    ),
    "better than open-loop prediction": (
        plain_with(Negative),
        "for a receiver that hears nothing",
        "decode what encode() has made",
    ),
    "a state in slot 0": (NoFirst, "slot 0, trial 0: nu is true", "no state before the first"),
    "separate sensor and estimator": (Apart, "made from shared()", "from the keys alone"),
    "theory agrees with simulation": (
        plain_with(outcomes=lambda self, mu: Outcomes.plain(mu / 2)),  # noqa: ARG005 - a method
        "the mean squared error is",
        "or return None",
    ),
}


@pytest.mark.parametrize("rule", SCHEME_RULES)
def test_a_scheme_that_breaks_a_rule_is_told_which(rule: str) -> None:
    """With the slot, the trial, both values and the remedy."""
    kind, message, remedy = SCHEME_RULES[rule]
    result = broken(SchemeChecks(kind, kind.parameters).verdicts())
    assert message in result[rule]
    assert remedy in result[rule]


def test_a_scheme_says_of_every_packet_whether_it_is_encrypted() -> None:
    """One flag for each slot and trial; anything else is told."""
    kind = plain_with(encrypted=lambda self, packets: packets.nu[0])  # noqa: ARG005 - a method
    result = broken(SchemeChecks(kind, {}).verdicts())
    assert "encrypted()" in result["shapes and types"]

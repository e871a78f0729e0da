"""The rules for classes: every built-in class keeps them, and a class that breaks one is told which, where, and what to do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evedrop.conformance import eavesdroppers
from evedrop.conformance.eavesdroppers import Listening, eavesdropper_verdicts
from evedrop.conformance.examine import examined
from evedrop.conformance.links import DelayChecks, LossChecks
from evedrop.conformance.problems import Problem, small
from evedrop.conformance.rules import Broken
from evedrop.conformance.schemes import scheme_verdicts
from evedrop.errors import UsageError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.delays.normal import Normal
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.naive import Naive
from evedrop.model.eavesdroppers.suspicious import Suspicious
from evedrop.model.links import LOSS_MODELS
from evedrop.model.links.bernoulli import Bernoulli
from evedrop.model.links.gilbert_elliott import GilbertElliott
from evedrop.model.links.link import fates_of
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Belief, Codes, Flags, Reception
from evedrop.model.registry import asked
from evedrop.model.schemes import SCHEMES
from evedrop.model.schemes.cipher import Cipher, CipherEstimator
from evedrop.model.schemes.innovation import Innovation, SharedSecret
from evedrop.model.schemes.plain import PlainEncoder, PlainEstimator
from evedrop.model.schemes.scheme import Packet, Scheme
from evedrop.model.theory.covariances import Outcomes
from tests.conformance.breaking import broken, plain_with

EVERY = [
    (option, name)
    for option, names in (
        ("scheme", SCHEMES),
        ("eavesdropper", STRATEGIES),
        ("link", LOSS_MODELS),
        ("delay", DELAY_MODELS),
    )
    for name in names
]


SLOW = sorted({"reference", "tracker", *(name for name in STRATEGIES if STRATEGIES[name].costly)})
"""Eavesdroppers whose slot takes a hundred or a thousand times as long as another's: learners, and filters of many states."""


def keeps_every_rule(option: str, name: str) -> None:
    """Examine a built-in class, an eavesdropper together with a scheme that it is for."""
    schemes = {
        "reference": {"scheme": "acknowledged"},
        "clear-states": {"scheme": "partial-encryption"},
        "selective": {"scheme": "encrypted-schedule"},
        "tracker": {"scheme": "twin-track"},
    }
    for one in examined({option: name, **(schemes.get(name, {}) if option == "eavesdropper" else {})}, {}):
        assert [verdict for verdict in one.verdicts if verdict.broken is not None] == [], one.title
        assert len(one.verdicts) >= 4


@pytest.mark.parametrize(
    ("option", "name"),
    [pytest.param(*one, marks=[pytest.mark.long] if one[1] in SLOW else []) for one in EVERY],
)
def test_built_in_classes_keep_every_rule(option: str, name: str) -> None:
    """On the same small problems as anybody's own."""
    keeps_every_rule(option, name)


@pytest.mark.parametrize("name", SLOW)
def test_slow_eavesdroppers_keep_every_rule_for_a_while(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the same problems with fewer slots."""

    def shorter(slots: int = 0) -> list[Problem]:
        found = small(slots)
        return [replace(one, batch=replace(one.batch, slots=min(one.slots, 12))) for one in found]

    monkeypatch.setattr(eavesdroppers, "small", shorter)
    keeps_every_rule("eavesdropper", name)


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
    """Is not what the estimator reads."""

    def of(self, k: int, x: Floats) -> Floats:  # noqa: ARG002 - every slot alike
        """The negative."""
        return -x


class Remembers(PlainEstimator):
    """Keeps the last packet in itself."""

    last: Any = 0.0

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """As plain, and a little of the last slot's."""
        found = super().step(k, belief, heard._replace(z=heard.z + 1e-9 * self.last))
        self.last = heard.z[0] * heard.gamma
        return found


class Peeks(PlainEstimator):
    """Uses a little of what was never received."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """As plain, and more."""
        found = super().step(k, belief, heard)
        return found._replace(x_hat=found.x_hat + 1e-9 * heard.z)


class Discards(PlainEstimator):
    """Says that it uses what it leaves."""

    def step(self, k: int, belief: Belief, heard: Reception) -> Belief:
        """Other than `act`."""
        found = super().step(k, belief, heard)
        return found._replace(action=3 * found.action)


class AllInnovations(SharedSecret):  # type: ignore[misc]  # final: nobody should do this
    """Slot 0 as any other."""

    def nu(self, k: int) -> Flags:
        """Always."""
        return np.ones_like(super().nu(k))


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
    "a trial by itself": (plain_with(Centred), "slot 0, trial 0: Packet.z is ", "no sum over trials"),
    "the same scheme made twice": (plain_with(Counted), "with another one of its kind", "keep no state outside"),
    "a slot asked for again": (plain_with(estimator=Remembers), "when the slot is asked for again", "Belief.memory"),
    "packets that were lost": (
        plain_with(estimator=Peeks),
        "depending on z where nothing was received",
        "where gamma is true alone",
    ),
    "actions that γ tells": (
        plain_with(estimator=Discards),
        "act() says STATE and step() did DISCARDED",
        "reads_packets",
    ),
    "no worse than prediction": (
        plain_with(Negative),
        "for a receiver that hears nothing",
        "decode what encode() has made",
    ),
    "slot 0": (NoFirst, "slot 0, trial 0: nu is true", "no state before the first"),
    "sensor and estimator apart": (Apart, "made from shared()", "from the keys alone"),
    "what it says to theory": (
        plain_with(outcomes=lambda self, mu: Outcomes.plain(mu / 2)),  # noqa: ARG005 - a method
        "the mean squared error is",
        "or return None",
    ),
}


@pytest.mark.parametrize("rule", SCHEME_RULES)
def test_a_scheme_that_breaks_a_rule_is_told_which(rule: str) -> None:
    """With the slot, the trial, both values and the remedy."""
    kind, said, remedy = SCHEME_RULES[rule]
    parameters = kind.parameters

    def scheme_of(process: Process) -> Scheme:
        return kind(process, **parameters)

    found = broken(scheme_verdicts(scheme_of, kind))
    assert said in found[rule]
    assert remedy in found[rule]


def test_a_scheme_says_of_every_packet_whether_it_is_encrypted() -> None:
    """One flag for each slot and trial; anything else is told."""
    kind = plain_with(encrypted=lambda self, packets: packets.nu[0])  # noqa: ARG005 - a method
    found = broken(scheme_verdicts(kind, kind))
    assert "encrypted()" in found["shapes and types"]


class Forgetful(Suspicious):
    """Tosses a new coin for every slot that it is asked for, by how often it was asked."""

    tosses = 0

    def uses(self, k: int) -> Flags | None:
        """By the coin of another slot."""
        self.tosses += 1
        return super().uses((k + self.tosses // 12) % 9)


class Boastful(Naive):
    """Takes every packet, and tells theory that it takes half."""

    @classmethod
    def use_probabilities(cls, parameters: Any) -> tuple[float, float]:
        """Not so."""
        del parameters
        return 0.5, 0.5


@pytest.mark.parametrize(
    ("kind", "rule", "said"),
    [
        (Forgetful, "a slot asked for again", "Belief.memory"),
        (Boastful, "what it says to theory", "outcomes say"),
    ],
)
def test_an_eavesdropper_that_breaks_a_rule_is_told_which(kind: Any, rule: str, said: str) -> None:
    """As a scheme is."""
    parameters = dict(kind.parameters)
    name = "suspicious" if kind is Forgetful else "naive"
    listening = Listening(name, kind, parameters, lambda process: Innovation(process, 0.6), Innovation)
    if kind is Boastful:
        listening = replace(listening, name=f"{__name__}:Boastful")
    assert said in broken(eavesdropper_verdicts(listening))[rule]


class Better(Bernoulli):
    """Says that it delivers more than it does."""

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Fewer."""
        return super().fates(first, uniforms / 0.9)


class Unsteady(GilbertElliott):
    """Has bursts, and says that it has none."""

    chain = None  # type: ignore[assignment]  # the lie


class InPlace(Bernoulli):
    """Counts slots in an array, in place."""

    def __init__(self, quality: float) -> None:
        super().__init__(quality)
        self.count = np.zeros(1)

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """Every third packet of those asked for is lost."""
        lost = np.empty((len(uniforms), uniforms.shape[2]), np.bool_)
        for row in range(len(lost)):
            self.count += 1.0
            lost[row] = (self.count % 3.0 == 0.0).item() | (uniforms[row, 0] >= self.quality)
        del first
        return fates_of(lost)


class Whole(Bernoulli):
    """Loses the last of the slots that it is asked for."""

    def fates(self, first: int, uniforms: Floats) -> Codes:
        """By how many they are."""
        found = super().fates(first, uniforms).copy()
        found[-1] = 1
        return found


@pytest.mark.parametrize(
    ("kind", "parameters", "rule", "said"),
    [
        (Better, {"quality": 0.8}, "the quality it says", "quality_at() says 0.8"),
        (Unsteady, {"p": 0.05, "r": 0.1}, "the quality it says", "give `chain`"),
        (InPlace, {"quality": 0.9}, "a copy that goes on", "never change an array of it in place"),
        (Whole, {"quality": 0.9}, "slots in pieces", "not on how many slots"),
    ],
)
def test_a_loss_model_that_breaks_a_rule_is_told_which(
    kind: Any, parameters: dict[str, float], rule: str, said: str
) -> None:
    """As a scheme is."""
    assert said in broken(LossChecks(lambda: kind(**parameters), kind).verdicts())[rule]


class Early(Normal):
    """Says that more is there in time than is."""

    def arrived(self, lag: int) -> float | None:
        """As if a slot later."""
        return super().arrived(lag + 1)


def test_a_delay_model_that_breaks_a_rule_is_told_which() -> None:
    """As a loss model is."""
    found = broken(DelayChecks(lambda: Early(2.0, 1.0), Early).verdicts())
    assert "and arrived(" in found["the delays it says"]


@pytest.mark.parametrize(
    ("names", "parameters", "said"),
    [
        ({"scheme": "inovation"}, {}, "--scheme inovation is unknown; expected MODULE:CLASS, or acknowledged, "),
        ({"scheme": "innovation"}, {"state_probability": 2.0}, "--scheme innovation: state_probability: is 2.0"),
        (
            {"scheme": "innovation"},
            {"threshold": 2},
            "--set threshold: is not a parameter of innovation; expected state_prob",
        ),
        (
            {"link": "pattern", "scheme": "plain"},
            {"x": 2},
            "--set x: is not a parameter of pattern, plain; expected outcomes",
        ),
        (
            {"eavesdropper": "smart", "scheme": "plain"},
            {},
            "asks for the key of schedule, and the scheme plain has no keys",
        ),
    ],
)
def test_what_cannot_be_checked_is_refused(names: dict[str, str], parameters: dict[str, Any], said: str) -> None:
    """Names that are none, parameters that are none or wrong, keys that the scheme beside it does not have."""
    with pytest.raises(UsageError) as caught:
        list(examined(names, parameters))
    assert said in str(caught.value)
    assert caught.value.exit_status == 2


class Chained(Bernoulli):
    """Says that its losses follow a number."""

    chain: Any = 3


class Anywhen(Naive):
    """Is told the state of no slot that there is."""

    @classmethod
    def betrayed(cls, parameters: Any) -> Any:
        """No slot."""
        del parameters
        return "three"


class Silent(Naive):
    """Has nothing to say of its parameters, and no list to say it with."""

    @classmethod
    def mistakes(cls, given: Any) -> Any:
        """Nothing."""
        del given


def test_whatever_a_class_says_of_itself_is_a_verdict() -> None:
    """Nothing that it returns ends the check by an error; once shapes are wrong, no other rule is asked."""
    (verdict,) = LossChecks(lambda: Chained(0.9), Chained).verdicts()
    assert verdict.rule == "shapes and types"
    assert "'int' object has no attribute 'transitions'" in str(verdict.broken)
    listening = Listening("anywhen", Anywhen, {}, lambda process: Innovation(process, 0.6), Innovation)
    with pytest.raises(Broken, match=r"betrayed\(\) is 'three'; expected a slot"):
        eavesdropper_verdicts(listening)
    assert asked(Silent, {"depth": 3}) == [
        (
            "depth",
            "cannot be checked: Silent.mistakes returned None; expected it to return a list of (entry, what is wrong)",
        )
    ]

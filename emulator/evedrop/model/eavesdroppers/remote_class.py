"""Remote classes, for eavesdroppers' classes that must not run here: they give the classes' answers and cannot be instantiated.

Source: docs/your-own.md, where a class runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self, final

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, PacketTaker
from evedrop.model.kernels.elementary import sum_in_order
from evedrop.model.remote_calls import RemoteCalls
from evedrop.model.theory.covariances import Outcomes, OutcomesAt

_ROUNDING = 1e-9
_FRACTIONS = ("predicted", "state", "misled", "decoded", "leaked")
"""The entries of `Outcomes` that sum to 1."""


@final
class RemoteClasses:
    """Makes remote classes, whose class methods are calls of `calls`."""

    def __init__(self, calls: RemoteCalls, registry: str) -> None:
        """registry: the attribute of `evedrop.model.eavesdroppers` that contains the classes."""
        self.calls = calls
        self._registry = registry

    def __call__(self, name: str) -> type[Eavesdropper]:
        """The remote class of a name. Raises NotRegistered if there is no such class."""
        try:
            facts = self.calls.call(name, "class", self._registry)
        except NoAnswer as error:
            raise NotRegistered(name, f", and {error}; expected a class that can be asked about itself") from error
        parameters = facts.get("parameters") if isinstance(facts, dict) else None
        if not isinstance(parameters, dict):
            raise NotRegistered(name, ", whose answer is invalid; expected a class that declares its parameters")
        base = _RemoteTaker if facts.get("takes") is True else _RemoteEavesdropper
        said = {
            "parameters": parameters,
            "pools_links": facts.get("pools_links") is True,
            **{name: facts.get(name) is True for name in ("inverts_noise", "reads_leaks", "tests_range")},
            "only_against": _only_against(facts.get("only_against")),
            "_own_outcomes": facts.get("own_outcomes") is not False,
            "_ask": staticmethod(lambda do, *given: self.calls.call(name, do, self._registry, *given)),
            "__module__": __name__,
        }
        return type(name.rpartition(":")[2], (base,), said)


def _only_against(found: Any) -> tuple[str | tuple[str, ...], str] | None:
    """A scheme, or several, and a reason, if that is what the class says."""
    if not isinstance(found, list) or len(found) != 2 or not isinstance(found[1], str):
        return None
    if isinstance(found[0], list) and all(isinstance(one, str) for one in found[0]):
        return tuple(found[0]), found[1]
    return (found[0], found[1]) if isinstance(found[0], str) else None


def _wrong(what: str, found: Any, expected: str) -> NoAnswer:
    return NoAnswer(f"{what} is {found!r}; expected {expected}")


class _RemoteEavesdropper(Eavesdropper):
    """The class methods, answered by the class itself. Abstract."""

    _ask: ClassVar[Callable[..., Any]]
    _own_outcomes: ClassVar[bool]

    def __new__(cls, *_: object) -> Self:
        """Raises TypeError: this is a remote class, of a class that must not run here."""
        raise TypeError(f"{cls.__name__} runs in the eavesdropper's process alone; take Registry.imported there")

    @classmethod
    def mistakes(cls, given: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The class's answer."""
        found = cls._ask("mistakes", dict(given))
        if not isinstance(found, list) or not all(isinstance(one, list) and len(one) == 2 for one in found):
            raise _wrong("mistakes()", found, "a list of (entry, what is wrong)")
        return [(str(entry), str(what)) for entry, what in found]

    @classmethod
    def streams(cls, parameters: Mapping[str, Any]) -> tuple[str, ...]:
        """The class's answer."""
        found = cls._ask("streams", dict(parameters))
        if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
            raise _wrong("streams()", found, "names of streams")
        return tuple(found)

    @classmethod
    def betrayed(cls, parameters: Mapping[str, Any]) -> int | None:
        """The class's answer."""
        found = cls._ask("betrayed", dict(parameters))
        if found is not None and (type(found) is not int or found < 0):
            raise _wrong("betrayed()", found, "a slot, from 0 on, or None")
        return found

    @classmethod
    def follows_gamma(cls, parameters: Mapping[str, Any]) -> bool:
        """The class's answer."""
        found = cls._ask("follows_gamma", dict(parameters))
        if not isinstance(found, bool):
            raise _wrong("follows_gamma()", found, "True or False")
        return found

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """The class's answer, at every quality that is asked for."""
        known = cls._ask("outcomes", dict(parameters), mu_d)
        if not known:
            return None

        def at(mu_e: float) -> Outcomes:
            found = cls._ask("outcomes_at", dict(parameters), mu_d, float(mu_e))
            names = [*_FRACTIONS, "initial"]
            if not isinstance(found, dict) or sorted(found) != sorted(names):
                raise _wrong("outcomes()", found, f"the probabilities {', '.join(names)}")
            if not all(_is_probability(value) for value in found.values()):
                raise _wrong("outcomes()", found, "probabilities")
            if abs(sum_in_order(found[name] for name in _FRACTIONS) - 1.0) > _ROUNDING:
                raise _wrong("outcomes()", found, f"{', '.join(_FRACTIONS)} that sum to 1")
            return Outcomes(**found)

        return at


class _RemoteTaker(_RemoteEavesdropper, PacketTaker):
    """The same for a class that uses packets as the state or ignores them. Abstract."""

    @classmethod
    def outcomes(cls, parameters: Mapping[str, Any], mu_d: float) -> OutcomesAt | None:
        """Outcomes from the two probabilities, unless the class has a theory of its own."""
        if cls._own_outcomes:
            return super().outcomes(parameters, mu_d)
        return PacketTaker.outcomes.__func__(cls, parameters, mu_d)  # type: ignore[attr-defined,no-any-return]

    @classmethod
    def use_probabilities(cls, parameters: Mapping[str, Any]) -> tuple[float, float]:
        """The class's answer."""
        found = cls._ask("use_probabilities", dict(parameters))
        if not isinstance(found, list) or len(found) != 2 or not all(map(_is_probability, found)):
            raise _wrong("use_probabilities()", found, "two probabilities")
        return found[0], found[1]


def _is_probability(value: Any) -> bool:
    number = type(value) in {int, float} and math.isfinite(value)
    return number and -_ROUNDING <= value <= 1.0 + _ROUNDING

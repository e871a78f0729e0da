"""The result of a comparison, and its file: for every scheme and adversary the errors, theory, and the verdict.

Source: docs/compare.md.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
from pydantic import TypeAdapter

from evedrop.errors import UsageError
from evedrop.results.reading import ByName
from evedrop.results.summary_file import plain
from evedrop.score.secrecy import Claim
from evedrop.score.summary import RARE_FRACTION, RareEvents, SecrecySummary
from evedrop.score.verdict import SecrecyOutcome
from evedrop.system.files import Unreadable, text_of

COMPARISON = "compare.json"
_MOST_BYTES = 2**26
_NOT_IN_NAMES, _LONGEST_NAME = re.compile(r"[^a-z0-9_-]"), 32  # of receivers
_ALIKE = 1e-6  # relative difference of two errors of theory that count as equal: allows for rounding only
_REACH = 3.0  # standard errors around a mean over very many trials within which its expectation is taken to be

Range = tuple[float, float]
"""The least and the largest value that an error may have."""


def receiver_name(strategy: str) -> str:
    """The name of a receiver with this strategy in a scenario."""
    return _NOT_IN_NAMES.sub("-", strategy.lower())[:_LONGEST_NAME]


@dataclass(frozen=True)
class Match:
    """An adversary against a scheme: its strategy in the scenario of its group, or the reason why it is not defined."""

    scheme: str
    adversary: str
    strategy: str | None = None
    """Its strategy; None if the match is not defined."""
    attack: str = "none"
    not_defined: str | None = None
    betrayed: bool = False
    """Whether the adversary learns a true state, against which no scheme can protect."""

    @property
    def receiver(self) -> str:
        """Its name in the scenario: that of its strategy, so that it has the same losses under any attack."""
        return receiver_name(str(self.strategy))


@dataclass(frozen=True)
class Theory:
    """The trace of a receiver's theoretical error covariance."""

    mean: float
    """Mean over the slots of the run."""
    last: float
    """In the last slot of the run."""
    limit: float | None
    """In the long run; inf if it is unbounded; None if a bound is known only for the run."""
    bound: bool
    """Whether these are only lower bounds of its error."""


@dataclass(frozen=True)
class SimulatedError:
    """A receiver's squared error in simulation, over all slots, with the theory for it."""

    mean: float
    """Mean over trials."""
    standard_error: float | None
    """Standard error of the mean; None for one trial, and if the variance is infinite, so that it would mean nothing."""
    quantiles: Mapping[str, float]
    """Level → quantile over trials of a trial's mean error."""
    infinite_variance: bool
    theory: Theory | None
    z: float | None = None
    """How many standard errors the mean is above theory; None without them, and where theory knows only a bound."""
    rare_events: RareEvents | None = None
    """As in the summary."""

    @property
    def typical(self) -> float:
        """The metric to compare by: the mean over trials, or the median if the variance is infinite."""
        return self.quantiles["0.5"] if self.infinite_variance else self.mean

    def expected(self, trials: int) -> Range:
        """Where its expectation over the slots of the run is: as in theory, else as trials tell, unless rare events matter.

        trials: of which this is the mean. Few of them tell less: the range is that of Student's t.
        """
        if self.theory is not None and not self.theory.bound:
            return self.theory.mean, self.theory.mean
        least = 0.0 if self.theory is None else self.theory.mean
        if self.standard_error is None or (self.rare_events and self.rare_events.fraction > RARE_FRACTION):
            return least, math.inf
        from scipy.special import ndtr, stdtrit  # noqa: PLC0415 - 0.2 s that only this needs

        reach = float(stdtrit(trials - 1, ndtr(_REACH))) * self.standard_error
        return max(least, self.mean - reach), max(least, self.mean + reach)

    @property
    def lasting(self) -> Range:
        """Where its expectation in the long run is, by theory alone."""
        limit = None if self.theory is None else self.theory.limit
        if self.theory is None or limit is None or math.isnan(limit):
            return 0.0, math.inf
        return limit, math.inf if self.theory.bound else limit


@dataclass(frozen=True)
class Cell:
    """One adversary against one scheme."""

    match: Match
    legitimate: SimulatedError | None = None
    """The legitimate estimator in the same simulation: an attack may affect it, too."""
    eavesdropper: SimulatedError | None = None
    secrecy: SecrecySummary | None = None
    trials: int = 0
    """Of the simulation."""

    @property
    def ratio(self) -> float | None:
        """Eavesdropper's over legitimate error in the second half of the run. None if the pair is not defined.

        Of medians over all slots if either variance is infinite.
        """
        if self.legitimate is None or self.eavesdropper is None or self.secrecy is None:
            return None
        first, second = self.legitimate, self.eavesdropper
        if not (first.infinite_variance or second.infinite_variance):
            return math.inf if self.secrecy.ratio is None else self.secrecy.ratio
        legitimate, other = (each.quantiles["0.5"] for each in (first, second))
        return other / legitimate if legitimate else math.inf if other else 1.0

    @property
    def ratio_error(self) -> float | None:
        """Standard error of the ratio; None for one trial, and for a ratio of medians."""
        return None if self.secrecy is None else self.secrecy.ratio_standard_error

    @property
    def verdict(self) -> SecrecyOutcome | None:
        """The verdict of the run; None if the pair is not defined."""
        return None if self.secrecy is None or self.secrecy.verdict is None else self.secrecy.verdict.outcome

    def as_dict(self) -> dict[str, Any]:
        """The cell in the form of compare.json."""
        verdict = self.verdict
        if verdict is None or self.secrecy is None or self.legitimate is None or self.eavesdropper is None:
            return {"not_defined": self.match.not_defined}
        return {
            "reads_as": self.match.strategy,
            "attack": self.match.attack,
            "betrayed": self.match.betrayed,
            "eavesdropper": asdict(self.eavesdropper),
            "legitimate": asdict(self.legitimate),
            "ratio": self.ratio,
            "ratio_standard_error": self.ratio_error,
            "verdict": verdict.value,
            "secrecy": asdict(self.secrecy),
        }


@dataclass(frozen=True)
class Needs:
    """The cost of a scheme."""

    acknowledgements: bool
    payload_bits: int
    """Bits of a packet's payload on the wire: float64 numbers."""
    header_bits: int
    """Bits of a packet's header on the wire: int64 numbers."""
    sent_fraction: float
    """Fraction of slots with a packet, measured without an attack."""
    encrypted_fraction: float
    """Fraction of slots with an encrypted packet, measured in the same way."""
    bits_per_slot: float
    """Bits of payload and header that the sensor sends in a slot on average."""
    energy_per_slot: float
    """Energy that the sensor spends in a slot on average, in the unit of the scenario's `[energy]`."""
    standard_errors: Mapping[str, float | None]
    """Standard errors of these four; None for one trial."""
    secret_bits_per_slot: int
    """The most bits in a slot from the streams that both sides draw."""
    initial_secret_bits: int
    """Bits that a trial uses once."""

    @property
    def packet_bits(self) -> int:
        """Bits of payload and header."""
        return self.payload_bits + self.header_bits


@dataclass(frozen=True)
class PacketLeak:
    """What a packet of a scheme reveals without the secret, to a receiver that knows its type: the mean over the run's slots.

    Source: docs/mathematics/eavesdroppers.md, leak in bits.
    """

    clear_fraction: float
    """The probability that it is the state itself."""
    bits: float | None
    """The bits about the path of states that a packet reveals if it is not the state itself; None if all are."""


@dataclass(frozen=True)
class SchemeResult:
    """One scheme against all adversaries."""

    name: str
    parameters: Mapping[str, Any]
    needs: Needs
    legitimate: SimulatedError
    """The legitimate estimator without an attack."""
    cells: Mapping[str, Cell]
    """Adversary → its cell, for all adversaries."""
    leak: PacketLeak | None = None
    """None: unknown."""

    @property
    def closest(self) -> Cell | None:
        """The adversary with the least error, except those that learn a true state; None if there is none."""
        return min(self._played, key=lambda cell: _error(cell.eavesdropper), default=None)

    @property
    def protection(self) -> float:
        """The error of the closest adversary, by theory if it is known."""
        return math.nan if self.closest is None else _error(self.closest.eavesdropper)

    @property
    def protection_range(self) -> Range:
        """Where the least of the expected errors of these adversaries is."""
        ranges = [cell.eavesdropper.expected(cell.trials) for cell in self._played if cell.eavesdropper is not None]
        least, most = (min(ends) for ends in zip(*ranges, strict=True)) if ranges else (0.0, math.inf)
        return least, most

    @property
    def price(self) -> float:
        """The largest error of the legitimate estimator under any attack: the limit of theory, if it is known."""
        return max(
            error.typical if error.lasting[0] < error.lasting[1] else error.lasting[0]
            for error in self.legitimate_errors
        )

    @property
    def price_range(self) -> Range:
        """Where the largest error of the legitimate estimator in the long run is, under any attack."""
        least, most = (max(ends) for ends in zip(*(error.lasting for error in self.legitimate_errors), strict=True))
        return least, most

    @property
    def _played(self) -> list[Cell]:
        return [cell for cell in self.cells.values() if cell.eavesdropper is not None and not cell.match.betrayed]

    @property
    def legitimate_errors(self) -> list[SimulatedError]:
        """The errors of the legitimate estimator without an attack, then in the simulation of each adversary."""
        return [self.legitimate, *(cell.legitimate for cell in self.cells.values() if cell.legitimate is not None)]

    def keeps_up_with(self, other: SchemeResult) -> bool:
        """Whether it is certain that neither its price nor its protection is worse."""
        cheap = self.price_range[1] <= other.price_range[0] * (1.0 + _ALIKE)
        return cheap and self.protection_range[0] >= other.protection_range[1] * (1.0 - _ALIKE)

    def is_beaten_by(self, other: SchemeResult) -> bool:
        """Whether it is certain that its price or its protection is worse."""
        dear = self.price_range[0] > other.price_range[1] * (1.0 + _ALIKE)
        return dear or self.protection_range[1] < other.protection_range[0] * (1.0 - _ALIKE)


def _error(of: SimulatedError | None) -> float:
    assert of is not None  # noqa: S101 - the caller has checked it
    return of.typical if of.theory is None or of.theory.bound else of.theory.mean


@dataclass(frozen=True)
class Comparison:
    """The result of `evedrop compare`; `table` has a row for each pair, for pandas or polars."""

    title: str
    slots: int
    trials: int
    seed: int
    first_trial: int
    adversaries: tuple[str, ...]
    schemes: Mapping[str, SchemeResult] = field(default_factory=dict)
    left_out: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Scheme that cannot be used with the process → why not, in lines."""
    of_estimate: bool = False
    """Whether errors are against the estimate of a sensor that measures, and not against the true state."""
    not_done: tuple[str, ...] = ()
    """Schemes that an interrupted comparison has not simulated."""

    @property
    def dominant(self) -> tuple[str, ...]:
        """Schemes that no other beats: none has a smaller price, or more protection."""
        return tuple(scheme.name for scheme in self.schemes.values() if self.is_beaten(scheme) is False)

    def is_beaten(self, scheme: SchemeResult) -> bool | None:
        """Whether another scheme has a smaller price, or more protection; None if that is not certain, or there is no other."""
        others = [other for other in self.schemes.values() if other is not scheme]
        if any(map(scheme.is_beaten_by, others)):
            return True
        return False if others and all(map(scheme.keeps_up_with, others)) else None

    @property
    def without_limit(self) -> tuple[str, ...]:
        """Schemes whose legitimate error in the long run no theory gives, so that `price` has that of the trials."""
        ranges = {scheme.name: scheme.price_range for scheme in self.schemes.values()}
        return tuple(name for name, (least, most) in ranges.items() if least < most)

    @property
    def without_protection(self) -> tuple[str, ...]:
        """Schemes against which no adversary counts."""
        return tuple(scheme.name for scheme in self.schemes.values() if scheme.closest is None)

    def cell(self, scheme: str, adversary: str) -> Cell:
        """The cell of one pair. Raises UnknownName, a KeyError, for a scheme or an adversary that was not compared."""
        return ByName("adversary", ByName("scheme", self.schemes)[scheme].cells)[adversary]

    def as_dict(self) -> dict[str, Any]:
        """The comparison in the form of compare.json, except for infinite numbers."""
        return {
            "scenario": self.title,
            "slots": self.slots,
            "trials": self.trials,
            "seed": self.seed,
            "first_trial": self.first_trial,
            **({"of_estimate": True} if self.of_estimate else {}),
            **({"not_done": list(self.not_done)} if self.not_done else {}),
            "adversaries": list(self.adversaries),
            "dominant": list(self.dominant),
            "schemes": {
                name: {
                    "parameters": dict(scheme.parameters),
                    "needs": {**asdict(scheme.needs), "packet_bits": scheme.needs.packet_bits},
                    "legitimate": asdict(scheme.legitimate),
                    "leak": None if scheme.leak is None else asdict(scheme.leak),
                    "closest": None if scheme.closest is None else scheme.closest.match.adversary,
                    "against": {adversary: cell.as_dict() for adversary, cell in scheme.cells.items()},
                }
                for name, scheme in self.schemes.items()
            },
            "left_out": {name: list(why) for name, why in self.left_out.items()},
        }

    def as_json(self, indent: int | None = 1) -> str:
        """Strict JSON; infinite and undefined numbers as strings."""
        return json.dumps(plain(self.as_dict()), indent=indent, ensure_ascii=False)

    @property
    def table(self) -> pa.Table:
        """A row for each pair of scheme and adversary."""
        return pa.Table.from_pylist([row for scheme in self.schemes.values() for row in _rows(scheme)])


_NEEDS = (
    "packet_bits",
    "sent_fraction",
    "encrypted_fraction",
    "bits_per_slot",
    "energy_per_slot",
    "secret_bits_per_slot",
    "acknowledgements",
)


def _rows(scheme: SchemeResult) -> Iterator[dict[str, Any]]:
    for adversary, cell in scheme.cells.items():
        leak = None if cell.secrecy is None else cell.secrecy.leak
        yield {
            "scheme": scheme.name,
            "adversary": adversary,
            "not_defined": cell.match.not_defined,
            **_error_columns("eavesdropper", cell.eavesdropper),
            **_error_columns("legitimate", cell.legitimate),
            "ratio": cell.ratio,
            "ratio_standard_error": cell.ratio_error,
            "verdict": None if cell.verdict is None else cell.verdict.value,
            "clear_fraction": None if leak is None else leak.clear_fraction,
            "leaked_bits": None if leak is None else leak.bits,
            "leaked_bits_standard_error": None if leak is None else leak.standard_error,
            "leaked_bits_theory": None if leak is None else leak.expected_bits,
            "leaked_bits_z": None if leak is None else leak.z,
            **{name: getattr(scheme.needs, name) for name in _NEEDS},
        }


def _error_columns(whose: str, error: SimulatedError | None) -> dict[str, float | None]:
    return {
        f"{whose}_error": None if error is None else error.mean,
        f"{whose}_standard_error": None if error is None else error.standard_error,
        f"{whose}_median": None if error is None else error.quantiles["0.5"],
        f"{whose}_theory": None if error is None or error.theory is None else error.theory.mean,
        f"{whose}_z": None if error is None else error.z,
    }


def read_comparison(folder: Path) -> Comparison:
    """The comparison in a results folder. Raises UsageError."""
    path = folder / COMPARISON
    try:
        return _comparison(json.loads(text_of(path, _MOST_BYTES)))
    except (OSError, Unreadable, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        why = " ".join(str(error).split()) if isinstance(error, ValueError) else repr(error)
        raise UsageError(f"{path} is not a comparison of this version ({why}); run it again") from error


def _comparison(data: Mapping[str, Any]) -> Comparison:
    return Comparison(
        data["scenario"],
        int(data["slots"]),
        int(data["trials"]),
        int(data["seed"]),
        int(data["first_trial"]),
        tuple(data["adversaries"]),
        {name: _scheme(name, table, int(data["trials"])) for name, table in data["schemes"].items()},
        {name: tuple(why) for name, why in data["left_out"].items()},
        bool(data.get("of_estimate", False)),
        tuple(map(str, data.get("not_done", ()))),
    )


def _scheme(name: str, data: Mapping[str, Any], trials: int) -> SchemeResult:
    needs = {key: value for key, value in data["needs"].items() if key != "packet_bits"}
    return SchemeResult(
        name,
        data["parameters"],
        TypeAdapter(Needs).validate_python(needs),
        _simulated_error(data["legitimate"]),
        {adversary: _cell(name, adversary, table, trials) for adversary, table in data["against"].items()},
        None if data["leak"] is None else TypeAdapter(PacketLeak).validate_python(data["leak"]),
    )


def _cell(scheme: str, adversary: str, data: Mapping[str, Any], trials: int) -> Cell:
    if "verdict" not in data:
        return Cell(Match(scheme, adversary, not_defined=data["not_defined"]))
    match = Match(scheme, adversary, data["reads_as"], data["attack"], betrayed=bool(data["betrayed"]))
    secrecy = TypeAdapter(SecrecySummary).validate_python(data["secrecy"])
    if "ratio_from" not in data["secrecy"]:
        raise KeyError("ratio_from")  # results of an older version
    if secrecy.verdict is None:
        raise KeyError("verdict")  # the same
    for word in (secrecy.relative, secrecy.perfect):
        Claim(word)
    return Cell(match, _simulated_error(data["legitimate"]), _simulated_error(data["eavesdropper"]), secrecy, trials)


def _simulated_error(data: Mapping[str, Any]) -> SimulatedError:
    return TypeAdapter(SimulatedError).validate_python(data)

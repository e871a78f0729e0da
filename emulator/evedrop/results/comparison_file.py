"""compare.json, read back as a `Comparison`.

Source: docs/compare.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from evedrop.errors import UsageError
from evedrop.results.comparison import Cell, Comparison, Match, Needs, PacketLeak, SchemeResult, SimulatedError
from evedrop.score.summary import SecrecySummary
from evedrop.score.verdict import Secrecy, Verdict
from evedrop.system.files import Unreadable, text_of

COMPARISON = "compare.json"
_MOST_BYTES = 2**26


def read_comparison(folder: Path) -> Comparison:
    """The comparison in a results folder. Its verdicts lack `windows`, which only sentences have. Raises UsageError."""
    path = folder / COMPARISON
    try:
        return _comparison(json.loads(text_of(path, _MOST_BYTES)))
    except (OSError, Unreadable, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        why = " ".join(str(error).split()) if isinstance(error, ValueError) else repr(error)
        raise UsageError(f"{path} is not a comparison of this version ({why}); run it again") from error


def _comparison(found: Mapping[str, Any]) -> Comparison:
    return Comparison(
        found["scenario"],
        int(found["slots"]),
        int(found["trials"]),
        int(found["seed"]),
        int(found["first_trial"]),
        tuple(found["adversaries"]),
        {
            name: _scheme(name, one, (int(found["slots"]), int(found["trials"])))
            for name, one in found["schemes"].items()
        },
        {name: tuple(why) for name, why in found["left_out"].items()},
    )


def _scheme(name: str, found: Mapping[str, Any], size: tuple[int, int]) -> SchemeResult:
    needs = {key: value for key, value in found["needs"].items() if key != "packet_bits"}
    return SchemeResult(
        name,
        found["parameters"],
        TypeAdapter(Needs).validate_python(needs),
        _error(found["legitimate"]),
        {adversary: _cell(name, adversary, one, size) for adversary, one in found["against"].items()},
        None if found["leak"] is None else TypeAdapter(PacketLeak).validate_python(found["leak"]),
    )


def _cell(scheme: str, adversary: str, found: Mapping[str, Any], size: tuple[int, int]) -> Cell:
    if "verdict" not in found:
        return Cell(Match(scheme, adversary, not_defined=found["not_defined"]))
    match = Match(scheme, adversary, found["reads_as"], found["attack"], betrayed=bool(found["betrayed"]))
    said = TypeAdapter(SecrecySummary).validate_python(found["secrecy"])
    first = found["secrecy"]["ratio_from"]  # results of an older version have none, and are refused
    secrecy = Secrecy(
        match.receiver,
        Verdict(said.relative),
        Verdict(said.perfect),
        said.relative_by_theory,
        said.relative_from,
        "",
        said.perfect_by_theory,
        math.inf if said.ratio is None else said.ratio,
        size[1],
        said.judged_by,
        ratio_error=said.ratio_standard_error,
        leak=said.leak,
        ratio_slots=None if first is None else (first, size[0] - 1),
    )
    return Cell(match, _error(found["legitimate"]), _error(found["eavesdropper"]), secrecy)


def _error(found: Mapping[str, Any]) -> SimulatedError:
    return TypeAdapter(SimulatedError).validate_python(found)

"""Checks classes by name against every rule, for `evedrop check --scheme NAME` and its like.

Source: docs/your-own/rules.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evedrop.errors import NotRegistered, UsageError
from evedrop.model.delays import DELAY_MODELS
from evedrop.model.eavesdroppers import READERS, STRATEGIES
from evedrop.model.links import LOSS_MODELS
from evedrop.model.registry import Registry, asked
from evedrop.model.schemes import PAPERS_SCHEME, SCHEMES
from evedrop.scenario.conformance.eavesdroppers import EavesdropperChecks
from evedrop.scenario.conformance.links import DelayChecks, LossChecks
from evedrop.scenario.conformance.rules import Broken, RuleVerdict, calling
from evedrop.scenario.conformance.schemes import SchemeChecks
from evedrop.scenario.plugins import look_in

_CHECKS: Mapping[str, Any] = {"scheme": SchemeChecks, "link": LossChecks, "delay": DelayChecks}
_REGISTRIES: Mapping[str, Registry[Any]] = {
    "scheme": SCHEMES,
    "eavesdropper": STRATEGIES,
    "link": LOSS_MODELS,
    "delay": DELAY_MODELS,
}
_OWN_COIN = "coin"


@dataclass(frozen=True)
class Examined:
    """One class, and the verdict on each rule."""

    title: str
    verdicts: list[RuleVerdict]


@dataclass(frozen=True)
class _Named:
    """A class, its name, and its parameters for the check."""

    name: str
    kind: Any
    parameters: Mapping[str, Any]


def examined(names: Mapping[str, str], parameters: Mapping[str, Any]) -> Iterator[Examined]:
    """Check every class, one by one.

    names: `scheme`, `eavesdropper`, `link` or `delay` → its name; modules are looked for in the current folder.
    parameters: replace the classes' own examples.

    Raises UsageError for unknown names and for unknown or wrong parameters.
    """
    look_in(str(Path.cwd()))
    classes = {option: _named(option, name, parameters) for option, name in names.items()}
    accepted = [entry for named in classes.values() for entry in (*named.kind.parameters, *named.parameters)]
    for entry in parameters:
        if entry not in accepted:
            advice = (
                f"expected {', '.join(dict.fromkeys(accepted))}" if accepted else "they have no parameters; remove it"
            )
            raise UsageError(f"--set {entry}: is not a parameter of {', '.join(names.values())}; {advice}")
    for option, named in classes.items():
        title = f"{named.name}, {'an' if option[0] == 'e' else 'a'} {_REGISTRIES[option].kind}"
        if option == "eavesdropper":
            scheme = classes.get("scheme") or _scheme_for(named)
            yield Examined(f"{title}, with the scheme {scheme.name}", _listened(named, scheme))
        else:
            yield Examined(title, _CHECKS[option](named.kind, named.parameters).verdicts())


def _named(option: str, name: str, parameters: Mapping[str, Any]) -> _Named:
    registry = _REGISTRIES[option]
    try:
        kind = registry.imported(name)
        given = _given(kind, parameters)
        if "reads_as" in given:
            given = {**_given(READERS.imported(str(given["reads_as"])), parameters), **given}
    except NotRegistered as error:
        why = error.why or f" is unknown; expected MODULE:CLASS, or {', '.join(registry.names)}"
        raise UsageError(f"--{option} {error.name}{why}") from error
    wrong = [f"{entry}: {sentence}" for entry, sentence in asked(kind, given)]
    if wrong:
        raise UsageError(f"--{option} {name}: {'; '.join(wrong)}; give others by --set")
    return _Named(name, kind, given)


def _given(kind: Any, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The examples of a class's parameters, without the optional ones, and the parameters given."""
    optional = getattr(kind, "optional", ())
    examples = {entry: example for entry, example in kind.parameters.items() if entry not in optional}
    return examples | {entry: value for entry, value in parameters.items() if entry in kind.parameters}


def _listened(eavesdropper: _Named, scheme: _Named) -> list[RuleVerdict]:
    lacking = sorted({*_streams(eavesdropper)} - {*scheme.kind.secret_streams})
    if lacking:
        raise UsageError(
            f"--eavesdropper {eavesdropper.name}: asks for the key of {' and '.join(lacking)}, and the scheme {scheme.name} has "
            f"{', '.join(scheme.kind.secret_streams) or 'no keys'}; give another --scheme, or take it out of streams()"
        )
    try:
        return EavesdropperChecks(
            eavesdropper.name, eavesdropper.kind, eavesdropper.parameters, scheme.kind, scheme.parameters
        ).verdicts()
    except Broken as error:
        return [RuleVerdict("facts on the class", str(error))]


def _streams(named: _Named) -> list[str]:
    try:
        with calling("streams()", named.kind):
            return [stream for stream in named.kind.streams(named.parameters) if stream != _OWN_COIN]
    except Broken as error:
        raise UsageError(f"--eavesdropper {named.name}: {error}") from error


def _scheme_for(named: _Named) -> _Named:
    """The paper's scheme, or the first scheme that has the keys the eavesdropper asks for."""
    needed = {*_streams(named)}
    for name in (PAPERS_SCHEME, *SCHEMES):
        if needed <= {*SCHEMES[name].secret_streams}:
            return _Named(name, SCHEMES[name], dict(SCHEMES[name].parameters))
    return _Named(PAPERS_SCHEME, SCHEMES[PAPERS_SCHEME], dict(SCHEMES[PAPERS_SCHEME].parameters))

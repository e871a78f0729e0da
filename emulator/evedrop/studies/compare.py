"""Compares schemes against adversaries, on one process and its links: the secrecy of each scheme, and its cost.

Each scheme is a Monte Carlo study of its own, with another for every attack on acknowledgements; all of them have the same
trials, and an adversary has the same losses in each.

Source: docs/compare.md.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.model.metrics.built_in import MeanSquaredError
from evedrop.model.metrics.standard_error import standard_error
from evedrop.model.outcomes import legitimate_outcomes
from evedrop.model.schemes import SCHEMES, scheme_of
from evedrop.names import LEGITIMATE
from evedrop.results.comparison import Cell, Comparison, Needs, PacketLeak, SchemeResult, SimulatedError, Theory
from evedrop.results.folder import (
    disk_errors,
    make_private,
    private_pictures,
    replace_private,
    write_private,
)
from evedrop.results.resolved_scenario import input_texts, resolved
from evedrop.scenario.progress_events import OnEvent
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import Expectation, error_floor_of, expectations_of
from evedrop.score.leak import revealed_by_packets
from evedrop.score.rare_events import rare_events_of, z_of_error
from evedrop.score.run_tally import RunTally
from evedrop.score.scorekeeper import true_ratios, verdicts
from evedrop.score.sums import LEVELS, Tally, quantile_of, trial_means
from evedrop.simulate.chunk import PacketTally
from evedrop.simulate.finished_tasks import finished_tasks, study_of
from evedrop.simulate.montecarlo import Merger, Plan, progress_counter
from evedrop.simulate.simulation import Mode
from evedrop.simulate.trials import tasks_of
from evedrop.studies.matchups import Group, Matchups
from evedrop.system.signals import stop_on_signals

_WRITE_SECONDS = 3.0  # from one compare.json to the next
_WRITE_PAUSE = 50.0  # from one to the next, as a multiple of the time to write one


def compare_all(matchups: Matchups, folder: Path, on_event: OnEvent, plan: Plan, *, resume: bool = False) -> Comparison:
    """Simulate all matches into a results folder: compare.json, compare.png and .pdf, and the simulated scenarios.

    resume: go on with the comparison in the folder, which was interrupted.

    Raises UsageError for an unusable folder or plan; Interrupted on Ctrl-C and RunError if a worker fails, with the completed
    schemes in the folder.
    """
    if plan.mode is not Mode.EXACT:
        raise UsageError(
            f"a comparison follows packets, which the mode {plan.mode.value} does not have; leave the mode out"
        )
    if plan.rare:
        raise UsageError("rare=True is for montecarlo, and a comparison does not split trials; leave it out")
    groups = matchups.groups
    wanted = {"schemes": [*matchups.schemes], "adversaries": [*matchups.adversaries]}
    study = study_of("compare", wanted, [group.scenario for group in groups])
    on_progress = progress_counter(on_event, sum(group.scenario.trials * group.scenario.slots for group in groups))
    played: list[tuple[Group, Merger]] = []
    failure: RunError | None = None
    with (
        stop_on_signals() as stop,
        plan.crew(group.scenario for group in groups) as crew,
        finished_tasks(folder, study, resume) as finished,
    ):
        tasks = [tasks_of(group.scenario, plan.mode, 1, finished) for group in groups]
        everything = list(itertools.chain(*tasks))
        with (
            disk_errors(folder),
            contextlib.closing(crew.results(everything, on_progress, stop.is_set, finished)) as results,
        ):
            written, took = time.monotonic(), 0.0
            try:
                for group, its_tasks in zip(groups, tasks, strict=True):
                    merger = Merger.of(group.scenario, plan.mode, itertools.islice(results, len(its_tasks)))
                    if not merger.complete:
                        break
                    played.append((group, merger))
                    began = time.monotonic()
                    if began - written > max(_WRITE_SECONDS, _WRITE_PAUSE * took):
                        _write_found(folder, _comparison(matchups, played))
                        written = time.monotonic()
                        took = written - began
            except RunError as error:
                failure = error
        comparison = _comparison(matchups, played)
        if not comparison.schemes:
            finished.remove_unless_any()
            raise failure or finished.interrupted("a scheme was done")
        _write(folder, comparison, played)
        if failure is not None:
            raise failure
        if len(played) < len(groups):
            raise Interrupted(
                f"interrupted; {len(comparison.schemes)} of {len(matchups.schemes)} schemes are in {folder}"
            )
        finished.forget()
    return comparison


def _comparison(matchups: Matchups, played: Sequence[tuple[Group, Merger]]) -> Comparison:
    """The comparison of the schemes whose matches are all done."""
    some = matchups.groups[0].scenario
    wanted = [group.scheme for group in matchups.groups]
    done = [group.scheme for group, _ in played]
    whole = [scheme for scheme in matchups.schemes if done.count(scheme) == wanted.count(scheme)]
    title = some.title.rpartition(" (")[0]
    schemes = {}
    for scheme in whole:
        groups = [(group, merger) for group, merger in played if group.scheme == scheme]
        cells = {match.adversary: Cell(match) for match in matchups.undefined if match.scheme == scheme}
        for group, merger in groups:
            cells |= _cells(group, merger.run_tally)
        scenario, merger = groups[0][0].scenario, groups[0][1]
        legitimate = merger.run_tally.tallies[LEGITIMATE]
        schemes[scheme] = SchemeResult(
            scheme,
            scenario.encoding.parameters,
            _needs(scenario, merger.packets),
            _measured(scenario, LEGITIMATE, legitimate, expectations_of(scenario)[LEGITIMATE]),
            {adversary: cells[adversary] for adversary in matchups.adversaries},
            _leak(scenario),
        )
    return Comparison(
        title,
        some.slots,
        some.trials,
        some.seed,
        some.first_trial,
        matchups.adversaries,
        schemes,
        matchups.left_out,
        some.measures,
        tuple(scheme for scheme in matchups.schemes if scheme not in whole),
    )


def _cells(group: Group, run_tally: RunTally) -> dict[str, Cell]:
    totals = run_tally.tallies
    expected = expectations_of(group.scenario)
    measured = {name: _measured(group.scenario, name, tally, expected[name]) for name, tally in totals.items()}
    secrecy, _, _ = verdicts(group.scenario, totals, expected, true_ratios(run_tally, expected))
    return {
        match.adversary: Cell(
            match, measured[LEGITIMATE], measured[match.receiver], secrecy[match.receiver], totals[LEGITIMATE].trials
        )
        for match in group.matches
    }


def _needs(scenario: Scenario, packets: PacketTally) -> Needs:
    scheme = scenario.make_scheme()
    sent, encrypted = packets.sent / scenario.slots, packets.encrypted / scenario.slots
    of_trials = {
        "sent_fraction": sent,
        "encrypted_fraction": encrypted,
        "bits_per_slot": scheme.packet_bits * sent,
        "energy_per_slot": scenario.energy_model.spent(scheme, sent, encrypted),
    }
    return Needs(
        scheme.needs_acknowledgements,
        scheme.payload_bits,
        scheme.header_bits,
        **{name: float(np.mean(values)) for name, values in of_trials.items()},
        standard_errors={name: standard_error(values) for name, values in of_trials.items()},
        secret_bits_per_slot=scheme.secret_bits,
        initial_secret_bits=scheme.initial_secret_bits,
    )


def _leak(scenario: Scenario) -> PacketLeak | None:
    if scenario.of_model:
        return None
    packets = revealed_by_packets(scenario)
    if packets is None:
        return None
    revealed = packets.next(scenario.slots)
    hidden = 1.0 - revealed.clear
    bits = float(revealed.hidden_bits.sum()) / float(hidden.sum()) if hidden.any() else None
    return PacketLeak(float(np.mean(revealed.clear)), bits)


def _measured(scenario: Scenario, receiver: str, tally: Tally, expected: Expectation) -> SimulatedError:
    means = trial_means(tally)
    heavy = expected.infinite_variance
    error = None if heavy else standard_error(means)
    mean, theory = MeanSquaredError.of_tally(tally), _theory(scenario, receiver, expected)
    rare = None if expected.of_model else rare_events_of(expected, tally)
    exact = None if theory is None or theory.bound or expected.of_model else theory.mean
    return SimulatedError(
        mean,
        error,
        {f"{level:g}": quantile_of(means, level) for level in LEVELS},
        heavy,
        theory,
        z_of_error(means, exact, expected, tally.done, rare),
        rare,
    )


def _theory(scenario: Scenario, receiver: str, expected: Expectation) -> Theory | None:
    """The theory of a receiver: its error, or a lower bound for receivers of its kind; None if neither is known."""
    usable = expected if expected.known else expected.bound
    if usable is None and receiver == LEGITIMATE:
        usable = _if_given_states(scenario, expected)
    if usable is not None:
        traces = usable.traces(scenario.slots)
        return Theory(float(np.mean(traces)), float(traces[-1]), usable.limit, usable is not expected)
    bound = error_floor_of(scenario, receiver)
    if bound is None:
        return None
    floor, grows = bound
    return Theory(float(np.mean(floor)), float(floor[-1]), math.inf if grows else None, True)


def _if_given_states(scenario: Scenario, expected: Expectation) -> Expectation | None:
    """What theory would expect of the legitimate estimator if every packet brought the state; no built-in scheme does better.

    None if it does not know that, and for a scheme of the user's own, which may tell more by being silent.
    """
    if SCHEMES.foreign(scenario.encoding.scheme):
        return None
    plain = scheme_of(scenario.process.process, {"scheme": "plain"})
    given = replace(expected, outcomes_at=legitimate_outcomes(plain), closed=None, closed_bound=None, slots_at=None)
    return given if given.known else None


def _write(folder: Path, reproduction: Comparison, played: Sequence[tuple[Group, Merger]]) -> None:
    from evedrop.show.view.result_pictures import draw_comparison  # noqa: PLC0415 - matplotlib takes half a second

    with disk_errors(folder):
        _write_found(folder, reproduction)
        scenarios = folder / "scenarios"
        make_private(scenarios)
        for group, _ in played:
            write_private(scenarios / f"{group.name}.toml", resolved(group.scenario))
            for name, text in input_texts(group.scenario).items():
                write_private(scenarios / name, text)
        draw_comparison(private_pictures(folder / "compare"), reproduction)


def _write_found(folder: Path, result: Comparison) -> None:
    """Write compare.json with the schemes so far, if there are any; replaces the file atomically."""
    if result.schemes:
        replace_private(folder / "compare.json", result.as_json() + "\n")

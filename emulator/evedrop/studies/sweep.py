"""Monte Carlo over a grid: every combination of values of any entries of the scenario, in one tidy table."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from evedrop.errors import Interrupted, RunError, ScenarioError, UsageError
from evedrop.model.metrics import all_metrics, error_column, estimated_metrics, z_column
from evedrop.results.folder import disk_errors, private_pictures, private_replacement, write_private
from evedrop.results.tables import with_strategies
from evedrop.scenario.application import APPLICATIONS
from evedrop.scenario.loading import prepared, read, undoes, value_of
from evedrop.scenario.progress_events import OnEvent
from evedrop.scenario.tables import Scenario
from evedrop.scenarios import shipped
from evedrop.score.scorekeeper import RunOutcome
from evedrop.score.summary import FilterSummary, Summary
from evedrop.score.verdict import times_text
from evedrop.simulate.finished_tasks import finished_tasks, study_of
from evedrop.simulate.montecarlo import Merger, Plan, check_mode, progress_counter
from evedrop.simulate.trials import BatchResult, tasks_of
from evedrop.system.signals import stop_on_signals

Grid = Mapping[str, Sequence[Any]]
Point = Mapping[str, Any]

MOST_POINTS = 10_000
"""The most combinations of values."""
_WRITE_SECONDS = 3.0  # from one table of the points so far to the next
_RANGE = re.compile(r"[^\[\]{}\"',]*:[^\[\]{}\"',]*")  # a colon, and no character of a list or string
_WHOLE = re.compile(r"[+-]?\d+")
_LARGEST = 2**53  # of whole numbers in a column of numbers, which may have fractions, too; a seed may be larger


def grid_of(texts: Sequence[str]) -> dict[str, list[Any]]:
    """The grid that `--over` options describe: KEY=first:last:step, both ends included, or KEY=a,b,c.

    Raises UsageError for anything else, an empty range or list, or more than 10 000 points.
    """
    grid: dict[str, list[Any]] = {}
    for text in texts:
        key, equals, values = text.partition("=")
        if not equals or not key or not values:
            raise UsageError(f"--over {text}: expected KEY=first:last:step or KEY=a,b,c, such as slots=100,200")
        if key in grid:
            raise UsageError(f"--over {text}: {key} is given twice; give all its values in one option")
        grid[key] = _range(text, values) if _RANGE.fullmatch(values) else _listed(values)
        if not grid[key]:
            raise UsageError(f"--over {text}: the list is empty; expected KEY=a,b,c, such as slots=100,200")
    if math.prod(len(values) for values in grid.values()) > MOST_POINTS:
        raise UsageError(f"--over asks for more than {MOST_POINTS} points; take wider steps")
    return grid


def _listed(values: str) -> list[Any]:
    """The values between commas: TOML values, including lists and quoted strings, or else strings."""
    whole = value_of(f"[{values}]")
    return whole if isinstance(whole, list) else [value_of(value.strip()) for value in values.split(",")]


def _range(text: str, values: str) -> list[Any]:
    """The values of a range: whole numbers if all three are; decimal steps give decimals, 0.3 and not 0.30000000000000004."""
    try:
        first, last, step = (Decimal(value.strip()) for value in values.split(":"))
    except (ValueError, InvalidOperation):
        raise UsageError(f"--over {text}: expected three numbers first:last:step, such as 0.1:0.9:0.1") from None
    finite = all(number.is_finite() for number in (first, last, step))
    if not finite or not step or (last > first if step < 0 else last < first):
        raise UsageError(f"--over {text}: the range is empty; expected first:last:step with the step towards last")
    try:
        steps = (last - first) / step
    except ArithmeticError:  # a step that is too small for Decimal
        steps = Decimal(MOST_POINTS)
    if steps >= MOST_POINTS:
        raise UsageError(f"--over {text} asks for more than {MOST_POINTS} values; take a wider step")
    values_ = [first + i * step for i in range(int(steps) + 1)]
    whole = all(_WHOLE.fullmatch(value.strip()) for value in values.split(":"))
    return [int(value) if whole else float(value) for value in values_]


def sweep_over(
    source: str | Path | Scenario,
    changes: Mapping[str, Any],
    grid: Grid,
    folder: Path,
    on_event: OnEvent,
    plan: Plan,
    *,
    resume: bool = False,
) -> pa.Table:
    """Run every point of the grid into a folder: sweep.parquet, sweep.json and a plot.

    resume: go on with the sweep in the folder, which was interrupted.

    Returns the table, with a row for each point and peer. Raises UsageError if a value is given twice, ScenarioError if the
    scenario of any point has mistakes, before any point is run; Interrupted, or RunError if a worker fails, with the points
    done so far in the folder.
    """
    if plan.rare:
        raise UsageError("rare=True is for montecarlo, and a sweep does not split trials; leave it out")
    scenarios = _checked(source, changes, grid, plan)
    total = sum(scenario.trials * scenario.slots for _, scenario in scenarios)
    rows: list[dict[str, Any]] = []
    applications: dict[str, None] = {}  # those that the mode computes
    strategies = {name: given.strategy for name, given in scenarios[0][1].eavesdroppers.items()}
    failure: RunError | None = None
    done = 0
    description = {"scenario": _title(source), "changes": dict(changes), "over": dict(grid), "mode": plan.mode.value}
    text = json.dumps(description, indent=1, ensure_ascii=False, default=str)
    study = study_of("sweep", json.loads(text), [scenario for _, scenario in scenarios])
    with (
        stop_on_signals() as stop,
        plan.crew(scenario for _, scenario in scenarios) as crew,
        finished_tasks(folder, study, resume) as finished,
    ):
        each = crew.workers if len(scenarios) < 4 * crew.workers else 1  # if there are many points, do not split them
        tasks = [tasks_of(scenario, plan.mode, each, finished) for _, scenario in scenarios]
        on_progress = progress_counter(on_event, total)
        everything = list(itertools.chain(*tasks))
        with disk_errors(folder):
            write_private(folder / "sweep.json", text + "\n")
            if str(source) not in shipped():  # the report contains it, so that a reader can repeat the sweep
                text = source.to_toml() if isinstance(source, Scenario) else read(source)
                write_private(folder / "scenario.toml", text)
            with contextlib.closing(crew.results(everything, on_progress, stop.is_set, finished)) as results:
                written = time.monotonic()
                try:
                    for (point, scenario), its_tasks in zip(scenarios, tasks, strict=True):
                        summary = _summary(scenario, plan, itertools.islice(results, len(its_tasks)))
                        if summary is None:
                            break
                        rows += _rows(_stored(point, grid), scenario, summary)
                        applications |= dict.fromkeys(summary.applications)
                        done += 1
                        if time.monotonic() - written > _WRITE_SECONDS:
                            _write_table(folder, rows, strategies)
                            written = time.monotonic()
                except RunError as error:
                    failure = error
            if not rows:
                finished.remove_unless_any()
                raise failure or finished.interrupted("a point was done")
            table = _write_table(folder, rows, strategies)
            _draw(folder, table, grid, applications)
        if failure is not None:
            raise failure
        if done < len(scenarios):
            raise Interrupted(f"interrupted; {done} of {len(scenarios)} points were done, and are in {folder}")
        finished.forget()
    return table


def _write_table(folder: Path, rows: list[dict[str, Any]], strategies: Mapping[str, str]) -> pa.Table:
    """Write the table of the points so far; replaces the file atomically. strategies: as in `with_strategies`."""
    columns = dict.fromkeys(itertools.chain(*rows))  # pyarrow takes those of the first row
    table = with_strategies(pa.Table.from_pylist([{**columns, **rows[0]}, *rows[1:]]), strategies)
    with private_replacement(folder / "sweep.parquet") as unfinished:
        pq.write_table(table, unfinished)
    return table


def _draw(folder: Path, table: pa.Table, grid: Grid, applications: Iterable[str]) -> None:
    from evedrop.show.view.result_pictures import draw_sweep  # noqa: PLC0415 - matplotlib takes half a second

    draw_sweep(private_pictures(folder / "sweep"), table, tuple(grid))
    for name in applications:
        APPLICATIONS[name].draw_sweep(folder / name, table, next(iter(grid)))


def _summary(scenario: Scenario, plan: Plan, results: Iterator[BatchResult]) -> Summary | None:
    """The summary of a point; None if it was interrupted."""
    started = time.monotonic()
    merger = Merger.of(scenario, plan.mode, results)
    if not merger.complete:
        return None
    ending = RunOutcome(time.monotonic() - started)
    summary = merger.summary(ending)
    if summary.ended != ending.how:  # a metric failed
        raise RunError(summary.ended)
    return summary


def _checked(
    source: str | Path | Scenario, changes: Mapping[str, Any], grid: Grid, plan: Plan
) -> list[tuple[Point, Scenario]]:
    """Every point with its scenario.

    Raises UsageError for a repeated value, or a key whose values have no effect, ScenarioError with the mistakes of all points.
    """
    for earlier, later in itertools.combinations(grid, 2):
        if undoes(later, earlier):
            raise UsageError(f"{later} sets {earlier}, too, whose values would have no effect; vary one of them")
    others = {key: value for key, value in changes.items() if key not in grid}  # made before those of a point
    for key, values in grid.items():
        stored = Counter((_kind(value), _in_table(value)) for value in values)
        for (_, value), count in stored.items():
            if count > 1:
                raise UsageError(f"{key}: the value {value} is given {count} times; give each value once")
    points: list[Point] = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    checked_points: list[tuple[Point, Scenario]] = []
    mistakes: dict[str, None] = {}
    for point in points:
        try:
            scenario = prepared(source, {**others, **point}, beyond_horizon=plan.mode.value != "exact")
        except ScenarioError as error:
            mistakes.update(dict.fromkeys(error.mistakes))
            continue
        check_mode(scenario, plan.mode)
        checked_points.append((point, scenario))
    if mistakes:
        raise ScenarioError(_title(source), list(mistakes))
    return checked_points


def _kind(value: Any) -> type | None:
    """The type of a value's column in the table, float for all numbers; None for what the table has only as text."""
    if isinstance(value, int) and abs(value) > _LARGEST:
        return None
    return next((kind for kind, of in ((bool, bool), (float, (int, float)), (str, str)) if isinstance(value, of)), None)


def _in_table(value: Any) -> Any:
    """A value as it is in the table: a list or a table as JSON."""
    return json.dumps(value, default=str) if _kind(value) is None else value  # TOML has dates, too


def _stored(point: Point, grid: Grid) -> Point:
    """A point as it is in the table, where the values of an entry are of one kind: all of them text if they differ."""
    mixed = {key for key, values in grid.items() if len(set(map(_kind, values))) > 1}
    return {
        key: json.dumps(value, default=str) if key in mixed and not isinstance(value, str) else _in_table(value)
        for key, value in point.items()
    }


def _title(source: str | Path | Scenario) -> str:
    return source.title if isinstance(source, Scenario) else str(source)


def _true_times(filter_: FilterSummary, name: str) -> str | None:
    true = filter_.true_ratios.get(name)
    return None if true is None else times_text(true.ratio, true.interval)


def _rows(point: Point, scenario: Scenario, summary: Summary) -> Iterator[dict[str, Any]]:
    """A row for each peer: the point as it is stored, the metrics, the verdict."""
    for name, peer in summary.peers.items():
        secrecy = summary.secrecy.get(name)
        verdict = None if secrecy is None else secrecy.verdict
        yield {
            **point,
            "peer": name,
            "slots": scenario.slots,
            "trials": summary.trials,
            **{metric: peer.metric(metric) for metric in all_metrics()},
            **{error_column(name): peer.standard_errors.get(name) for name in estimated_metrics()},
            **{
                z_column(name): peer.z.get(name)
                for name, metric in all_metrics().items()
                if metric.expected is not None
            },
            **{f"error_quantile_{level}": value for level, value in (peer.error_quantiles or {}).items()},
            "infinite_variance": peer.infinite_variance,
            "rare_fraction": None if peer.rare_events is None else peer.rare_events.fraction,
            "rare_trials": None if peer.rare_events is None else peer.rare_events.trials,
            **{
                column: value
                for application, entry in summary.applications.items()
                for column, value in APPLICATIONS[application].sweep_columns(entry, name).items()
            },
            "ratio": None if secrecy is None else secrecy.ratio,
            "ratio_standard_error": None if secrecy is None else secrecy.ratio_standard_error,
            "ratio_from": None if secrecy is None else secrecy.ratio_from,
            "verdict": None if verdict is None else verdict.outcome,
            "times": None if verdict is None else verdict.times,
            **({} if summary.filter is None else {"true_times": _true_times(summary.filter, name)}),
            "digest": peer.digest,
        }

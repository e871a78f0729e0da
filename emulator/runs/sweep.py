"""Monte Carlo over a grid: any entries of the scenario, every combination of their values, one tidy table."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from emulator.errors import Interrupted, ScenarioError, UsageError
from emulator.runs.folder import new_folder
from emulator.runs.montecarlo import Merger, Plan, check_mode, results_of, teller
from emulator.runs.scorekeeper import Ending
from emulator.runs.signals import stop_on_signals
from emulator.runs.trials import tasks_of
from emulator.scenario import FIGURES, Scenario, load, value_of

Grid = Mapping[str, Sequence[Any]]
Point = Mapping[str, Any]

_MOST_POINTS = 10_000


def grid_of(texts: Sequence[str]) -> dict[str, list[Any]]:
    """The grid that `--over` options describe: KEY=first:last:step, both ends included, or KEY=a,b,c.

    Raises UsageError for anything else, an empty range, or more than 10 000 points.
    """
    grid: dict[str, list[Any]] = {}
    for text in texts:
        key, equals, values = text.partition("=")
        if not equals or not key or not values:
            raise UsageError(f"--over {text}: expected KEY=first:last:step or KEY=a,b,c, such as slots=100,200")
        if key in grid:
            raise UsageError(f"--over {text}: {key} is there twice; give all its values in one")
        grid[key] = _range(text, values) if ":" in values else [value_of(value) for value in values.split(",")]
    if math.prod(len(values) for values in grid.values()) > _MOST_POINTS:
        raise UsageError(f"--over asks for more than {_MOST_POINTS} points; take wider steps")
    return grid


def _range(text: str, values: str) -> list[float]:
    try:
        first, last, step = (float(value) for value in values.split(":"))
    except ValueError:
        raise UsageError(f"--over {text}: expected three numbers first:last:step, such as 0.1:0.9:0.1") from None
    count = math.floor((last - first) / step + 1e-9) + 1 if step else 0
    if not math.isfinite(first + last + step) or count < 1:
        raise UsageError(f"--over {text}: the range is empty; expected first:last:step with the step towards last")
    if count > _MOST_POINTS:
        raise UsageError(f"--over {text} asks for more than {_MOST_POINTS} values; take a wider step")
    # Decimal steps should give decimal values, 0.3 and not 0.30000000000000004.
    return [round(first + i * step, 12) for i in range(count)]


def sweep_over(
    source: str | Path,
    changes: Mapping[str, Any],
    grid: Grid,
    folder: Path,
    tell: Callable[[Mapping[str, Any]], None],
    plan: Plan,
) -> pa.Table:
    """Run every point of the grid into a folder: sweep.parquet, sweep.json and a plot. The table: a row a point and peer.

    Raises ScenarioError if any point is no scenario, before anything is run; Interrupted, with the points done so far.
    """
    scenarios = _checked(source, changes, grid, plan)
    workers = max(plan.workers_for(scenario) for _, scenario in scenarios)
    total = sum(scenario.trials * scenario.slots for _, scenario in scenarios)
    rows: list[dict[str, Any]] = []
    with stop_on_signals() as stop:
        each = -(-workers // len(scenarios))  # with more points than workers, a point need not be cut for them
        tasks = [(i, task) for i, (_, s) in enumerate(scenarios) for task in tasks_of(s, plan.mode, each)]
        results = results_of([task for _, task in tasks], workers, plan.scheduler, teller(tell, total), stop.is_set)
        new_folder(folder)
        mergers = [Merger(scenario, plan.mode) for _, scenario in scenarios]
        started = time.monotonic()
        for (i, _), result in zip(tasks, results, strict=False):
            mergers[i].add(result)
            if mergers[i].complete:
                point, scenario = scenarios[i]
                summary = mergers[i].summary(Ending(time.monotonic() - started))
                rows += _rows(point, scenario, summary)
        complete = all(merger.complete for merger in mergers)
    if not rows:
        raise Interrupted("interrupted before a point was done; nothing was kept")
    table = pa.Table.from_pylist(rows)
    pq.write_table(table, folder / "sweep.parquet")
    description = {"scenario": str(source), "changes": dict(changes), "over": dict(grid), "mode": plan.mode.value}
    (folder / "sweep.json").write_text(json.dumps(description, indent=1, ensure_ascii=False) + "\n")
    from emulator.view.sweeps import draw  # noqa: PLC0415 - matplotlib takes half a second

    draw(folder / "sweep", table, tuple(grid))
    if not complete:
        raise Interrupted(f"interrupted; the points done so far are in {folder}")
    return table


def _checked(source: str | Path, changes: Mapping[str, Any], grid: Grid, plan: Plan) -> list[tuple[Point, Scenario]]:
    """Every point's scenario; all mistakes of all points at once."""
    points: list[Point] = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    found: list[tuple[Point, Scenario]] = []
    mistakes: dict[str, None] = {}
    for point in points:
        try:
            scenario = load(source, {**changes, **point}, beyond_horizon=plan.mode.value != "exact")
        except ScenarioError as error:
            mistakes.update(dict.fromkeys(error.mistakes))
            continue
        check_mode(scenario, plan.mode)
        found.append((point, scenario))
    if mistakes:
        raise ScenarioError(str(source), list(mistakes))
    return found


def _rows(point: Point, scenario: Scenario, summary: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """A row for each peer: the point, the figures, the verdict."""
    for name, peer in summary["peers"].items():
        verdict = summary["secrecy"].get(name, {})
        yield {
            **{key: json.dumps(value) if isinstance(value, (list, dict)) else value for key, value in point.items()},
            "peer": name,
            "slots": scenario.slots,
            "trials": summary["trials"],
            **{figure: peer[figure] for figure in FIGURES},
            "mean_actual_trace_covariance": peer.get("mean_actual_trace_covariance"),
            **{f"error_quantile_{level}": value for level, value in (peer["error_quantiles"] or {}).items()},
            "infinite_variance": peer["infinite_variance"],
            "relative_secrecy": verdict.get("relative"),
            "perfect_secrecy": verdict.get("perfect"),
            "digest": peer["digest"],
        }

"""What is made of finished results: `evedrop report`, `export` and `diff`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import command, number_type, option, together
from evedrop.counting import counted
from evedrop.errors import UsageError

if TYPE_CHECKING:
    from evedrop.cli.api.results import ComparisonResults, RunResults, SweepResults


@command((option("run", "FOLDER", type=Path),), section="inspect", example="report runs/vehicle", page="export")
def report(options: argparse.Namespace) -> int:
    """Write report.html: a run, sweep, comparison or wire on one page."""
    from evedrop.results.wire_summary import is_wire
    from evedrop.show.report.writing import write_report

    write = write_report
    if is_wire(options.run):  # its summary may have to be made from its journal
        from evedrop.wire.on_disk import write_wire_report as write
    try:
        print(write(options.run))
    except OSError as error:
        raise UsageError(
            f"{options.run}: report.html cannot be written ({error.strerror}); make the folder writable"
        ) from error
    return 0


_LONGEST = 3600.0  # seconds per slot, as for pace


_WRITTEN = together(
    option("file", "FILE", ".mcap, .pdf, .png, .svg, .csv or .tex", type=Path),
    option(
        "--width",
        help_text="of the picture of a run; column: that of a journal",
        choices=("page", "column"),
        default="page",
    ),
    option("--panel", help_text="draw only one part of the picture of a run", choices=("errors", "lanes", "plane")),
    option(
        "--period",
        "SECONDS",
        "seconds per slot; default those of the scenario, or 1",
        type=number_type(math.ulp(0.0), _LONGEST, f"a number of seconds above 0 and up to {_LONGEST:.0f}"),
    ),
)


@command(
    (option("run", "FOLDER", type=Path), _WRITTEN),
    section="inspect",
    example="export runs/vehicle vehicle.mcap",
    page="export",
)
def export(options: argparse.Namespace) -> int:
    """Write a run as MCAP, a wire's journal as CSV, or any study's picture or tables."""
    from evedrop.scenario.words import listed

    kind = options.file.suffix.lower()
    for name, is_given in (("--panel", options.panel is not None), ("--width", options.width != "page")):
        if is_given and kind not in _PICTURES:
            raise UsageError(f"{name} is for pictures, whose files end in {', '.join(_PICTURES)}; leave it out")
    if kind not in {_MCAP, *_PICTURES, *_TABLES}:
        raise UsageError(f"{options.file}: expected a file that ends in {listed([_MCAP, *_PICTURES, *_TABLES])}")
    if options.period is not None and kind != _MCAP:
        raise UsageError(f"--period is for MCAP files, which end in {_MCAP}; leave it out")
    if kind in {*_PICTURES, *_TABLES}:
        return _export_study(options, kind)
    from evedrop.results.mcap_export import export_mcap
    from evedrop.results.reading import Results
    from evedrop.results.wire_summary import is_wire
    from evedrop.system.signals import raise_on_signals

    if is_wire(options.run):
        raise UsageError(f"{options.run} is the folder of a wire; give the results folder of a run")
    results = Results.read(options.run)
    with raise_on_signals():
        counts = export_mcap(results, options.file, options.period)
    if results.remark is not None:
        print(results.remark)
    print(f"{options.file}: {counted(sum(counts.values()), 'message')} on {counted(len(counts), 'topic')}")
    return 0


_MCAP, _PICTURES, _TABLES = ".mcap", (".pdf", ".png", ".svg"), (".csv", ".tex")
_DOTS_PER_INCH = 300


def _export_study(options: argparse.Namespace, kind: str) -> int:
    from evedrop.cli.api.results import RunResults, study_in
    from evedrop.results.wire_summary import is_wire

    if is_wire(options.run):
        return _export_wire(options, kind)
    study = study_in(options.run)
    if kind in _TABLES:
        files = study.to_csv(options.file) if kind == ".csv" else [study.to_latex(options.file)]
        print("\n".join(map(str, files)))
        _print_remark(study)
        return 0
    if isinstance(study, RunResults):
        panels = ("errors",) if study.typed_summary.mode in {"covariance-only", "error-coordinates"} else ()
        picture = study.plot(*(panels if options.panel is None else (options.panel,)), width=options.width)
    elif options.panel is not None:
        raise UsageError(f"--panel {options.panel} is for the picture of a run; {options.run} is another study")
    elif options.width != "page":
        raise UsageError(f"--width {options.width} is for the picture of a run; {options.run} is another study")
    else:
        picture = study.plot()
    try:
        picture.savefig(options.file, dpi=_DOTS_PER_INCH)
    except OSError as error:
        raise UsageError(f"{options.file} cannot be written ({error.strerror}); give another file") from error
    print(options.file)
    _print_remark(study)
    return 0


def _print_remark(study: RunResults | SweepResults | ComparisonResults) -> None:
    """Say that a study has not ended, or was interrupted: what was exported is a part of it."""
    from evedrop.cli.api.results import ComparisonResults, RunResults
    from evedrop.show.report.comparison import schemes_done
    from evedrop.show.report.sweep_sections import SweepSource

    if isinstance(study, RunResults):
        remark = study.remark
    else:
        done = schemes_done(study) if isinstance(study, ComparisonResults) else SweepSource.read(study.folder).lacking
        remark = f"{study.folder}: {done}" if done else None
    if remark is not None:
        print(remark)


def _export_wire(options: argparse.Namespace, kind: str) -> int:
    """Write the journal of a wire as CSV."""
    if kind != ".csv":
        use = (
            f"its report has its pictures: evedrop report {options.run}"
            if kind in _PICTURES
            else f"its table is written by: evedrop view {options.run} --table --latex {options.file}"
        )
        raise UsageError(f"{options.run} is the folder of a wire; {use}")
    from evedrop.wire.journal_csv import write_journal_csv

    rows = write_journal_csv(options.run, options.file)
    print(f"{options.file}: {counted(rows, 'message')}")
    return 0


_TWO_RUNS = option("runs", "RUN", nargs=2, type=Path)


@command((_TWO_RUNS,), section="inspect", example="diff runs/one runs/other", page="results")
def diff(options: argparse.Namespace) -> int:
    """Show the first difference between two runs."""
    from evedrop.results.diff import difference
    from evedrop.results.reading import Results

    runs = [Results.read(run) for run in options.runs]
    differences = difference(*runs)
    print(differences.text)
    for remark in filter(None, (run.remark for run in runs)):
        print(remark)
    return 0 if differences.same else 1


COMMANDS = (report, export, diff)

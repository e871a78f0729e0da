"""The results of calls, read from their folder: typed entries, a short text when printed, and tables in a notebook."""

from __future__ import annotations

import math
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, Self

import pyarrow as pa

from evedrop.cli.api.notebook import OpenView, table_text
from evedrop.cli.words import WIDTH, in_python
from evedrop.counting import counted
from evedrop.model.metrics import shown_metric
from evedrop.model.metrics.text import number_text
from evedrop.results.comparison import COMPARISON, Comparison, read_comparison
from evedrop.results.reading import ByName, Results
from evedrop.score.summary import FilterSummary, Judged, LinkSummary, PeerSummary, SecrecySummary, Summary
from evedrop.score.verdict import Verdict
from evedrop.show.report import closing
from evedrop.show.report.closing import sweep_table
from evedrop.show.report.comparison import comparison_heading, conclusion, left_out_schemes, pairs_table, schemes_table
from evedrop.show.report.text_table import TextTable
from evedrop.show.report.verdict_matrix import matrix_lines
from evedrop.system.output import wrapped

if TYPE_CHECKING:
    from evedrop.show.view.shown_figure import ShownFigure

Panels = Literal["errors", "lanes", "plane"]
Width = Literal["page", "column"]
_MOST_ROWS = 40  # of a table in a notebook


class _InFolder(Protocol):
    @property
    def folder(self) -> Path: ...


class ReportedResults(ABC):
    """Results in a folder, which can be shown on one page and whose tables can be written for other programs."""

    def to_csv(self, path: str | Path) -> list[Path]:
        """Write the tables that the command prints as CSV, with every number at full precision, and return the files' paths.

        The first table goes to `path`, a second one to NAME-2.csv. Source: docs/export.md, tables.

        Raises UsageError if a file cannot be written.
        """
        from evedrop.show.report.text_table import write_csv  # no other method needs it

        return write_csv(self._tables(), Path(path))

    def to_latex(self, path: str | Path) -> Path:
        """Write the tables that the command prints as LaTeX, and return the file's path; it needs no package.

        Raises UsageError if the file cannot be written.
        """
        from evedrop.show.report.text_table import write_latex  # no other method needs it

        return write_latex(self._tables(), Path(path))

    @abstractmethod
    def _tables(self) -> list[TextTable]:
        """The tables that the command prints."""

    def report(self: _InFolder) -> Path:
        """Write report.html into the folder, and return its path. Source: docs/export.md, report.html.

        Raises UsageError if the results cannot be read, and OSError if the page cannot be written.
        """
        from evedrop.show.report.writing import write_report  # no other method needs it

        return write_report(self.folder)


@dataclass(frozen=True, repr=False)
class RunResults(Results, ReportedResults):
    """The results of a run or of trials in memory: typed metrics, and tables as Arrow.

    Results in a temporary folder are removed with this object, or when the program ends.
    """

    @cached_property
    def _typed(self) -> Summary:
        return self.typed_summary

    @cached_property
    def peers(self) -> Mapping[str, PeerSummary]:
        """Receiver → its metrics, the legitimate estimator first."""
        return ByName("receiver", self._typed.peers)

    @cached_property
    def links(self) -> Mapping[str, LinkSummary]:
        """Receiver → the account of its link."""
        return ByName("link", self._typed.links)

    @cached_property
    def secrecy(self) -> Mapping[str, SecrecySummary]:
        """Eavesdropper → the verdict."""
        found = {name: replace(kept, sentence=in_python(kept.sentence)) for name, kept in self._typed.secrecy.items()}
        return ByName("verdict on", found)

    @property
    def verdict(self) -> Verdict | None:
        """Whether the state is kept secret from all eavesdroppers, as every report says it; None without any."""
        return self._typed.verdict

    @property
    def filter(self) -> FilterSummary | None:
        """Errors against the true state, for a sensor that measures; None for one that knows the state."""
        return self._typed.filter

    @property
    def expectations(self) -> list[Judged]:
        """The expectations of the scenario, and whether each held."""
        return list(self._typed.expectations)

    @property
    def _facts(self) -> str:
        summary = self._typed
        mode = "live" if summary.mode == "live" else f"in memory ({summary.mode})"
        return f"{counted(summary.slots, 'slot')}, {counted(summary.trials, 'trial')}, {mode}"

    def _notes(self) -> Iterator[str]:
        if self.remark is not None:
            yield self.remark
        yield from (line for _, line in closing.verdict_lines(self._typed))
        for lines in (closing.remarks, closing.details, closing.doubts, closing.application_lines):
            yield from map(in_python, lines(self._typed))
        yield from (expectation.sentence for expectation in self.expectations)

    def plot(
        self, *panels: Panels, slots: range | None = None, trial: int | None = None, width: Width = "page"
    ) -> ShownFigure:
        """A figure: the errors of all trials with bands, and the lanes and the plane of one recorded trial.

        panels: some of `errors`, `lanes` and `plane`, by default all; slots: those shown, by default all errors and at most the
        last 300 slots of lanes and plane; trial: by default the first recorded one; width: "column" for a column of a journal,
        with serif letters of 8 points, names beside the curves, and without a title. The figure is one of matplotlib:
        `savefig` writes it to a file. Source: docs/python.md.

        Raises UsageError if there is no such panel, slot or recorded trial.
        """
        from evedrop.show.view.result_pictures import run_figure  # matplotlib takes half a second

        return run_figure(self, panels, slots, trial, width)

    def view(self) -> OpenView:
        """The view of the run: in a notebook in the cell, elsewhere an address for a browser. Source: docs/view.md.

        Raises UsageError if the results cannot be read, or have no recorded trial.
        """
        from evedrop.show.view.scene_slots import replay  # Rerun takes a third of a second

        recording = self.folder / "recording.rrd"
        if self.remark is None and recording.is_file():
            return OpenView.of(self.folder, recording)
        with tempfile.TemporaryDirectory(prefix="evedrop-view-") as temporary:
            return OpenView.of(self.folder, replay(self.folder, Path(temporary) / "recording.rrd"))

    def __repr__(self) -> str:
        error = ("mean_squared_error", "mean_actual_trace_covariance")
        errors = [
            f"{name} {number_text(shown_metric(peer.all_metrics, error), '.3g')}" for name, peer in self.peers.items()
        ]
        remark = "" if self.remark is None else "; incomplete"
        facts = f"RunResults of {self._typed.scenario!r}: {self._facts}; mean error: {', '.join(errors)}{remark}"
        return _in_lines([facts] if self.verdict is None else [self.verdict.sentence, facts])

    def _tables(self) -> list[TextTable]:
        directions = self._typed.directions
        return [
            closing.receivers_table(self._typed, judged=True),
            *([closing.directions_table(directions)] if directions else []),
        ]

    def _repr_html_(self) -> str:
        title = f"{self._typed.scenario} · {self._facts}"
        verdict = "" if self.verdict is None else self.verdict.sentence
        return table_text(title, closing.receivers_table(self._typed), self._notes(), verdict)


@dataclass(frozen=True, repr=False)
class SweepResults(ReportedResults):
    """The results of a sweep: `table` has a row for each point and receiver, with every metric and its standard error."""

    folder: Path
    table: pa.Table
    keys: tuple[str, ...]
    """The entries that were swept, by dotted key."""

    @property
    def points(self) -> int:
        """The number of combinations of values."""
        return len({tuple(row[key] for key in self.keys) for row in self.table.to_pylist()})

    def plot(self) -> ShownFigure:
        """A figure of matplotlib: each receiver's error against the first entry, with a panel for each value of the others."""
        from evedrop.show.view.result_pictures import sweep_figure  # matplotlib takes half a second

        return sweep_figure(self.table, self.keys)

    def __repr__(self) -> str:
        return "\n".join([f"SweepResults over {self._facts}", *_drawn(self._shown), *self._more])

    @property
    def _facts(self) -> str:
        return f"{', '.join(self.keys)}: {counted(self.points, 'point')}"

    def _tables(self) -> list[TextTable]:
        return [sweep_table(self.table.to_pylist(), self.keys)]

    def _repr_html_(self) -> str:
        return table_text(f"Sweep over {self._facts}", self._shown, self._more)

    @property
    def _shown(self) -> TextTable:
        return sweep_table(self.table.slice(0, _MOST_ROWS).to_pylist(), self.keys)

    @property
    def _more(self) -> list[str]:
        more = self.table.num_rows - _MOST_ROWS
        return [f"and {counted(more, 'more row')}: .table has all of them"] if more > 0 else []


@dataclass(frozen=True, repr=False)
class ComparisonResults(Comparison, ReportedResults):
    """The results of a comparison, and their folder."""

    folder: Path = field(kw_only=True)

    @classmethod
    def of(cls, comparison: Comparison, folder: Path) -> Self:
        """A comparison whose files are in a folder."""
        return cls(**{field.name: getattr(comparison, field.name) for field in fields(comparison)}, folder=folder)

    def plot(self) -> ShownFigure:
        """A figure of matplotlib: the matrix of schemes and adversaries, with a mark, a colour and a ratio in every cell."""
        from evedrop.show.view.result_pictures import comparison_figure  # matplotlib takes half a second

        return comparison_figure(self)

    def __repr__(self) -> str:
        return _in_lines([comparison_heading(self), *matrix_lines(self, WIDTH), conclusion(self)])

    def _tables(self) -> list[TextTable]:
        return [schemes_table(self), pairs_table(self)]

    def _repr_html_(self) -> str:
        from evedrop.show.report.comparison_sections import verdicts_matrix  # templates, which no other method needs
        from evedrop.show.report.page import made, printable  # the same

        numbers = ["largest legitimate error", "error of the closest adversary"]
        table = TextTable.headed(["scheme"], numbers, ["beaten by another scheme"])
        for scheme in self.schemes.values():
            price, protection = (None if math.isnan(error) else error for error in (scheme.price, scheme.protection))
            beaten = {True: "yes", False: "no", None: "–"}[self.is_beaten(scheme)]
            table.add(scheme.name, number_text(price, ".3g"), number_text(protection, ".3g"), beaten)
        lines = [conclusion(self), *left_out_schemes(self)]
        return printable(
            made(
                "block",
                made("heading", comparison_heading(self)),
                verdicts_matrix(self, glyphs=True),
                made("sentences", lines),
                made("table", table, "Price and protection of each scheme"),
            )
        )


def _in_lines(paragraphs: Iterable[str]) -> str:
    """Paragraphs, in lines of 100 characters."""
    return "\n".join(wrapped(paragraph, WIDTH) for paragraph in paragraphs)


def _drawn(table: TextTable) -> list[str]:
    """The lines of a table, which leaves out what does not fit into 100 characters, as the terminal does."""
    from evedrop.cli.report import printed  # a live run does not need Rich

    return printed(lambda console: console.show(table), WIDTH).splitlines()


def load_results(folder: str | Path) -> RunResults:
    """Read a results folder, including that of a run in progress or killed: `ended` in its summary says so.

    Raises UsageError naming the missing or broken file if it is not a results folder.
    """
    return RunResults.read(folder)


def study_in(folder: Path) -> RunResults | SweepResults | ComparisonResults:
    """The results in the folder of a run, a sweep or a comparison. Raises UsageError if they cannot be read."""
    if (folder / COMPARISON).exists():
        return ComparisonResults.of(read_comparison(folder), folder)
    if (folder / "sweep.json").exists():
        from evedrop.show.report.sweep_sections import SweepSource  # templates, which no other results need

        source = SweepSource.read(folder)
        return SweepResults(folder, source.table, tuple(source.grid))
    return load_results(folder)

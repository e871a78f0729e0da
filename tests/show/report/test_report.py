"""The report on one page: complete, safe, without requests, with the sentences of the terminal; the results stay unchanged."""

from __future__ import annotations

import base64
import json
import math
import re
import shutil
import stat
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from evedrop import montecarlo, sweep
from evedrop.errors import UsageError
from evedrop.model.metrics.text import ShownNumber, estimate, number_text, percent_text, short_text
from evedrop.results.reading import Results
from evedrop.score.synchronisation import LongestSpans, LostSpan, Synchronisation, lost_spans, synchronisation_of
from evedrop.show.report import closing
from evedrop.show.report.chart import Curve, GroupCounts, GroupMeans, LogChart
from evedrop.show.report.page import Page, Part, made
from evedrop.show.report.run_sections import (
    OUTCOMES,
    PIXELS,
    RUN_SECTIONS,
    RecordedTrial,
    RowExtent,
    RunSource,
    lane_picture,
)
from evedrop.show.report.sweep_sections import sweep_outcome
from evedrop.show.report.text_table import TextTable, aligned, far
from evedrop.show.report.writing import REPORT, try_report, write_report
from evedrop.show.view.axis_name import as_mathematics, axis_name
from evedrop.show.view.error_floor import mean_band
from evedrop.show.view.label_places import label_places
from evedrop.show.view.lanes import Lane
from evedrop.show.view.result_pictures import sweep_figure
from evedrop.simulate.montecarlo import Plan
from evedrop.simulate.simulation import Mode
from tests.conftest import LIMIT, Evedrop
from tests.examples import examples
from tests.pages import Checked, checked, downloads

HOSTILE = "<script>alert('&amp;')</script>\"></title>"
"""A title that tries to inject code into the page."""
QUICK: dict[str, Any] = {"slots": 60, "plan": Plan(workers=1)}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study with a hostile title, in which one expectation fails."""
    expect = [
        {"metric": "legitimate.received_fraction", "above": 0.5},
        {"metric": "smart.received_fraction", "above": 2},
    ]
    folder = tmp_path_factory.mktemp("report") / "study"
    montecarlo("eavesdroppers", trials=20, out=folder, title=HOSTILE, expect=expect, **QUICK)
    write_report(folder)
    return folder


def test_a_page_says_what_the_terminal_says_and_does_nothing_else(study: Path) -> None:
    """Outcome and verdicts first, every cell of the table, links, spans, the command that repeats it; the title is only text."""
    page, summary = checked(study), Results.read(study).typed_summary
    text = "".join(page.texts)
    assert page.headings == [
        HOSTILE,
        "Verdicts", "Expectations", "Metrics", "Errors", "Lost synchronisation", "Links", "Repeat it",
    ]  # fmt: skip
    assert summary.verdict is not None
    assert f"{summary.verdict.sentence}. 1 of 2 expectations FAILED" in page.texts
    cells = [cell for row in aligned(closing.receivers_table(summary)).rows for cell in row]
    assert Counter(cells) <= Counter(page.texts)
    for line in (*closing.details(summary), *(expectation.sentence for expectation in summary.expectations)):
        assert line in page.texts
    for name, link in summary.links.items():
        assert {name, f"{link.offered:,}", f"{link.rate:.4f}", f"{link.expected_rate:.4f}"} <= set(page.texts)
    assert "evedrop montecarlo scenario.toml --trials 20 --out again" in text
    assert str(study) not in text
    assert {"date", "machine", "operating system", "python", "numpy", "evedrop"} <= set(page.texts)
    assert {str(summary.seed), summary.peers["smart"].digest} <= set(page.texts)
    assert page.tags["svg"] == 1
    assert page.tags["img"] == 8
    assert (study / REPORT).stat().st_size < 300_000
    assert stat.S_IMODE((study / REPORT).stat().st_mode) == 0o600


def test_the_chart_of_a_covariance_only_study_shows_traces(tmp_path: Path) -> None:
    """It has no estimates, so no errors."""
    plan = Plan(Mode.COVARIANCE_ONLY, workers=1)
    results = montecarlo("eavesdroppers", slots=8, trials=4, expect=[], plan=plan, out=tmp_path / "out")
    texts = checked(results.report().parent).texts
    assert any(text.startswith("Mean trace of the actual covariance over 4 trials; ") for text in texts)
    assert not any("squared error over" in text for text in texts)


def test_a_small_z_gives_the_others_no_exponent() -> None:
    """It is a number between about −4 and 4."""
    scores = TextTable.headed(["receiver"], ["z"])
    for z in (1.2, 0.0004):
        scores.add("a", number_text(z, "+.1f"))
    assert [row[1] for row in aligned(scores).rows] == ["+1.2", "+0.0"]


def test_a_picture_whose_bytes_spell_an_address_is_no_request(study: Path, tmp_path: Path) -> None:
    """The bytes of a wire's pictures differ from run to run; an address elsewhere on the page is a request."""
    page = (study / REPORT).read_text()
    picture = re.search(r"(?<=data:image/png;base64,)[^\"]+", page)
    assert picture
    (tmp_path / REPORT).write_text(page.replace(picture[0], "AA//aaAA"))
    checked(tmp_path)
    (tmp_path / REPORT).write_text(page.replace("</body>", "<p>//elsewhere</p></body>"))
    with pytest.raises(AssertionError):
        checked(tmp_path)


def test_the_numbers_of_a_column_have_the_same_format() -> None:
    """All with an exponent if one is very small or large; 0, dashes, bounds, units and counts are as they were."""
    table = TextTable.headed(["receiver"], ["error", "theory", "fraction", "count"])
    table.add("a", estimate(1.325e-4, 5e-7), number_text(0.0001333), number_text(0.5), number_text(7))
    table.add("b", estimate(30223.0, 3908.0) + " Wh", number_text(48.48), number_text(0.25), number_text(1_000_000))
    table.add("c", number_text(None), ShownNumber("≥ 6.2", 6.2, after="at least"), number_text(0.0), number_text(0))
    table.add("d", estimate(math.inf, 1.0), number_text(0.0), estimate(0.25, 1e-20), number_text(None))
    assert [row[1:] for row in aligned(table).rows] == [
        ("1.325e-4 ± 5e-7", "1.333e-4", "0.5", "7"),
        ("3.0e4 ± 4e3 Wh", "4.848e1", "0.25", "1e+06"),
        ("–", "≥ 6.2", "0", "0"),
        ("inf", "0", "0.25", "–"),
    ]
    assert aligned(TextTable.headed(["a"], ["b"])).rows == []
    assert number_text(-0.01, "+.1f") == "+0.0"
    assert number_text(-0.06, "+.1f") == "-0.1"
    assert [short_text(value) for value in (None, math.inf, 0.0123, 57.1, 123.4, 3.42e5)] == [
        *("–", "∞", "0.012", "57", "123", "3.4e5"),
    ]  # fmt: skip
    assert [short_text(value) for value in (0.0, 0.00999, 99.4, 99.7, 9999.7)] == ["0", "0.01", "99", "100", "1.0e4"]
    assert estimate(-0.001, 0.2) == "0.0 ± 0.2"


def test_a_percentage_is_nothing_or_everything_only_if_it_is() -> None:
    """One slot of a hundred thousand without synchronisation is not none."""
    fractions = (0.0, 1e-5, 0.0006, 0.5, 0.9994, 0.99999, 1.0)
    texts = ["0.0%", "less than 0.1%", "0.1%", "50.0%", "99.9%", "more than 99.9%", "100.0%"]
    assert [percent_text(fraction) for fraction in fractions] == texts


def test_a_z_beyond_four_is_marked() -> None:
    """In columns of z-scores only; the caption says what the mark means."""
    table = TextTable.headed(["receiver"], ["error", "z"])
    for z in (-48.5, 4.0, 4.1, None):
        table.add("one", number_text(z), number_text(z, "+.1f"))
    assert far(table) == {(0, 2), (2, 2)}
    page = Checked(made("table", table, "caption"))
    assert page.values("class").count("number far") == 2
    assert any("▲: beyond 4" in text for text in page.texts)
    table.rows = table.rows[3:]
    assert "caption" in Checked(made("table", table, "caption")).texts


def test_whoever_receives_a_page_can_repeat_its_run(study: Path, tmp_path: Path) -> None:
    """With nothing but the page: its scenario, and its command, give the digests that it names."""
    page = checked(study)
    (tmp_path / "scenario.toml").write_text(downloads(page)["scenario.toml"])
    again = montecarlo(tmp_path / "scenario.toml", trials=20, plan=Plan(workers=1))
    digests = [str(peer.digest) for peer in again.peers.values()]
    assert len(digests) == 4
    assert set(digests) <= set(page.texts)


def test_a_page_names_what_does_not_travel_with_it(study: Path, tmp_path: Path) -> None:
    """A secret in a file, and states that are too large; a run without a scenario cannot be repeated."""
    shutil.copytree(study, tmp_path / "run")
    scenario = tmp_path / "run" / "scenario.toml"
    scenario.write_text(f'secret_file = "/elsewhere/secret"\n{scenario.read_text()}')
    (tmp_path / "run" / "states.csv").write_text("0\n" * 2**20)
    (tmp_path / "run" / "disturbances.csv").write_text("0\n")
    write_report(tmp_path / "run")
    page = checked(tmp_path / "run")
    assert any("secret is in a file" in text for text in page.texts)
    assert any("states.csv, which is too large" in text for text in page.texts)
    assert downloads(page).keys() == {"scenario.toml", "disturbances.csv"}
    scenario.unlink()
    write_report(tmp_path / "run")
    texts = checked(tmp_path / "run").texts
    assert any("cannot be repeated" in text for text in texts)
    assert any("tr Q, the noise of one step, is 0 or unknown" in text for text in texts)
    assert not any("Fractions of the slots, and spans" in text for text in texts)


def test_a_part_of_a_run_is_not_promised_again(study: Path, tmp_path: Path) -> None:
    """The command runs all of it; one that estimated rare events does so again."""
    shutil.copytree(study, tmp_path / "run")
    summary = json.loads((study / "summary.json").read_text())
    summary |= {"ended": "interrupted", "trials": 12}
    rare: dict[str, Any] = {
        "mean_error": 1.0,
        "standard_error": 0.1,
        "z": None,
        "populations": 8,
        "trials": 20,
        "splits": 3,
    }
    rare |= {"counting": 0.5, "doubt": None, "slots": {}}
    entries = [*summary["peers"]["legitimate"].items()]
    entries.insert([name for name, _ in entries].index("digest"), ("rare_estimate", rare))
    summary["peers"]["legitimate"] = dict(entries)
    (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    write_report(tmp_path / "run")
    texts = checked(tmp_path / "run").texts
    assert any("the whole run; this one ended early" in text for text in texts)
    assert any("--trials 20 --rare --out again" in text for text in texts)
    texts = checked(study).texts
    assert any("the same results to the same bits" in text for text in texts)
    assert any("--trials 20 --out again" in text for text in texts)


def test_a_report_that_cannot_be_written_leaves_everything_as_it_was(
    study: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The older page and all results stay; a warning says so, and no partial file is left."""

    def contents() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in study.iterdir()}

    before = contents()

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("evedrop.results.folder.os.replace", full)
    assert try_report(study) is None
    assert "report.html was not written ([Errno 28] No space left on device)" in capsys.readouterr().err
    assert contents() == before
    monkeypatch.undo()
    assert try_report(study) == study / REPORT
    assert contents() == before


def test_a_folder_of_another_version_has_the_parts_that_can_be_read(study: Path, tmp_path: Path) -> None:
    """A table without a column is named in its part; a folder that is not a results folder gives only a warning."""
    for name in ("summary.json", "scenario.toml", "trials.parquet"):
        (tmp_path / name).write_bytes((study / name).read_bytes())
    pq.write_table(pq.read_table(study / "slots.parquet").drop_columns(["standard_error"]), tmp_path / "slots.parquet")
    write_report(tmp_path)
    page = checked(tmp_path)
    assert any("slots.parquet cannot be read" in text and "standard_error" in text for text in page.texts)
    assert {"Lost synchronisation", "Links", "Repeat it"} <= set(page.headings)


def test_a_page_has_cautions_events_and_outages_and_does_not_depend_on_the_order_of_rows(
    study: Path, tmp_path: Path
) -> None:
    """A mean that rare events carry is doubted; an event and an outage have a row each; a failure has its command."""
    summary = json.loads((study / "summary.json").read_text())
    summary["peers"]["smart"]["rare_events"] = {"fraction": 0.5, "trials": 1e6}
    summary["events"] = [{"slot": 1234, "event": "the link of smart is cut", "by": "scenario"}]
    summary["outages"] = [{"process": "smart", "slot": 7, "until": None, "seconds": 1.0, "shard": None}]
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "scenario.toml").write_bytes((study / "scenario.toml").read_bytes())
    for name in ("slots.parquet", "trials.parquet"):
        table = pq.read_table(study / name)
        pq.write_table(table.take(np.random.default_rng(0).permutation(table.num_rows)), tmp_path / name)
    write_report(tmp_path)
    page, before = checked(tmp_path), checked(study)
    doubts = list(closing.doubts(Results.read(tmp_path).typed_summary))
    assert any("smart: 50 % of its expected error" in line for line in doubts)
    assert set(doubts) <= set(page.texts)
    assert {"1,234", "the link of smart is cut", "smart cut off from the network, the run did not continue"} <= set(
        page.texts
    )
    (failed,) = (expectation for expectation in Results.read(study).typed_summary.expectations if not expectation.held)
    assert before.texts[before.texts.index(failed.sentence) + 1] == "see it again"
    for name in ("d", "src"):  # the curves and the lanes
        assert page.values(name) == before.values(name)


def lengthened(study: Path, folder: Path, times: int) -> None:
    """A run with the slots of a study, so many times one after the other."""
    folder.mkdir()
    summary = json.loads((study / "summary.json").read_text())
    once = summary["slots"]
    (folder / "summary.json").write_text(json.dumps({**summary, "slots": once * times}))
    (folder / "scenario.toml").write_bytes((study / "scenario.toml").read_bytes())
    for name in ("slots", "trials"):
        table = pq.read_table(study / f"{name}.parquet")
        place = table.column_names.index("slot")
        with pq.ParquetWriter(folder / f"{name}.parquet", table.schema) as writer:
            for first in range(0, times, 100):
                shifts = np.repeat(once * np.arange(first, min(times, first + 100)), table.num_rows)
                part = pa.concat_tables([table] * (len(shifts) // table.num_rows))
                slots = part["slot"].to_numpy() + shifts
                writer.write_table(
                    part.set_column(place, table.schema.field(place), pa.array(slots, part["slot"].type))
                )


def peak_of_report(folder: Path) -> int:
    """The largest resident memory of a process that makes a report, in bytes.

    Not from getrusage: there a program has at least the memory of the process that started it.
    """
    code = (
        "import sys; from pathlib import Path; from evedrop.show.report.writing import write_report; "
        "write_report(Path(sys.argv[1])); print(Path('/proc/self/status').read_text())"
    )
    command = [sys.executable, "-c", code, str(folder)]
    status = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT).stdout
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the largest memory of a program alone")
def test_the_report_of_a_run_in_progress_leaves_out_rows_that_come_meanwhile(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table is read twice, to count its rows and for what is in them; the second time it has twice as many slots."""
    read_pieces, reads = Results.pieces, Counter[str]()

    def growing(self: Results, name: str, *arguments: Any) -> Iterator[pa.Table]:
        reads[name] += 1
        for piece in read_pieces(self, name, *arguments):
            yield piece.filter(pc.field("slot") < 30 * reads[name])

    monkeypatch.setattr(Results, "pieces", growing)
    source = RunSource.read(study)
    assert {(*mean.slot.tolist(),) for mean in source.means.values()} == {(*map(float, range(30)),)}
    assert {(recorded.last, recorded.outcome.taken) for recorded in source.trial.values()} == {(29, 30)}
    assert reads == {"slots": 2, "trials": 2}


def test_the_memory_of_a_report_does_not_grow_with_the_slots(study: Path, tmp_path: Path) -> None:
    """It used to read whole tables, 0.7 kB a slot, and later to keep what it had read of them, some 45 bytes a slot."""
    peaks = []
    for times in (200, 1850):
        lengthened(study, tmp_path / str(times), times)
        peaks.append(peak_of_report(tmp_path / str(times)))
    assert peaks[1] < 250e6
    assert peaks[1] - peaks[0] < 40e6


def test_a_slot_without_a_packet_is_silent_in_its_lane(study: Path, tmp_path: Path) -> None:
    """For every action of the receiver: nothing was sent."""
    for name in ("summary.json", "scenario.toml"):
        (tmp_path / name).write_bytes((study / name).read_bytes())
    table = pq.read_table(study / "trials.parquet")
    column = pc.if_else(pc.less(table["slot"], 3), "nothing", table["sent"].cast(pa.string()))
    pq.write_table(table.set_column(table.column_names.index("sent"), "sent", column), tmp_path / "trials.parquet")
    outcome = RunSource.read(tmp_path).trial["smart"].outcome.commonest
    assert [OUTCOMES[code] == "silent" for code in outcome[:6]] == [True] * 3 + [False] * 3


def test_the_longest_spans_are_listed_in_the_order_of_time() -> None:
    """Of many spans without synchronisation those that say most."""
    spans = [LostSpan(100 * i, 100 * i + length, 0) for i, length in enumerate([5, 1, *range(10, 21)])]
    errors = np.zeros(1400)
    for span in spans:
        errors[span.first : span.last + 1] = 100.0
    same = np.zeros(1400, np.intp)
    trial = RecordedTrial(RowExtent(1400, 0, 1399), 1.0)
    traces = np.full(1400, 50.0)  # it allows such errors: it is uncertain, and never overconfident
    traces[errors == 0.0] = 1.0
    words = {"sent": (same, ["state"]), "action": (same, OUTCOMES[:1])}
    trial.add({**words, "squared_error": errors, "trace_covariance": traces})
    source: Any = SimpleNamespace(noise=1.0, summary=SimpleNamespace(first_trial=0), trial={"smart": trial})
    (listed,) = (node for node in RUN_SECTIONS["Lost synchronisation"](source) if "<details>" in node)
    spans_shown = [text.partition(":")[0] for text in Checked(listed).texts if text.startswith("slots ")]
    assert spans_shown == [f"slots {span.first:,} to {span.last:,}" for span in spans if span.slots > 2]


@pytest.mark.parametrize("mode", [Mode.COVARIANCE_ONLY, Mode.ERROR_COORDINATES])
def test_every_mode_has_its_page(tmp_path: Path, mode: Mode) -> None:
    """Without recorded states there are no lanes, but all other parts are there."""
    folder = tmp_path / "study"
    montecarlo("vehicle", trials=3, out=folder, slots=30, plan=Plan(mode, workers=1))
    write_report(folder)
    assert {"Verdicts", "Metrics", "Errors"} <= set(checked(folder).headings)


def slot_by_slot(errors: list[float], traces: list[float], noise: float) -> Iterator[str]:
    """The rule of docs/metrics.md, written out."""
    for error, trace in zip(errors, traces, strict=True):
        if error > 20 * trace and error > 20 * noise:
            yield "overconfident"
        elif error > 20 * noise or trace > 20 * noise:
            yield "uncertain"
        else:
            yield "synchronised"


numbers = st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), max_size=60)


@given(numbers, st.floats(0.0, 2.0), st.integers(0, 9))
@settings(deadline=None, max_examples=examples(200))
def test_spans_cover_exactly_the_slots_off_the_track(
    slots: list[tuple[float, float]], noise: float, first: int
) -> None:
    """Each slot by the rule; a span begins and ends not synchronised; more than three synchronised slots separate two spans."""
    errors, traces = [error for error, _ in slots], [trace for _, trace in slots]
    codes = synchronisation_of(np.array(errors), np.array(traces), noise)
    words = list(slot_by_slot(errors, traces, noise))
    assert [Synchronisation(code).word for code in codes] == words
    spans = lost_spans(codes, first)
    covered = [k - first for span in spans for k in range(span.first, span.last + 1)]
    assert {k for k, word in enumerate(words) if word != "synchronised"} <= set(covered)
    for span in spans:
        assert "synchronised" not in {words[span.first - first], words[span.last - first]}
        off = [k for k in range(span.first - first, span.last - first + 1) if words[k] != "synchronised"]
        assert all(after - before <= 3 for before, after in pairwise(off))
        assert span.overconfident == words[span.first - first : span.last - first + 1].count("overconfident")
    for earlier, other in pairwise(spans):
        assert other.first - earlier.last > 3


codes_of_pieces = st.lists(st.lists(st.sampled_from([0, 0, 0, 1, 2]), max_size=12), max_size=12)


@given(codes_of_pieces, st.integers(0, 9), st.integers(1, 6))
@settings(deadline=None, max_examples=examples(200))
def test_spans_do_not_depend_on_the_pieces_that_they_are_found_in(
    pieces: list[list[int]], first: int, most: int
) -> None:
    """Their number, and the longest of them, are those of all slots at once."""
    longest = LongestSpans(most, first)
    for piece in pieces:
        longest.add(np.array(piece, np.uint8))
    spans = lost_spans(np.array([code for piece in pieces for code in piece], np.uint8), first)
    assert longest.count == len(spans)
    assert longest.spans == sorted(spans, key=lambda span: -span.slots)[:most]


@given(st.lists(st.integers(0, 7), min_size=1, max_size=20), st.integers(1, 30))
@settings(deadline=None, max_examples=examples(100))
def test_means_and_counts_do_not_depend_on_the_pieces(lengths: list[int], most: int) -> None:
    """Groups are neighbours, each place is in one group, and the groups' sizes differ by one at most."""
    count = sum(lengths)
    values = np.arange(count, dtype=float) ** 2
    codes = np.arange(count) % 3
    means, counts = GroupMeans(count, most, 1), GroupCounts(count, most, 3)
    for part in np.split(np.arange(count), np.cumsum(lengths)[:-1]):
        means.add(values[None, part])
        counts.add(codes[part].astype(np.uint8))
    edges = np.linspace(0, count, min(count, most) + 1).astype(int)
    groups = [slice(*edge) for edge in pairwise(edges.tolist())]
    assert np.allclose(means.means[0], [values[group].mean() for group in groups], rtol=1e-12)
    tallies = [np.bincount(codes[group], minlength=3) for group in groups]
    assert counts.commonest.tolist() == [int(tally.argmax()) for tally in tallies]
    assert counts.highest.tolist() == [int(codes[group].max()) for group in groups]
    if count:
        assert counts.fractions == [float(fraction) for fraction in np.bincount(codes, minlength=3) / count]


def test_a_lane_has_a_pixel_for_every_slot_or_the_worst_of_several() -> None:
    """The PNG says what the codes say; in a lane that is too long no lost slot disappears."""
    colours = ((1, 2, 3), (200, 0, 9), (0, 0, 255))
    lane = Lane(("good", "bad", "worse"), colours)

    def pixels(codes: np.ndarray, worst: bool) -> list[list[int]]:
        counts = GroupCounts(len(codes), PIXELS, len(colours))
        for part in np.array_split(codes, 7):
            counts.add(part)
        image = lane_picture(lane, counts.highest if worst else counts.commonest, "label")
        data = base64.b64decode(Checked(image).values("src")[0].partition(",")[2])
        return list(np.asarray(Image.open(BytesIO(data)).convert("RGB"))[0].reshape(-1, 3).tolist())

    codes = np.array([0, 2, 1, 1, 0], np.uint8)
    assert pixels(codes, worst=False) == [list(colours[code]) for code in codes]
    long = np.zeros(100_000, np.uint8)
    long[[17, 50_000]] = 1
    assert pixels(long, worst=True).count(list(colours[1])) == 2
    assert pixels(long, worst=False).count(list(colours[1])) == 0


def drawn(chart: LogChart) -> ET.Element:
    """A chart that shows something, as a tree."""
    figure = chart.figure
    assert figure is not None
    return ET.fromstring(figure)  # noqa: S314 - our own


def outlines(figure: ET.Element, ink: str) -> list[str]:
    """The paths that are drawn with this ink, such as "stroke: #123456"."""
    paths = (path for path in figure.iter("path") if ink in str(path.get("style")))
    return [" ".join(str(path.get("d")).split()) for path in paths]


def uses(figure: ET.Element, ink: str) -> list[str]:
    """The ids of the paths that are drawn with this ink, once for each place where they are."""
    return [str(use.get("href")).removeprefix("#") for use in figure.iter("use") if ink in str(use.get("style"))]


def test_a_chart_has_gaps_where_nothing_is_known_and_few_points() -> None:
    """A curve of 10⁵ slots is drawn with 400 points; no chart is drawn of nothing; zeros and ∞ do not break the axis."""
    x = np.arange(100_000.0)
    curve = Curve("one", "#123456", x, 1.0 + x, 0.5 + x, 2.0 + x, theory=1.0 + x)
    figure = drawn(LogChart("label", "slot", "error", [curve]))
    (band,) = (path for path in figure.iter("path") if path.get("id") in uses(figure, "fill: #123456"))
    assert 798 < str(band.get("d")).count("L") < 804
    (line,) = outlines(figure, "stroke: #123456")
    assert (line.count("M"), line.count("L")) == (1, 399)
    (theory,) = outlines(figure, "stroke: var(--ink)")
    assert theory == line
    broken = np.array([1.0, np.nan, 0.0, 10.0, np.inf, 5.0, 6.0])
    figure = drawn(LogChart("label", "slot", "error", [Curve("one", "#123456", x[:7], broken)]))
    line, _ = outlines(figure, "stroke: #123456")
    assert line.count("L") == 2
    assert len(uses(figure, "#123456")) == 1
    assert LogChart("label", "slot", "error", [Curve("one", "#123456", x[:2], np.zeros(2))]).figure is None


def test_values_below_the_floor_lie_on_the_lower_edge_and_the_chart_says_so() -> None:
    """Rounding errors leave the axis to the errors that matter; a chart without them has no such words, and its own axis."""
    errors = np.array([1e-30, 0.0, 5.0, 0.02])
    for values, words in ((errors, "error; values below 0.01 lie on the lower edge"), (errors[2:], "error")):
        curve = Curve("one", "#123456", np.arange(float(len(values))), values)
        figure = drawn(LogChart("label", "slot", "error", [curve], floor=0.01))
        assert figure[0].text == words
        ticks = [float(str(text.text)) for text in figure.iter("text") if "end" in str(text.get("style"))]
        assert min(ticks) == (0.01 if len(values) == 4 else 0.1)
        frame = [outline.split()[2] for outline in outlines(figure, "stroke: var(--line)")]
        (line,) = outlines(figure, "stroke: #123456")
        assert line.split()[2::3].count(max(frame, key=float)) == (2 if len(values) == 4 else 0)
    assert LogChart("", "", "", [Curve("", "#123456", errors[:2], np.zeros(2))], floor=0.01).figure is not None


def test_a_chart_says_which_values_are_too_far_below_the_highest() -> None:
    """One of 1e-3 is not one of 1e220, where the axis ends."""
    x, y = np.arange(3.0), np.array([1e250, 1e220, 1e-3])
    figure = drawn(LogChart("label", "slot", "error", [Curve("one", "#123456", x, y)], floor=1e-6))
    assert figure[0].text == "error; values below 1e+220 lie on the lower edge"
    figure = drawn(LogChart("label", "slot", "error", [Curve("one", "#123456", x[:2], y[:2])], floor=1e-6))
    assert figure[0].text == "error"


def test_a_chart_of_any_size_has_an_axis() -> None:
    """One slot is a dot; errors of 1e300 and intervals that reach below 0 or to infinity are drawn as far as the axis goes."""
    dot = drawn(LogChart("label", "slot", "error", [Curve("one", "#123456", np.array([3.0]), np.array([0.5]))]))
    assert len(list(dot.iter("use"))) == 1
    x, y = np.arange(4.0), np.array([1e-300, 2.0, 1e307, 1.7e308])
    bars = Curve("one", "#123456", x, y, y - 3.0, np.full(4, np.inf), theory=y, bars=True)
    for curve in (bars, replace(bars, bars=False)):
        assert outlines(drawn(LogChart("label", "key", "error", [curve], ["a", "b", "c", "d"])), "#123456")


@given(st.lists(st.floats(0, 1), max_size=12))
@settings(deadline=None, max_examples=examples(200))
def test_labels_beside_curves_do_not_cover_each_other(ends: list[float]) -> None:
    """They are in the order of the ends, within the axis, a line of text apart, and at their ends where these are apart."""
    gap = 1 / 12
    places = label_places(ends, gap)
    ordered = [place for _, place in sorted(zip(ends, places, strict=True))]
    assert all(after - before > gap * 0.999 for before, after in pairwise(ordered))
    assert all(-1e-9 <= place <= 1 + 1e-9 for place in places)
    if all(after - before >= gap for before, after in pairwise(sorted(ends))):
        assert places == ends


def test_a_chart_names_its_axes_and_its_curves_beside_their_ends() -> None:
    """With units; more curves than there is room for have a legend below."""
    x = np.arange(3.0)
    curves = [Curve(f"receiver {i}", "#123456", x, 10.0 ** (x + i)) for i in range(13)]
    figure = drawn(LogChart("label", "slot", "error", curves[:12], y_axis="squared error (m²)"))
    texts = [str(text.text) for text in figure.iter("text")]
    assert {"squared error (m²)", *(curve.name for curve in curves[:12])} <= set(texts)
    heights = [
        float(re.findall(r"-?[0-9.]+", str(text.get("transform", "")))[1])
        for text in figure.iter("text")
        if text.text in {curve.name for curve in curves}
    ]
    assert heights == sorted(heights, reverse=True)
    assert not list(figure.iter("figcaption"))
    legend = "".join(
        "".join(part.itertext()) for part in drawn(LogChart("label", "slot", "error", curves)).iter("figcaption")
    )
    assert "receiver 12" in legend


def test_a_sweep_names_its_axis_by_the_symbol_of_the_paper() -> None:
    """An entry without a symbol has its key."""
    assert axis_name("encoding.state_probability").startswith("μ_d: ")
    assert as_mathematics(axis_name("encoding.state_probability")).startswith(r"$\mu_d$: ")
    assert axis_name("eavesdroppers.smart.link.quality").startswith("μ of smart: ")
    assert axis_name("legitimate.link.quality").startswith("μ: ")
    assert axis_name("process.Q") == "process.Q"


def test_texts_are_escaped_wherever_they_stand() -> None:
    """In text, in attributes and in drawings; characters that HTML does not allow are replaced."""
    texts = ("<b>\x00 中 $x$", "</p>", '"><i onload="y">')
    table = TextTable.headed([texts[0]], [texts[1]])
    table.add(texts[2], "&")
    curve = Curve(texts[0], "#123456", np.arange(3.0), np.ones(3))
    chart = LogChart(texts[2], texts[0], texts[1], [curve], texts)
    assert chart.figure is not None
    page = Checked(Page(*texts, None, [Part("part", [made("table", table, texts[2]), chart.figure])]).html)
    assert not {"b", "i"} & page.tags.keys()
    assert page.tags["p"] == 4
    assert Counter({"<b>\ufffd 中 $x$": 5, "</p>": 4, texts[2]: 4, "&": 1}) <= Counter(page.texts)
    assert page.values("aria-label").count(texts[2]) == 3


def with_other_values(content: Any, others: tuple[Any, ...]) -> Iterator[Any]:
    """The contents of a JSON file with one value replaced, for every value (of lists: the first) and every other one."""
    if isinstance(content, dict):
        for name, inner in content.items():
            yield {key: value for key, value in content.items() if key != name}
            yield from ({**content, name: other} for other in (*others, *with_other_values(inner, others)))
    elif isinstance(content, list) and content:
        yield from ([other, *content[1:]] for other in (*others, *with_other_values(content[0], others)))


OTHERS: tuple[Any, ...] = ("nonsense", None, -1, [], {}, math.inf)
one_or_all_others = pytest.mark.parametrize(
    "others", [pytest.param(OTHERS[:1], id="one"), pytest.param(OTHERS, id="all", marks=pytest.mark.long)]
)


@pytest.mark.thorough
@one_or_all_others
def test_a_changed_summary_is_refused_in_a_sentence(others: tuple[Any, ...], study: Path, tmp_path: Path) -> None:
    """Or shown, whatever word or number in it is another one."""
    folder = Path(shutil.copytree(study, tmp_path / "run"))
    summary = json.loads((folder / "summary.json").read_text())
    for name, word in (("mode", "nonsense"), ("trials", -1), ("slots", -1)):
        (folder / "summary.json").write_text(json.dumps({**summary, name: word}))
        with pytest.raises(UsageError, match=f"{name} is .*expected"):
            write_report(folder)
    top = {
        name: summary[name] for name in ("mode", "slots", "trials", "secrecy", "expectations", "ended", "first_trial")
    }
    for changed in with_other_values(top, others):
        (folder / "summary.json").write_text(
            json.dumps({**{k: v for k, v in summary.items() if k not in top}, **changed})
        )
        with suppress(UsageError):
            write_report(folder)


def test_a_changed_entry_of_an_application_is_refused_in_a_sentence(evedrop: Evedrop) -> None:
    """Also where the table is printed again."""
    made = ("montecarlo", "replay-attack", "--slots", "300", "--trials", "2", "--set", "expect=[]", "--out", "run")
    assert evedrop(*made).status == 0
    path = evedrop.folder / "run" / "summary.json"
    summary = json.loads(path.read_text())
    path.write_text(
        json.dumps({**summary, "integrity": {**summary["integrity"], "expected_watermark_cost": "nonsense"}})
    )
    for words in (("view", "run", "--table"), ("report", "run")):
        done = evedrop(*words)
        assert done.status == 2
        assert "has results that this version does not write" in done.err


@pytest.mark.thorough
@one_or_all_others
@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("compare", "eavesdroppers", "--schemes", "plain", "--adversaries", "smart"), "compare.json"),
        (("sweep", "eavesdroppers", "--over", "seed=1,2"), "sweep.json"),
    ],
)
def test_a_changed_study_is_refused_in_a_sentence(
    others: tuple[Any, ...], evedrop: Evedrop, words: tuple[str, ...], file: str
) -> None:
    """The same of a comparison and of a sweep."""
    assert evedrop(*words, "--slots", "12", "--trials", "2", "--out", "study").status == 0
    path = evedrop.folder / "study" / file
    for changed in with_other_values(json.loads(path.read_text()), others):
        path.write_text(json.dumps(changed))
        with suppress(UsageError):
            write_report(path.parent)
    assert evedrop("report", "study").status in {0, 2}


def test_a_sweep_begins_with_the_verdict_at_its_points() -> None:
    """At each point the eavesdropper that knows most decides; points that were not done are said."""
    secret, broken, still_open = "secret", "not secret", "cannot tell yet"

    def begins(points: list[list[str | None]], planned: int) -> list[str]:
        rows = [{"mu": point, "verdict": verdict} for point, verdicts in enumerate(points) for verdict in verdicts]
        return list(sweep_outcome(rows, ["mu"], len(points), planned))

    assert begins([[None, secret], [None, secret]], 2) == ["✓ secret at all 2 points"]
    assert begins([[None, secret, broken], [None, secret, still_open], [None, secret, secret]], 3) == [
        "✗ not secret at 1, ? cannot tell yet at 1, ✓ secret at 1"
    ]
    assert begins([[None, secret]], 3) == ["✓ secret at 1", "1 of 3 points were done"]
    assert begins([[None], [None]], 2) == ["All 2 points were done"]


def test_true_and_false_are_named_on_the_axis_of_a_sweep(tmp_path: Path) -> None:
    """And not drawn at 1 and 0, with a line and numbers between them."""
    results = sweep("vehicle", {"process.singular_noise": [True, False]}, trials=2, slots=12, out=tmp_path / "study")
    texts = checked(results.report().parent).texts
    assert {"True", "False"} <= {text.strip() for text in texts[: texts.index("Metrics", texts.index("Errors") + 4)]}
    (axes,) = results.plot().axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["True", "False"]
    assert all(line.get_linestyle() == "None" for line in axes.get_lines())


@pytest.mark.parametrize("trials", [2, 3, 5, 30])
def test_an_interval_of_95_per_cent_is_one_for_few_trials_too(trials: int) -> None:
    """Of nearly normal errors around 1."""
    errors = 1.0 + 0.1 * np.random.default_rng(1).standard_normal((trials, 20_000))
    low, high = mean_band(errors.mean(axis=0), errors.std(axis=0, ddof=1) / math.sqrt(trials), trials)
    assert 0.94 < np.mean((low <= 1.0) & (high >= 1.0)) < 0.96


def test_a_picture_of_a_sweep_says_that_a_mean_of_0_is_not_drawn() -> None:
    """Its axis is logarithmic; the legitimate estimator's error is 0 over a link without losses."""
    row = {"peer": "legitimate", "link.quality": 0.5, "mean_squared_error": 0.02, "theoretical_trace_covariance": 0.02}
    row |= {"mean_squared_error_standard_error": 0.0, "rare_fraction": 0.0}
    perfect = {"link.quality": 1.0, "mean_squared_error": 0.0, "theoretical_trace_covariance": 0.0}
    (axes,) = sweep_figure(pa.Table.from_pylist([row, row | perfect]), ("link.quality",)).axes
    assert axes.get_ylabel().endswith("not drawn: 0)")
    (axes,) = sweep_figure(pa.Table.from_pylist([row]), ("link.quality",)).axes
    assert axes.get_ylabel().endswith("(lines: theory)")


@pytest.mark.parametrize(
    ("x", "ticks"),
    [
        ([1_000_001.0, 1_000_002.0, 1_000_003.0], {"1,000,001", "1,000,003"}),
        ([2e-14, 4e-14, 6e-14], {"2e-14", "6e-14"}),
        ([-0.2, 0.0, 0.2], {"-0.2", "0", "0.2"}),
    ],
)
def test_the_ticks_of_a_chart_can_be_told_apart(x: list[float], ticks: set[str]) -> None:
    """Whatever the size of the swept values is."""
    y = np.ones(3)
    curve = Curve("eve", "#123456", np.array(x), y, y, y, y, bars=True)
    assert ticks <= {text.text for text in drawn(LogChart("label", "x", "error", [curve])).iter("text")}


def test_a_sweep_has_no_interval_where_rare_events_carry_the_mean(tmp_path: Path) -> None:
    """Of ten trials none loses the first packet, which carries the legitimate error; the naive one does not depend on it."""
    grid = {"encoding.state_probability": [0.4, 0.5]}
    results = sweep("vehicle", grid, trials=10, slots=60, out=tmp_path / "study")
    rows = {name: [row for row in results.table.to_pylist() if row["peer"] == name] for name in ("legitimate", "naive")}
    for row in rows["legitimate"]:
        error = row["mean_squared_error_standard_error"]
        assert row["theoretical_trace_covariance"] > row["mean_squared_error"] + 20.0 * error
    lacking = sum(row["rare_fraction"] > 0.1 for row in results.table.to_pylist())
    page = checked(results.report().parent)
    said = f"{lacking} of the 8 means are probably too small, and have no z: rare events carry more than 10 % of"
    assert f"{said} the expected error" in page.texts
    assert "Mean error with its 95 % interval (none where rare events carry the mean); dotted: theory" in page.texts
    (axes,) = results.plot().axes
    containers: list[Any] = axes.containers
    drawn_bars = {
        each.get_label(): sum(len(bar) == 2 and np.isfinite(bar).all() for bar in each.lines[2][0].get_segments())
        for each in containers
    }
    assert (drawn_bars["legitimate"], drawn_bars["naive"]) == (0, 2)
    assert axes.get_ylabel().endswith("no ±: rare events)")


def test_a_verdict_of_secret_says_what_theory_promises_beyond_it() -> None:
    """Perfect secrecy against smart, which no trial of `numerical` shows; and ratios of means of infinite variance say so."""
    summary = montecarlo("numerical", trials=200).typed_summary
    lines = {line.split()[2]: line for _, line in closing.verdict_lines(summary) if line.startswith("✓")}
    assert lines["smart"].endswith("(by means of infinite variance); perfect by theory, which trials may never show")
    assert lines["equal"].endswith("its squared error (by means of infinite variance)")


def test_no_verdict_rests_on_means_of_infinite_variance_without_saying_so() -> None:
    """A few trials make the legitimate mean larger than an eavesdropper's, although it is smaller in the median."""
    study = montecarlo("numerical", slots=200, trials=60, plan=Plan(mode=Mode.ERROR_COORDINATES, workers=1))
    medians = [peer.error_quantiles["0.5"] for peer in study.peers.values() if peer.error_quantiles is not None]
    assert min(medians) == medians[0]
    words = "squared error (means of infinite variance; judged by medians)"
    assert study.verdict is not None
    assert study.verdict.sentence.endswith(words)
    for name, secrecy in study.secrecy.items():
        assert secrecy.verdict is not None
        assert words in secrecy.verdict.sentence, name
    assert all("(by means of infinite variance)" in line for _, line in closing.verdict_lines(study.typed_summary))


def test_a_sweep_without_a_point_is_told_to_go_on(evedrop: Evedrop) -> None:
    """The report of a sweep that was interrupted so early is not what the error advises."""
    made = ("sweep", "eavesdroppers", "--over", "seed=1,2", "--slots", "12", "--trials", "2", "--out", "study")
    assert evedrop(*made).status == 0
    (evedrop.folder / "study" / "sweep.parquet").unlink()
    for words in (("report", "study"), ("export", "study", "study.csv")):
        done = evedrop(*words)
        assert done.status == 2
        assert "no point of its sweep is done" in done.err
        assert "evedrop report" not in done.err

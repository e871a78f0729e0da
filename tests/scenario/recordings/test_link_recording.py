"""Recordings in files: what is one, what is not, and how a scenario takes one in."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from evedrop.cli.api import montecarlo
from evedrop.errors import TraceError
from evedrop.model.checks import as_toml
from evedrop.scenario.loading import load
from evedrop.scenario.recordings import link_recording as traces
from evedrop.scenario.recordings.link_recording import LinkRecording
from evedrop.scenario.tables import Scenario
from tests.builders import mistakes_of, places_of, scalar_tables
from tests.conftest import Evedrop
from tests.golden.pages import Golden

GOOD = scalar_tables(1.0, 0.01, slots=6, legitimate={"link": {"loss": {"model": "trace", "file": "walk.csv"}}})


def write(folder: Path, name: str, text: str | bytes) -> Path:
    """A file in a folder."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ("1\n1\n0\n1\n", None),
        ("1\r\n1\r\n0\r\n1", None),
        ("received\n1\n1\n0\n1\n", None),
        ("\ufeff\nreceived\n1\n1\n0\n1\n\n", "received"),
        ("k,received,rssi\n0,1,-60\n1, 1 ,-61\n2,0,\n3,1,-70\n", "received"),
        ("t,received\n0.5,1\n1.5,1\n2.5,0\n3.5,1\n", None),
        ("ok\nTrue\ntrue\nFalse\nTRUE\n", None),
        ("True\ntrue\nFalse\nTRUE\n", None),
    ],
)
def test_a_csv_file_is_read(tmp_path: Path, text: str, column: str | None) -> None:
    """With or without names, with blanks and line ends of any kind."""
    assert LinkRecording(write(tmp_path, "walk.csv", text)).outcomes(column).tolist() == [1, 1, 0, 1]


@pytest.mark.parametrize("values", [[1, 1, 0, 1], [True, True, False, True], [1.0, 1.0, 0.0, 1.0]])
def test_a_parquet_file_is_read(tmp_path: Path, values: list[Any]) -> None:
    """Whole numbers, flags and floats."""
    pq.write_table(pa.table({"received": values, "x": [0.5] * 4}), tmp_path / "walk.parquet")
    assert LinkRecording(tmp_path / "walk.parquet").outcomes("received").tolist() == [1, 1, 0, 1]
    assert LinkRecording(tmp_path / "walk.parquet").columns() == ["received", "x"]


def test_delays_are_read(tmp_path: Path) -> None:
    """A lost packet has none."""
    path = write(tmp_path, "walk.csv", "received,delay\n1,2.5\n0,\n1,3\n")
    assert np.array_equal(LinkRecording(path).delays("delay"), [2.5, np.nan, 3.0], equal_nan=True)
    assert LinkRecording(path).columns() == ["received", "delay"]
    assert LinkRecording(write(tmp_path, "bare.csv", "1\n0\n")).columns() == []


@pytest.mark.parametrize(
    ("name", "text", "column", "entry"),
    [
        ("walk.csv", None, None, "file"),
        ("walk.csv", "", None, "file"),
        ("walk.csv", "received,received\n1,0\n0,1\n", "received", "column"),
        ("walk.csv", "received\n", None, "file"),
        ("walk.csv", "1\n0\n2\n", None, "file"),
        ("walk.csv", "2\n0\n1\n", None, "file"),
        ("walk.csv", "a,b\n1,0\n,1\n", "a", "file"),
        ("walk.csv", "a,b\n1,0\n1\n", "a", "file"),
        ("walk.csv", "a,b\n1,0\n", "c", "column"),
        ("walk.csv", "a,b\n1,0\n", None, "column"),
        ("walk.csv", "t,ok\n0.5,1\n", None, "column"),
        (
            "walk.csv",
            "t,lost,ok\n0.5,1,1\n",
            None,
            "column",
        ),
        (
            "walk.csv",
            "lost\n1\n",
            None,
            "column",
        ),
        ("walk.csv", "a,b\n7,x\n", None, "column"),
        ("walk.csv", "1\n0\n", "a", "column"),
        ("walk.csv", "1,0\n0,1\n", None, "file"),
        ("walk.csv", b"\xff\xfe1", None, "file"),
        ("walk.csv", b"1\n" * 21, None, "file"),
        ("walk.parquet", "1\n0\n", None, "file"),
        ("walk.parquet", None, None, "file"),
    ],
)
def test_what_is_no_recording_is_said(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    text: str | bytes | None,
    column: str | None,
    entry: str,
    golden: Golden,
) -> None:
    """What is wrong and where, what was expected; a scenario says it at the path of the entry."""
    monkeypatch.setattr(traces, "MOST_OUTCOMES", 20)
    if text is not None:
        write(tmp_path, name, text)
    with pytest.raises(TraceError) as caught:
        LinkRecording(tmp_path / name).outcomes(column)
    assert (caught.value.entry, caught.value.exit_status) == (entry, 2)
    loss = {"model": "trace", "file": name, **({} if column is None else {"column": column})}
    (line,) = mistakes_of(with_trace, tmp_path, loss)
    assert line.startswith(f"legitimate.link.loss.{entry}: ")
    assert caught.value.reason in line
    golden("check", line.partition("cannot be read (")[0])  # what follows is the library's


def test_a_column_of_lists_does_not_hide_the_others(tmp_path: Path) -> None:
    """Names of columns, and the column of outcomes, are read; a column of lists is named as what it is."""
    columns = {"received": [1, 0], "nested": [[1], []], "note": ["a", "a"]}
    pq.write_table(pa.table(columns), tmp_path / "walk.parquet")
    recording = LinkRecording(tmp_path / "walk.parquet")
    assert recording.columns() == [*columns]
    assert recording.outcomes("received").tolist() == [1, 0]
    with pytest.raises(TraceError, match="has lists or tables in the column"):
        recording.outcomes("nested")


def test_parquet_says_row_and_gap(tmp_path: Path) -> None:
    """A row that is neither 0 nor 1, and one without a value."""
    for values, message in (([1, 7], 'row 2 is "7"'), ([1, 0, None], "row 3 is empty"), (["1", "x"], 'row 2 is "x"')):
        pq.write_table(pa.table({"received": values}), tmp_path / "walk.parquet")
        with pytest.raises(TraceError, match=message):
            LinkRecording(tmp_path / "walk.parquet").outcomes()


@pytest.mark.parametrize("delay", ["-1", "inf", "soon", "nan"])
def test_a_delay_that_is_none_is_said(tmp_path: Path, delay: str) -> None:
    """Negative, infinite, no number."""
    path = write(tmp_path, "walk.csv", f"delay\n1\n{delay}\n")
    with pytest.raises(TraceError, match=f'line 3 is "{delay}"; expected a delay, or nothing'):
        LinkRecording(path).delays("delay")


def with_trace(folder: Path, loss: dict[str, Any], **more: Any) -> Scenario:
    """The scenario with this trace."""
    tables = {**GOOD, **more, "legitimate": {"link": {"loss": loss}}}
    return load(write(folder, "mine.toml", tomli_w.dumps(tables)))


@pytest.mark.parametrize(
    ("loss", "place"),
    [
        ({}, "file"),
        ({"fiel": "walk.csv"}, "fiel"),
        ({"column": "a"}, "file"),
        ({"file": 3}, "file"),
        ({"file": "walk.csv", "column": True}, "column"),
        ({"file": "walk.csv", "outcomes": "1"}, "file"),
        ({"file": "walk.csv", "once": "no"}, "once"),
        ({"file": "walk.csv", "twice": True}, "twice"),
        ({"file": "."}, "file"),
        ({"outcomes": "10110", "once": True}, "outcomes"),
        ({"file": "walk.csv", "once": True}, "file"),
    ],
    ids=str,
)  # fmt: skip
def test_a_mistake_of_a_scenarios_trace_is_named(
    tmp_path: Path, loss: dict[str, Any], place: str, golden: Golden
) -> None:
    """One line each, with its path."""
    write(tmp_path, "walk.csv", "1\n0\n1\n1\n")
    mistakes = mistakes_of(with_trace, tmp_path, {"model": "trace", **loss})
    assert places_of(mistakes) == [f"legitimate.link.loss.{place}"]
    golden("check", mistakes)


def test_mistakes_of_recordings_hide_no_others(tmp_path: Path) -> None:
    """Two files that are not recordings and a wrong entry: three lines."""
    eve = {"strategy": "smart", "link": {"loss": {"model": "trace", "file": "other.csv", "once": True}}}
    mistakes = mistakes_of(
        with_trace, tmp_path, {"model": "trace", "file": "walk.csv"}, eavesdroppers={"eve": eve}, slots=0
    )
    assert sorted(line.partition(":")[0] for line in mistakes) == [
        "eavesdroppers.eve.link.loss.file", "legitimate.link.loss.file", "slots",
    ]  # fmt: skip


def test_a_run_needs_its_recording_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is read from the scenario's folder and kept in the results; a run from there needs no file and has the same digests."""
    write(tmp_path, "walk.csv", "t,ok\n0,1\n1,0\n2,1\n")
    loss = {"model": "trace", "file": "walk.csv", "column": "ok", "random_start": True}
    write(tmp_path, "mine.toml", tomli_w.dumps({**GOOD, "legitimate": {"link": {"loss": loss}}}))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    first = montecarlo(tmp_path / "mine.toml", trials=5, out="run")
    kept = tomllib.loads((first.folder / "scenario.toml").read_text())["legitimate"]["link"]["loss"]
    assert kept == {"model": "trace", "outcomes": "101", "random_start": True}
    (tmp_path / "walk.csv").unlink()
    again = montecarlo("run", trials=5, out="again")
    assert again.summary["peers"]["legitimate"]["digest"] == first.summary["peers"]["legitimate"]["digest"]


def test_a_change_names_a_recording_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scenario's own recording is in its folder; one that a change names is relative to the user's current folder."""
    (tmp_path / "here").mkdir()
    write(tmp_path, "walk.csv", "1\n")
    write(tmp_path / "here", "walk.csv", "0\n1\n")
    scenario = write(tmp_path, "mine.toml", tomli_w.dumps(GOOD))
    monkeypatch.chdir(tmp_path / "here")
    assert load(scenario).legitimate.link.loss_spec["outcomes"] == "1"
    assert load(scenario, {"legitimate.link.loss.file": "walk.csv"}).legitimate.link.loss_spec["outcomes"] == "01"


@pytest.mark.thorough
def test_a_live_run_reads_a_recording(evedrop: Evedrop) -> None:
    """The router has the outcomes: all packets are accounted for, and as many are lost as were."""
    write(evedrop.folder, "walk.csv", "received\n" + "1\n0\n1\n1\n" * 10)
    change = '--set=legitimate.link={loss = {model = "trace", file = "walk.csv", once = true}}'
    done = evedrop("run", "eavesdroppers", "--slots", "40", "--view", "off", "--json", change, "--out", "x")
    assert (done.status, done.err) == (0, "")
    account = {"offered": 40, "delivered": 30, "lost": 10, "unexplained": 0}
    assert account.items() <= done.summary["links"]["legitimate"].items()


@given(
    st.recursive(
        st.one_of(st.booleans(), st.integers(-(2**60), 2**60), st.floats(), st.text('ab"\\é\n', max_size=6)),
        lambda inner: st.lists(inner, max_size=3),
        max_leaves=4,
    )
)
def test_messages_show_values_as_toml(value: Any) -> None:
    """What is not cut reads back as the value it shows."""
    text = as_toml(value)
    assert len(text) <= 81
    if len(text) <= 60:
        assert repr(tomllib.loads(f"v = {text}")["v"]) == repr(value)


def test_a_blank_line_between_outcomes_is_a_gap_and_refused(tmp_path: Path) -> None:
    """Left out, it would move all outcomes after it by a slot; around the outcomes it means nothing."""
    path = tmp_path / "walk.csv"
    path.write_text("\n1\n0\n1\n\n", encoding="utf-8")
    assert LinkRecording(path).outcomes().tolist() == [1, 0, 1]
    path.write_text("1\n\n0\n1\n", encoding="utf-8")
    with pytest.raises(TraceError, match="line 2 is empty"):
        LinkRecording(path).outcomes()

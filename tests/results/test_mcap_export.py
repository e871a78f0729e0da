import json
import math
from pathlib import Path
from typing import Any

import pytest

from evedrop import montecarlo, run
from evedrop.errors import UsageError
from evedrop.results.mcap_export import export_mcap
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from tests.conftest import Evedrop

pytest.importorskip("mcap")
PERIOD = 0.25


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """A live run of two trials, with events."""
    folder = tmp_path_factory.mktemp("live")
    run("restart", trials=2, slots=700, record_trials=2, out=folder, view="off")
    return Results.read(folder)


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """A closed loop in memory."""
    folder = tmp_path_factory.mktemp("loop")
    montecarlo("heated-room", trials=1, slots=50, out=folder)
    return Results.read(folder)


def read_back(path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Topic → time in nanoseconds and content of each message, as the library reads them."""
    from mcap.reader import make_reader

    messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            content = json.loads(message.data)
            assert content.keys() <= json.loads(schema.data)["properties"].keys()
            assert message.publish_time == message.log_time
            messages.setdefault(channel.topic, []).append((message.log_time, content))
    return messages


def known(row: dict[str, Any]) -> dict[str, Any]:
    """The entries of a row that have a value."""
    return {
        name: value
        for name, value in row.items()
        if value is not None and not (isinstance(value, float) and not math.isfinite(value))
    }


def expected(results: Results) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """What the file should contain, from the tables as a whole."""
    messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}

    def add(topic: str, slot: int, content: dict[str, Any]) -> None:
        messages.setdefault(topic, []).append((round(slot * PERIOD * 1e9), content))

    for event in results.events:
        time = {"sec": int(event.slot * PERIOD), "nsec": round(event.slot * PERIOD % 1 * 1e9)}
        log = {"timestamp": time, "level": 2, "message": event.line, "name": event.by, "file": "", "line": 0}
        add("/events", event.slot, log)
    for row in results.trials.to_pylist():
        if row.pop("trial") == 0:
            sent, x, name = row.pop("sent"), row.pop("x"), row.pop("peer")
            if name == "legitimate":
                add("/truth", row["slot"], {"slot": row["slot"], "sent": sent, "x": x})
            add(f"/estimates/{name}", row["slot"], known(row))
    for row in [] if results.inputs is None else results.inputs.to_pylist():
        if row.pop("trial") == 0:
            add("/inputs", row["slot"], known(row))
    for row in results.slots.to_pylist():
        add(f"/statistics/{row.pop('peer')}", row["slot"], known(row))
    for row in results.journal.drop_columns("delivered_mask").to_pylist():
        add(f"/packets/{row.pop('link')}", row["slot"], known(row))
    return messages


@pytest.mark.parametrize("kind", ["live", "loop"])
def test_the_file_has_every_value_of_the_results(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """At the time of its slot, in batches that are smaller than the tables; a value that JSON cannot represent is left out."""
    results: Results = request.getfixturevalue(kind)
    counts = export_mcap(results, tmp_path / "r.mcap", PERIOD, batch_rows=97)
    actual, wanted = read_back(tmp_path / "r.mcap"), expected(results)
    assert actual.keys() == wanted.keys() >= {"/truth", "/estimates/legitimate", "/statistics/legitimate"}
    assert ("/inputs" in actual, "/packets/legitimate" in actual) == (kind == "loop", kind == "live")
    for topic, messages in wanted.items():
        assert actual[topic] == messages, topic
    assert counts == {topic: len(messages) for topic, messages in actual.items()}


def test_events_are_shown_as_a_log(live: Results, tmp_path: Path) -> None:
    """Events use Foxglove's own schema, so that its Log panel shows them."""
    from mcap.reader import make_reader

    export_mcap(live, tmp_path / "r.mcap")
    with (tmp_path / "r.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    names = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
    assert names["/events"] == "foxglove.Log"
    assert len(live.events) > 0


def test_mistakes_are_said(live: Results, tmp_path: Path, evedrop: Evedrop) -> None:
    """The command ends with status 2 and leaves no file."""
    with pytest.raises(UsageError, match="give a --period"):
        export_mcap(live, tmp_path / "r.mcap", 1e9)
    assert ".mcap" in evedrop("export", str(live.folder), "r.txt").err
    assert "seconds above 0" in evedrop("export", str(live.folder), "r.mcap", "--period", "0").err
    assert "not a results folder" in evedrop("export", str(tmp_path), "r.mcap").err
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for path in live.folder.iterdir():
        if path.is_file():
            (damaged / path.name).write_bytes(path.read_bytes())
    (damaged / "trials.parquet").write_bytes(b"nonsense")
    done = evedrop("export", str(damaged), "r.mcap")
    assert (done.status, done.out) == (2, "")
    assert "trials.parquet cannot be read" in done.err
    assert not list(evedrop.folder.glob("*.mcap"))


@pytest.mark.long
def test_a_missing_package_is_named(live: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the extra that installs it."""
    monkeypatch.setitem(__import__("sys").modules, "mcap.writer", None)
    with pytest.raises(UsageError, match=r"'\.\[mcap\]'"):
        export_mcap(live, tmp_path / "r.mcap")


def test_the_command_says_what_it_wrote(loop: Results, evedrop: Evedrop) -> None:
    """Messages and topics; without --period a slot takes as long as the scenario says."""
    done = evedrop("export", str(loop.folder), "r.mcap")
    back = read_back(evedrop.folder / "r.mcap")
    assert done.out == f"r.mcap: {sum(map(len, back.values()))} messages on {len(back)} topics\n"
    scenario = load(loop.folder / "scenario.toml")
    assert scenario.slot_seconds not in {None, 1.0}
    assert back["/truth"][1][0] == 1e9 * (scenario.slot_seconds or 0.0)

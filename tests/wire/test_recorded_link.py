"""The journal of a wire as a recording: its models are found again, and so is what was lost before the wire."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evedrop.errors import TraceError, UsageError
from evedrop.scenario.recordings.message_fit import fit_messages
from evedrop.wire.file import resolved_wire, wire_of
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.plan import WirePlan
from evedrop.wire.recorded_link import journal_recording
from evedrop.wire.records import AGAIN, Kind, WireFate
from tests.conftest import Evedrop
from tests.wire.wire_links import key_fates

SETTINGS = {
    "loss": {"model": "gilbert-elliott", "p": 0.05, "r": 0.3},
    "delay": {"model": "normal", "mean": 0.02, "standard_deviation": 0.003},
    "duplicate": 0.05,
    "corrupt": 0.04,
}


def plan_of(settings: Mapping[str, Any], seed: int = 7, lossless: Sequence[str] = ()) -> WirePlan:
    """A wire with a link `scan` and one that loses nothing."""
    sides = {"robot": {"listen": "tcp/127.0.0.1:0"}, "base": {"listen": "tcp/127.0.0.1:0"}}
    links = [
        {"name": "scan", "from": "robot", "to": "base", "keys": "*/scan/**", **settings},
        {"name": "rest", "from": "robot", "to": "base", "quality": 1.0},
    ]
    return wire_of({"seed": seed, "side": sides, "link": links, "lossless": [*lossless]})


def carried(
    folder: Path,
    plan: WirePlan,
    counts: Mapping[str, int],
    hidden: Mapping[int, WireFate] | None = None,
    apart: float = 0.1,
) -> None:
    """A journal of messages of some keys on the link `scan`, as a wire keeps it.

    hidden: what happened to the n-th message of each key before its loss model; apart: seconds between messages of a key.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "wire.toml").write_text(resolved_wire(plan))
    with WireJournal(folder, plan) as journal:
        for key, count in counts.items():
            fates = key_fates(plan.links[0], key, "put", plan.seed)
            lossless = key in plan.lossless
            for n in range(count):
                fate, delay, again = (WireFate.DELIVERED, 0.0, False) if lossless else fates.next()
                fate = (hidden or {}).get(n, WireFate(fate))
                kind = Kind.PUT | (AGAIN if again and fate == WireFate.DELIVERED else 0)
                row = (
                    1e9 + apart * n,
                    n,
                    n + 1,
                    delay,
                    journal.words.key_code(key),
                    journal.words.source_code("a"),
                    64,
                    0,
                    kind,
                    fate,
                )
                journal.records.record(*row)
            journal.records.record(1e9, 0, 1, 0.0, journal.words.key_code(key), 0, 64, 1, Kind.PUT, WireFate.DELIVERED)


def test_the_models_of_a_link_are_found_again(tmp_path: Path) -> None:
    """From 6000 messages of two keys: losses, delays, copies and damage, within about four standard errors."""
    carried(tmp_path, plan_of(SETTINGS), {"0/scan/a": 3000, "0/scan/b": 3000})
    result = fit_messages(journal_recording(tmp_path, "scan"))
    settings = result.settings
    assert result.fit.chosen.name == "gilbert"
    assert settings["loss"]["p"] == pytest.approx(0.05, abs=0.013)
    assert settings["loss"]["r"] == pytest.approx(0.3, abs=0.065)
    assert settings["delay"]["mean"] == pytest.approx(0.02, abs=2e-4)
    assert settings["delay"]["standard_deviation"] == pytest.approx(0.003, abs=2e-4)
    assert settings["duplicate"] == pytest.approx(0.05, abs=0.013)
    whole = len(result.recording.delays)  # of the delivered messages that were not damaged, which alone arrive twice
    assert settings["duplicate"] == pytest.approx(result.recording.series.repeated / whole, rel=0.005)
    assert settings["corrupt"] == pytest.approx(0.04, abs=0.011)
    assert result.recording.series.parts == 2
    assert result.slot == pytest.approx(0.1)


@pytest.mark.long
def test_a_fitted_link_in_a_wire_loses_as_the_recorded_one(tmp_path: Path) -> None:
    """The printed [[link]] in a wire file: rate and bursts of 20 000 other messages are within 10 % of the recording's."""
    carried(tmp_path, plan_of(SETTINGS), {"0/scan/a": 20_000})
    result = fit_messages(journal_recording(tmp_path, "scan"))
    (link,) = tomllib.loads(result.wire_toml)["link"]
    assert (link["from"], link["to"], link["keys"]) == ("robot", "base", "*/scan/**")
    sides = {"robot": {"listen": "tcp/127.0.0.1:0"}, "base": {"listen": "tcp/127.0.0.1:0"}}
    again = wire_of({"seed": 8, "side": sides, "link": [link]})
    fates = key_fates(again.links[0], "0/scan/b", "put", 8)
    lost = np.array([fates.next()[0] == WireFate.LOST for _ in range(20_000)])
    recorded = result.recording.series.outcomes == 0
    assert lost.mean() == pytest.approx(recorded.mean(), rel=0.1)

    def burst(word: Any) -> float:
        return float(word.sum() / (word[1:] & ~word[:-1]).sum())

    assert burst(lost) == pytest.approx(burst(recorded), rel=0.1)


def test_what_hides_the_loss_model_cuts_the_messages_into_parts(tmp_path: Path) -> None:
    """Cuts and full queues are neither losses nor deliveries; what the wire could not hold was not lost by the model."""
    settings = {"loss": {"model": "pattern", "outcomes": "1" * 29 + "0"}}
    hidden = {
        **dict.fromkeys(range(100, 130), WireFate.CUT), 200: WireFate.OVERFLOW, 300: WireFate.HELD_UP, 399: WireFate.UNDERWAY,
    }  # fmt: skip
    carried(tmp_path, plan_of(settings), {"0/scan/a": 400}, hidden)
    result = journal_recording(tmp_path, "scan")
    expected = [0 if n % 30 == 29 else 1 for n in range(400) if hidden.get(n) not in {WireFate.CUT, WireFate.OVERFLOW}]
    assert result.series.outcomes.tolist() == expected
    assert result.series.parts == 3
    assert any("31 messages that met a cut" in note for note in result.notes)
    carried(tmp_path / "all", plan_of(settings), {"0/scan/a": 200}, dict.fromkeys(range(0, 200, 5), WireFate.CUT))
    with pytest.raises(TraceError, match="cuts, queues and limits hide"):
        journal_recording(tmp_path / "all", "scan")


def test_messages_that_the_wire_dropped_are_neither_damaged_nor_duplicated(tmp_path: Path) -> None:
    """They passed the link's models: most being held up changes no probability."""
    fates = {n: WireFate.CORRUPTED if n % 10 == 1 else WireFate.HELD_UP for n in range(6000) if n % 4}
    fates |= dict.fromkeys(range(5, 6000, 100), WireFate.LOST)
    carried(tmp_path, plan_of({"duplicate": 0.2}), {"0/scan/a": 6000}, fates)
    settings = fit_messages(journal_recording(tmp_path, "scan")).settings
    damaged = sum(fate is WireFate.CORRUPTED for fate in fates.values())
    assert settings["corrupt"] == pytest.approx(damaged / (6000 - 60), abs=1e-4)
    assert settings["duplicate"] == pytest.approx(0.2, abs=0.05)


def test_missing_numbers_are_what_was_lost_before_the_wire(tmp_path: Path) -> None:
    """By sender and key: the second sender is the first after a restart, and its numbers begin again."""
    plan = plan_of(SETTINGS)
    random = np.random.default_rng(3)
    words = {("0/scan/a", "x"): random.random(400) < 0.8, ("0/scan/a", "y"): random.random(300) < 0.8}
    with WireJournal(tmp_path, plan) as journal:
        n = 0
        for (key, source), word in words.items():
            for number in np.flatnonzero(word).tolist():
                codes = (journal.words.key_code(key), journal.words.source_code(source))
                fate = WireFate.LOST if n % 3 == 0 else WireFate.DELIVERED
                journal.records.record(1e9 + 0.1 * number, n, number + 1, 0.0, *codes, 64, 0, Kind.PUT, fate)
                n += 1
        journal.records.record(
            1e9, 0, 5, 0.0, journal.words.key_code("0/scan/q"), 0, 64, 0, Kind.QUERY, WireFate.DELIVERED
        )
    result = journal_recording(tmp_path, gaps=True)
    expected: list[int] = []
    for word in words.values():
        places = np.flatnonzero(word)
        expected += word[places[0] : places[-1] + 1].astype(int).tolist()
    assert result.series.outcomes.tolist() == expected
    assert (result.series.parts, result.series.restarts, len(result.delays)) == (2, 0, 0)


def test_the_command_takes_the_folder_of_a_wire(evedrop: Evedrop) -> None:
    """With --link where there are several; --key leaves the other keys out; a scenario's slot is the messages' distance."""
    carried(evedrop.folder / "runs", plan_of(SETTINGS), {"0/scan/a": 1500, "0/scan/b": 500})
    done = evedrop("links", "fit", "runs", "--link", "scan", "--key", "*/scan/a")
    assert (done.status, done.err) == (0, "")
    assert done.out.startswith("runs, link scan, */scan/a: ")
    text = done.out
    (wire,) = tomllib.loads(text[text.index("[[link]]") : text.index("# for a scenario")])["link"]
    assert wire["keys"] == "*/scan/a"
    fit_ = json.loads(evedrop("links", "fit", "runs", "--link", "scan", "--json").out)
    assert fit_["outcomes"] == 2000
    assert fit_["slot_seconds"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "has several links; expected --link and one of scan (300 messages), rest (1 message)"),
        (("--link", "orders"), 'has no messages on a link "orders"; it has scan (300 messages), rest (1 message)'),
        (("--link", "scan", "--key", "a//b"), "--key a//b: Zenoh refuses this key expression"),
        (("--link", "scan", "--key", "b"), "has no message on this link and key"),
        (("--link", "scan", "--gaps"), "lacks none of 300 numbers of its senders: nothing was lost before the wire"),
        (("--link", "rest"), "has 1 outcomes; expected 100 or more"),
        (
            ("--link", "scan", "--topic", "/scan"),
            "--topic is for an MCAP recording, and runs is a folder; leave it out",
        ),
        (("--link", "scan", "--outage", "5"), "--outage: expected --gaps with it"),
    ],
)
def test_mistakes_are_said(evedrop: Evedrop, arguments: Iterable[str], message: str) -> None:
    """One line, exit 2."""
    carried(evedrop.folder / "runs", plan_of(SETTINGS), {"0/scan/a": 300})
    done = evedrop("links", "fit", "runs", *arguments)
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert message in line


def test_a_reason_that_no_wire_writes_is_refused(tmp_path: Path) -> None:
    """It does not count as delivered."""
    carried(tmp_path, plan_of(SETTINGS), {"robot/scan/a": 50})
    (part,) = (tmp_path / JOURNAL_FOLDER).glob("*.parquet")
    table = pq.read_table(part)
    reasons = pa.array(["vanished", *table["reason"].cast(pa.string()).to_pylist()[1:]]).dictionary_encode()
    pq.write_table(table.set_column(table.schema.get_field_index("reason"), "reason", reasons), part)
    with pytest.raises(TraceError, match="whose reason is 'vanished'"):
        journal_recording(tmp_path, "scan")


def test_a_folder_without_a_journal_is_refused(tmp_path: Path) -> None:
    """As what it is not."""
    with pytest.raises(UsageError, match="is not the folder of a wire"):
        journal_recording(tmp_path)


def test_messages_beyond_the_limit_of_keys_have_no_key(tmp_path: Path) -> None:
    """They are of none that is asked for."""
    carried(tmp_path, plan_of(SETTINGS), {"0/scan/a": 500, "": 1})
    recording = journal_recording(tmp_path, "scan", "*/scan/a")
    assert len(recording.series.outcomes) == 500


def test_messages_that_were_heard_at_one_moment_have_no_distance(evedrop: Evedrop) -> None:
    """As by a wire that was suspended; a scenario's slot is not known then."""
    carried(evedrop.folder / "runs", plan_of(SETTINGS), {"0/scan/a": 500}, apart=0.0)
    done = evedrop("links", "fit", "runs", "--link", "scan", "--json")
    assert (done.status, done.err) == (0, "")
    assert json.loads(done.out)["slot_seconds"] is None


def test_lossless_messages_are_no_survivals(tmp_path: Path) -> None:
    """No model decided on them; but `--gaps` counts what was lost of them before the wire."""
    plan = plan_of(SETTINGS, lossless=["robot/scan/stop"])
    carried(tmp_path / "mixed", plan, {"robot/scan/a": 200, "robot/scan/stop": 300})
    carried(tmp_path / "alone", plan, {"robot/scan/a": 200})
    mixed, alone = (journal_recording(tmp_path / name, "scan") for name in ("mixed", "alone"))
    assert mixed.series.outcomes.tolist() == alone.series.outcomes.tolist()
    assert mixed.delays.tolist() == alone.delays.tolist()
    assert "left out: 300 messages that wire.toml has as lossless" in mixed.notes
    with pytest.raises(TraceError, match="only messages that no model decides on"):
        journal_recording(tmp_path / "mixed", "scan", "robot/scan/stop")

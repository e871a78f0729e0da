"""MCAP recordings, written with the mcap library as recorders write them: what was lost is found, and the rest is refused."""

from __future__ import annotations

import contextlib
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType

from evedrop.errors import TraceError
from evedrop.model.links import loss_of
from evedrop.model.links.loss_model import Fate
from evedrop.scenario.recordings.mcap_recording import mcap_recording
from evedrop.scenario.recordings.message_fit import fit_messages
from evedrop.wire.file import wire_of
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.scenario.recordings.recorded_messages import BURSTS, Recorded, heard, lossy, trimmed, write
from tests.wire.wire_links import key_fates


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_missing_numbers_are_losses(tmp_path: Path, compression: CompressionType) -> None:
    """Exactly the outcomes of the link, up to the last message that arrived; another topic's messages do not matter."""
    outcomes = lossy(BURSTS, 3000)
    path = write(
        tmp_path / "walk.mcap",
        [Recorded("/scan", heard(outcomes)), Recorded("/odom", heard(lossy(BURSTS, 3000, 2)))],
        compression,
    )
    result = mcap_recording(path, "/scan")
    assert result.series.outcomes.tolist() == trimmed(outcomes)
    assert (result.series.parts, result.series.repeated, result.series.late) == (1, 0, 0)
    assert result.series.seconds == pytest.approx(0.1)
    assert result.delays == pytest.approx(0.005, abs=1e-9)
    assert len(result.delays) == outcomes.sum()
    assert result.keys == "*/scan/**"


def test_a_recording_without_numbers_needs_a_period(tmp_path: Path) -> None:
    """As ros2 bag record makes it: refused with the reason and the remedy; with the period the outcomes are those of the link."""
    outcomes = lossy(BURSTS, 3000)
    messages = [(0, sent, logged) for _, sent, logged in heard(outcomes)]
    path = write(tmp_path / "bag.mcap", [Recorded("/scan", messages)])
    with pytest.raises(TraceError, match=r"numbers no message of /scan .*--period \(the median of /scan is 0.1 s\)"):
        mcap_recording(path)
    result = mcap_recording(path, period=0.1)
    assert result.series.outcomes.tolist() == trimmed(outcomes)
    assert any("a message that the publisher left out counts as lost" in note for note in result.notes)
    with pytest.raises(TraceError, match=r"more than a quarter of 0.07 s away"):
        mcap_recording(path, period=0.07)


def test_a_bag_from_before_jazzy_has_no_delays(tmp_path: Path) -> None:
    """Its recorder wrote one time for both; losses are found all the same."""
    outcomes = lossy(BURSTS, 500)
    path = write(tmp_path / "bag.mcap", [Recorded("/scan", heard(outcomes), own_times=False)])
    result = mcap_recording(path)
    assert result.series.outcomes.tolist() == trimmed(outcomes)
    assert len(result.delays) == 0
    assert any("before Jazzy" in note for note in result.notes)


@pytest.mark.parametrize("offset", [-5.0, 1.7e9])
def test_two_clocks_give_no_delays(tmp_path: Path, offset: float) -> None:
    """A log time before the time of sending, or years after it: the reason is said, and losses are found all the same."""
    outcomes = lossy(BURSTS, 500)
    messages = [(number, sent, logged + offset) for number, sent, logged in heard(outcomes)]
    result = mcap_recording(write(tmp_path / "bag.mcap", [Recorded("/scan", messages)]))
    assert result.series.outcomes.tolist() == trimmed(outcomes)
    assert len(result.delays) == 0
    assert any("did not use one clock" in note for note in result.notes)


def test_two_topics_with_counters_of_their_own_are_not_one_counter(tmp_path: Path) -> None:
    """A topic that lost nothing has all numbers that the other one lacks, and most of those that it has."""
    outcomes = lossy(BURSTS, 500)
    topics = [Recorded("/scan", heard(outcomes)), Recorded("/odom", heard(np.ones(500, np.uint8)))]
    result = mcap_recording(write(tmp_path / "bag.mcap", topics), "/scan")
    assert result.series.outcomes.tolist() == trimmed(outcomes)


def test_the_second_copy_of_a_message_has_no_delay(tmp_path: Path) -> None:
    """The delay of a message is that of its first copy."""
    outcomes = lossy(BURSTS, 500)
    copies = [(number, sent, logged + 1.0) for number, sent, logged in heard(outcomes)[::3]]
    result = mcap_recording(write(tmp_path / "bag.mcap", [Recorded("/scan", [*heard(outcomes), *copies])]))
    assert (result.series.repeated, len(result.delays)) == (len(copies), outcomes.sum())
    assert result.delays.max() < 0.01


def test_a_recorder_that_counts_by_itself_shows_no_loss(tmp_path: Path) -> None:
    """One counter for all topics, and one for each topic: both refused, and two publishers that count alike are not."""
    random = np.random.default_rng(6)
    topics = random.integers(0, 2, 2000)
    counted = [
        Recorded(f"/{name}", [(i, i * 0.1, i * 0.1 + 0.01) for i in np.flatnonzero(topics == at).tolist()])
        for at, name in enumerate(("scan", "odom"))
    ]
    path = write(tmp_path / "one.mcap", counted)
    with pytest.raises(TraceError, match="numbers the messages of all topics with one counter"):
        mcap_recording(path, "/scan")
    path = write(tmp_path / "each.mcap", [Recorded("/scan", heard(np.ones(500, np.uint8)))])
    with pytest.raises(TraceError, match="either nothing was lost, or the recorder itself counted"):
        mcap_recording(path)


@pytest.mark.parametrize("offset", [0, 1000])
def test_two_publishers_in_one_channel_are_refused(tmp_path: Path, offset: int) -> None:
    """rosbag2 keeps one channel for a topic, so the numbers of its publishers are mixed and cannot be separated."""
    first = heard(lossy(BURSTS, 500))
    other = [(number + offset, sent + 0.03, logged + 0.03) for number, sent, logged in heard(lossy(BURSTS, 500, 2))]
    both = sorted([*first, *other], key=lambda message: message[2])
    path = write(tmp_path / "bag.mcap", [Recorded("/tf", both)])
    with pytest.raises(TraceError, match="several share the topic"):
        mcap_recording(path)
    path = write(tmp_path / "old.mcap", [Recorded("/tf", both, own_times=False)])
    with pytest.raises(TraceError, match=r"several share the topic|two publishers that count alike"):
        mcap_recording(path)
    path = write(tmp_path / "channels.mcap", [Recorded("/tf", first), Recorded("/tf", other)])
    with pytest.raises(TraceError, match="several publishers share it"):
        mcap_recording(path)


def test_what_was_kept_for_late_subscribers_is_left_out(tmp_path: Path) -> None:
    """A message of transient-local durability from long before the recording is not taken for losses."""
    messages = [(1, -3600.0, 0.0), *heard(lossy(BURSTS, 500), first=36_001)]
    result = mcap_recording(write(tmp_path / "bag.mcap", [Recorded("/map", messages)]))
    assert len(result.series.outcomes) <= 500
    assert any("kept for late subscribers" in note for note in result.notes)


def test_reliable_delivery_is_told(tmp_path: Path) -> None:
    """Its losses are not those of the network."""
    metadata = {"offered_qos_profiles": "- history: keep_last\n  depth: 10\n  reliability: reliable\n"}
    path = write(tmp_path / "bag.mcap", [Recorded("/scan", heard(lossy(BURSTS, 500)), metadata)])
    assert any("offers reliable delivery" in note for note in mcap_recording(path).notes)


def test_a_split_bag_is_one_recording(tmp_path: Path) -> None:
    """The files of a bag's folder follow each other, the tenth after the ninth, by the times in them."""
    messages = heard(lossy(BURSTS, 1100))
    (tmp_path / "bag").mkdir()
    for at in range(11):
        part = messages[at * len(messages) // 11 : (at + 1) * len(messages) // 11]
        write(tmp_path / "bag" / f"bag_{at}.mcap", [Recorded("/scan", part)])
    whole = write(tmp_path / "whole.mcap", [Recorded("/scan", messages)])
    assert mcap_recording(tmp_path / "bag").series.outcomes.tolist() == mcap_recording(whole).series.outcomes.tolist()


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_a_recording_that_breaks_off_is_used_up_to_there(tmp_path: Path, compression: CompressionType) -> None:
    """The robot lost its power: what was written counts, and the message says so."""
    outcomes = lossy(BURSTS, 3000)
    path = write(tmp_path / "bag.mcap", [Recorded("/scan", heard(outcomes))], compression)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    result = mcap_recording(path)
    count = len(result.series.outcomes)
    assert 500 < count < 2500
    assert result.series.outcomes.tolist() == trimmed(outcomes)[:count]
    assert any("breaks off" in note for note in result.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "does not begin as an MCAP recording does"),
        (b"SQLite format 3\x00" * 20, "does not begin as an MCAP recording does"),
        (None, "No such file"),
    ],
)
def test_what_is_no_recording_is_said(tmp_path: Path, content: bytes | None, message: str) -> None:
    """One reason, and what was expected."""
    path = tmp_path / "walk.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(TraceError, match=message):
        mcap_recording(path)


@given(st.integers(0, 10_000), st.integers(0, 255))
def test_a_damaged_byte_raises_no_other_error(tmp_path_factory: pytest.TempPathFactory, place: int, value: int) -> None:
    """The recording is used, or refused as one."""
    folder = tmp_path_factory.getbasetemp()
    path = folder / "damaged.mcap"
    whole = folder / "whole.mcap"
    if not whole.exists():
        write(whole, [Recorded("/scan", heard(lossy(BURSTS, 300)))], CompressionType.NONE)
    content = bytearray(whole.read_bytes())
    content[place % len(content)] = value
    path.write_bytes(content)
    with contextlib.suppress(TraceError):
        mcap_recording(path)


@pytest.mark.thorough
@pytest.mark.parametrize("spec", mostly_long([{"model": "bernoulli", "quality": 0.8}, BURSTS], [BURSTS]))
def test_the_fitted_link_loses_as_the_recorded_one_did(spec: dict[str, Any], tmp_path: Path) -> None:
    """Rate and length of bursts of 200 000 messages through the fitted model, within 4 % of the link that was recorded."""
    outcomes = lossy(spec, 8000)
    path = write(tmp_path / "bag.mcap", [Recorded("/scan", heard(outcomes, 0.02))])
    loss = loss_of(fit_messages(mcap_recording(path)).settings["loss"])
    uniforms = np.random.default_rng(9).random((1000, loss.uniforms_per_slot, 200))
    again = loss.fates(0, uniforms) == Fate.LOST
    assert again.mean() == pytest.approx(1.0 - outcomes.mean(), rel=0.04)
    recorded = outcomes == 0
    burst = recorded.sum() / (recorded[1:] & ~recorded[:-1]).sum()
    assert again[1:].sum() / (again[1:] & ~again[:-1]).sum() == pytest.approx(burst, rel=0.04)


def test_messages_that_all_come_three_times_are_certain_to_come_twice(tmp_path: Path) -> None:
    """A link gives a message one second copy at most: two of each are no probability."""
    messages = heard(lossy(BURSTS, 500), 0.1)
    again = [(number, sent, arrived + late) for number, sent, arrived in messages for late in (0.0, 0.001, 0.002)]
    assert (
        fit_messages(mcap_recording(write(tmp_path / "bag.mcap", [Recorded("/scan", again)]))).settings["duplicate"]
        == 1.0
    )


def test_the_command_prints_links_for_both(evedrop: Evedrop) -> None:
    """A link for a wire file, with seconds, and one for a scenario, in slots of the messages' distance; --json says the same."""
    random = np.random.default_rng(8)
    messages = [
        (number, sent, sent + abs(random.normal(0.03, 0.004))) for number, sent, _ in heard(lossy(BURSTS, 2000), 0.1)
    ]
    messages += messages[::100]
    write(evedrop.folder / "tuesday.mcap", [Recorded("/scan", messages)])
    done = evedrop("links", "fit", "tuesday.mcap")
    assert (done.status, done.err) == (0, "")
    text = done.out
    wire = tomllib.loads(text[text.index("[[link]]") : text.index("# for a scenario")])["link"][0]
    assert (wire["from"], wire["to"], wire["keys"]) == ("robot", "base", "*/scan/**")
    assert wire["loss"]["model"] == "gilbert-elliott"
    assert wire["delay"]["mean"] == pytest.approx(0.03, abs=0.001)
    assert wire["duplicate"] == pytest.approx(0.01, abs=0.001)
    assert "# for a scenario with slots of 0.1 s:" in text
    assert " messages on average\n" in text[text.index("taken: ") :]
    longer = evedrop("links", "fit", "tuesday.mcap", "--slot", "1").out
    assert "# for a scenario with slots of 1 s, each with one message:" in longer
    link = tomllib.loads(text.splitlines()[-1])["link"]
    assert link["delay"]["mean"] == pytest.approx(0.3, abs=0.01)
    assert (link["loss"], link["duplicate"]) == (wire["loss"], wire["duplicate"])
    fit_ = json.loads(evedrop("links", "fit", "tuesday.mcap", "--slot", "0.03", "--json").out)
    assert fit_["settings"]["loss"] == wire["loss"]
    assert fit_["link"]["delay"]["mean"] == pytest.approx(1.0, abs=0.04)


def test_the_outcomes_are_saved_as_a_trace(evedrop: Evedrop) -> None:
    """In a wire file, the very messages are lost that were lost on the day of the recording."""
    outcomes = lossy(BURSTS, 500)
    write(evedrop.folder / "tuesday.mcap", [Recorded("/scan", heard(outcomes))])
    assert evedrop("links", "fit", "tuesday.mcap", "--save", "tuesday.csv").status == 0
    link = {"from": "robot", "to": "base", "loss": {"model": "trace", "file": "tuesday.csv", "column": "received"}}
    wire = wire_of({"side": {"robot": {}, "base": {}}, "link": [link]}, folder=evedrop.folder)
    fates = key_fates(wire.links[0], "0/scan/a", "put", 7)
    word = trimmed(outcomes)
    assert [int(fates.next()[0] == Fate.DELIVERED) for _ in word] == word
    done = evedrop("links", "fit", "tuesday.mcap", "--save", "missing/tuesday.csv")
    assert (done.status, done.out) == (2, "")
    assert "--save missing/tuesday.csv cannot be written (No such file or directory)" in done.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--column", "a"), "--column is for a table of outcomes, and tuesday.mcap is an MCAP recording"),
        (("--topic", "/odom"), 'has no topic "/odom"; it has /scan (2 messages), /map (2 messages)'),
        ((), "has several topics; expected --topic and one of /scan (2 messages), /map (2 messages)"),
        (("--topic", "/scan"), "tuesday.mcap, /scan: has 3 outcomes; expected 100 or more"),
        (("--slot", "0"), "--slot 0: expected seconds, more than 0"),
    ],
)
def test_mistakes_of_the_command_are_said(evedrop: Evedrop, arguments: tuple[str, ...], message: str) -> None:
    """One line, exit 2."""
    messages = [(1, 0.0, 0.01), (3, 0.2, 0.21)]
    write(evedrop.folder / "tuesday.mcap", [Recorded("/scan", messages), Recorded("/map", messages)])
    done = evedrop("links", "fit", "tuesday.mcap", *arguments)
    assert (done.status, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert message in line


def test_without_the_library_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The extra, by its name."""
    path = write(tmp_path / "bag.mcap", [Recorded("/scan", heard(lossy(BURSTS, 300)))])
    monkeypatch.setitem(sys.modules, "mcap.stream_reader", None)
    with pytest.raises(TraceError, match=r"expected pip install '\.\[mcap\]' in the checkout first"):
        mcap_recording(path)

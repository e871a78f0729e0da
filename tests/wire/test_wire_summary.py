"""The summary of a wire: every message has one fate, links agree with their models or not, expectations hold or fail."""

from __future__ import annotations

import json
import math
import re
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from evedrop.cli.main import main
from evedrop.errors import ScenarioError, UsageError
from evedrop.results.wire_summary import WIRE_FILE, JournalSummary, WireLinkSummary, WireSummary
from evedrop.show.report.wire import NOTHING_HEARD, WITHOUT_MODEL, wire_failures, wire_sentences, wire_table
from evedrop.wire.file import resolved_wire, wire_of
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_reading import journal_tables
from evedrop.wire.on_disk import closing_lines, scorekeeper_on_disk, summary_of_wire, write_wire_report
from evedrop.wire.plan import Side, WirePlan
from evedrop.wire.records import AGAIN, UNLINKED, Kind, WireFate
from evedrop.wire.scorekeeper import WireScorekeeper
from evedrop.wire.tables import WireExpectTable
from evedrop.wire.tallies import WIRE_METRICS, LinkTally
from tests.conftest import wait_until
from tests.pages import checked, downloads
from tests.wire.wire_links import LOSSES, key_fates
from tests.wire.wire_plans import wire_plan

BURSTS = {"loss": {"model": "gilbert-elliott", "p": 0.02, "r": 0.2}}


def run(
    folder: Path, plan: WirePlan, actual: WirePlan | None = None, messages: int = 3000
) -> tuple[dict[str, Any], int]:
    """A wire through whose links messages of three keys go; its summary and exit status. actual: whose models decide instead."""
    with WireJournal(folder, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        for link in (actual or plan).links:
            for at in range(3):
                key = f"{link.name}/{at}"
                fates = key_fates(link, key, "put", plan.seed, journal.counts.get((link.name, key, "put"), 0))
                for n in range(fates.n, fates.n + messages):
                    fate, delay, again = fates.next()
                    kind = Kind.PUT | AGAIN if again else Kind.PUT
                    journal.records.record(
                        n / 10, n, -1, delay, journal.words.key_code(key), 0, 10, link.number, kind, fate
                    )
        journal.close()
        status = keeper.finish(folder)
    path = folder / "summary.json"
    summary: dict[str, Any] = json.loads(path.read_text())
    assert WireSummary.read(path).text == path.read_text()
    return summary, status


def read(folder: Path) -> WireSummary:
    """The summary in a wire's folder."""
    return WireSummary.read(folder / "summary.json")


def test_links_agree_with_their_models(tmp_path: Path) -> None:
    """Every loss model, within 99 % bounds; heard is the sum of all fates; and again when the wire goes on in the same folder."""
    plan = wire_plan(
        seed=1,  # with one seed in seven, one of these 16 comparisons is outside its 99 % bounds
        corrupt={"loss": LOSSES["bernoulli"], "corrupt": 0.2},
        perfect={"loss": {"model": "bernoulli", "quality": 1.0}},
        **{name: {"loss": loss} for name, loss in LOSSES.items()},
    )
    for start in (1, 2):
        summary, status = run(tmp_path, plan)
        assert status == 0
        assert (summary["start"], summary["unaccounted"], summary["unlinked"]) == (start, 0, 0)
        assert summary["heard"] == 9000 * len(plan.links)
        for name, link in summary["links"].items():
            assert link["heard"] == 9000 == link["delivered"] + sum(link["lost_by"].values()), name
            assert link["dropped_by"] == {}
            assert link["within_bounds"] is True, (name, link)
            assert link["bytes"] == 90_000
        assert summary["links"]["perfect"]["rate"] == summary["links"]["perfect"]["bounds"][1] == 1.0
        assert set(summary["links"]["corrupt"]["lost_by"]) == {"loss", "corrupted"}


@pytest.mark.parametrize(
    ("model", "wrong"),
    [
        ("bernoulli", {"quality": 0.75}),
        ("gilbert-elliott", {"p": 0.05}),
        ("pattern", {"outcomes": "1100"}),
        ("distance", {"reference_snr": 60.0}),
    ],
)
def test_a_wrong_model_is_told(tmp_path: Path, model: str, wrong: dict[str, Any]) -> None:
    """A link whose messages are lost by another model is outside its bounds, and a sentence says so."""
    actual = wire_plan(link={"loss": {**LOSSES[model], **wrong}})
    summary, _ = run(tmp_path, wire_plan(link={"loss": LOSSES[model]}), actual)
    assert summary["links"]["link"]["within_bounds"] is False
    assert any(
        line.startswith("link is outside the 99 % bounds of its model") for line in wire_failures(read(tmp_path))
    )


def judged(
    folder: Path,
    messages: int,
    fate_of: Callable[[int, WireFate], WireFate],
    link: dict[str, Any],
    later: tuple[int, dict[str, Any]] | None = None,
) -> WireLinkSummary:
    """The summary of a link after so many messages.

    fate_of: from a message's number and its fate by the models, its fate; link: its models; later: those from a message on.
    """
    plan = wire_plan(link=link)
    with WireJournal(folder, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        fates, key = key_fates(plan.links[0], "link/1", "put", 7), journal.words.key_code("link/1")
        for n in range(messages):
            if later is not None and n == later[0]:
                journal.change("link", later[1], {("link/1", "put"): fates.change(later[1])})
            fate = fate_of(n, WireFate(fates.next()[0]))
            journal.records.record(n / 10, n, -1, 0.0, key, 0, 10, 0, Kind.PUT, fate)
    return keeper.links()["link"]


def test_changes_and_cuts_are_part_of_the_distribution(tmp_path: Path) -> None:
    """A link that changed half way, and was cut in between, agrees with its models of each time."""
    other = {"loss": {"model": "bernoulli", "quality": 0.3}}
    link = judged(
        tmp_path, 4000, lambda n, fate: WireFate.CUT if 1000 <= n < 1500 else fate, BURSTS, later=(2000, other)
    )
    assert link.expected_rate == pytest.approx((1500 * 0.2 / 0.22 + 2000 * 0.3) / 3500)
    assert link.within_bounds is True
    assert link.lost_by["cut"] == link.gap_messages == 500


def test_gaps_of_a_wire_have_first_fates_and_those_of_its_journal_the_last_ones(tmp_path: Path) -> None:
    """A running wire's summary and its journal may differ in gaps (docs/wire/results.md), but never in counts or in the rate."""
    plan = wire_plan(link=BURSTS)
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    with WireJournal(tmp_path, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        key = journal.words.key_code("scan")
        rows = [journal.records.record(journal_time(n), n, -1, 0.1, key, 0, 1, 0, Kind.PUT, 0) for n in range(9)]
        journal.flush()
        for row in rows[4:]:
            journal.records.amend(row, WireFate.UNDERWAY)
    keeper.finish(tmp_path)
    written, later = read(tmp_path).links["link"], scorekeeper_on_disk(tmp_path, plan).summary().links["link"]
    for link in (written, later):
        assert (link.delivered, link.dropped_by, link.rate) == (4, {"underway": 5}, 1.0)
    assert (written.gap_messages, later.gap_messages) == (0, 5)
    assert (written.gap_seconds, later.gap_seconds > 0) == (0.0, True)


def journal_time(n: int) -> float:
    """When message n is heard, in seconds since 1970."""
    return time.time() + n


def test_a_link_on_many_of_whose_messages_no_model_decides_is_judged_as_a_sample(tmp_path: Path) -> None:
    """The numbers of the others are too scattered to be kept: the model's rate, with bounds that are wide enough for a sample."""
    messages, quality = 12_000, 0.7
    loss = {"loss": {"model": "bernoulli", "quality": quality}}
    link = judged(tmp_path, messages, lambda n, fate: WireFate.CUT if n % 4 else fate, loss)
    assert link.expected_rate == pytest.approx(quality)
    assert link.within_bounds is True
    assert link.bounds is not None
    standard_deviation = math.sqrt(quality * (1.0 - quality) / (messages // 4))
    assert link.bounds[1] - link.bounds[0] == pytest.approx(2 * 2.576 * standard_deviation, rel=0.03)


def test_a_link_that_becomes_worse_and_overflows_at_once_agrees_with_its_models_of_each_time(tmp_path: Path) -> None:
    """However often the queue was full since: most of its good messages are those of before, and the model says so."""
    good, worse = ({"loss": {"model": "bernoulli", "quality": quality}} for quality in (0.9, 0.5))
    link = judged(
        tmp_path,
        32_000,
        lambda n, fate: WireFate.OVERFLOW if n >= 10_000 and n % 10 else fate,
        good,
        later=(10_000, worse),
    )
    assert link.expected_rate == pytest.approx((10_000 * 0.9 + 2200 * 0.5) / 12_200, rel=1e-3)
    assert link.within_bounds is True


def test_the_keys_of_a_history_have_the_bounds_of_one_key(tmp_path: Path) -> None:
    """They share their numbers, and so one chain of bursts; gaps are those of each key."""
    plan = wire_plan(link=BURSTS)
    keys = [f"link/@adv/pub/{session}/1/_" for session in ("aa", "bb", "cc")]
    results = []
    for name, shared in (("history", keys), ("single", keys[:1])):
        with WireJournal(tmp_path / name, plan) as journal:
            keeper, fates = WireScorekeeper(plan, journal), key_fates(plan.links[0], keys[0], "put", plan.seed)
            for n in range(3000):
                code = journal.words.key_code(shared[n % len(shared)])
                journal.records.record(1.0 * n, n, -1, 0.0, code, 0, 1, 0, Kind.PUT, fates.next()[0])
                if n % 700 == 0:
                    journal.flush()
            journal.flush()
            results.append(keeper.links()["link"])
    history, single = results
    assert history.bounds == single.bounds
    assert (history.rate, history.expected_rate) == (single.rate, single.expected_rate)
    assert history.gap_messages < single.gap_messages


def test_what_no_model_decides_is_named_apart(tmp_path: Path) -> None:
    """Lossless keys, messages that no link takes, what the wire dropped, and what was amended: all in one identity."""
    plan = WirePlan(
        7, {"robot": Side("robot"), "base": Side("base")}, wire_plan(link=BURSTS).links, lossless=("link/stop",)
    )
    with WireJournal(tmp_path, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        keys = [journal.words.key_code(key) for key in ("link/1", "link/stop", "other")]
        for n, fate in enumerate(WireFate):
            journal.records.record(1.0 * n, n, -1, 0.1, keys[0], 0, 1, 0, Kind.DELETE if n % 2 else Kind.PUT, fate)
            journal.records.record(1.0 * n, n, -1, 0.0, keys[1], 0, 1, 0, Kind.PUT, WireFate.DELIVERED)
        journal.records.record(20.0, -1, -1, 0.0, keys[2], 0, 1, UNLINKED, Kind.QUERY, WireFate.UNLINKED)
        row = journal.records.record(
            21.0, len(WireFate), -1, 0.2, keys[0], 0, 1, 0, Kind.PUT | AGAIN, WireFate.DELIVERED
        )
        journal.records.record(22.0, len(WireFate) + 1, -1, 0.2, keys[0], 0, 1, 0, Kind.PUT | AGAIN, WireFate.DELIVERED)
        journal.flush()
        journal.records.amend(row, WireFate.REFUSED)
    assert sum(pa.concat_tables(journal_tables(tmp_path))["again"].to_pylist()) == 1
    assert keeper.finish(tmp_path) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    link = summary["links"]["link"]
    assert (summary["heard"], summary["unlinked"], summary["unaccounted"]) == (29, 1, 0)
    assert (link["heard"], link["delivered"], link["again"]) == (28, 15, 1)  # what was refused came not even once
    assert link["lost_by"] == dict.fromkeys(("loss", "corrupted", "overflow", "cut"), 1)
    dropped = ("unlinked", "too_large", "held_up", "looped", "underway", "too_many_keys", "congested")
    assert link["dropped_by"] == {**dict.fromkeys(dropped, 1), "refused": 2}
    # Of twice delivered, lost, corrupted, held up, underway, congested and twice refused.
    assert link["rate"] == pytest.approx(7 / 9)
    assert link["gap_messages"] == 12
    text = "\n".join(wire_sentences(read(tmp_path)))
    assert "link lost 1 by loss, 1 by corrupted, 1 by overflow, 1 by cut" in text
    apart = "overflow and cut and unlinked and too large and looped and too many keys"
    assert f"link: rate, model and within leave out the messages by {apart}, on which its models did not decide" in text
    assert "the wire itself, or Zenoh, dropped 1 by unlinked, 1 by too large" in text
    assert "no link of the file takes 1 message" in text
    title, heading, _, first = [line for line in closing_lines(read(tmp_path)) if line.strip()][:4]
    assert title.startswith("wire · seed 7 · 29 messages · ")
    assert heading.split() == [
        "link",
        "heard",
        "delivered",
        "lost",
        "dropped",
        "rate",
        "model",
        "within",
        "delay",
        "gap",
    ]
    assert first.split()[:6] == ["link", "28", "15", "4", "9", "0.7778"]


EXPECTING = """
seed = 7
[side.robot]
listen = "tcp/127.0.0.1:7448"
[side.base]
listen = "tcp/127.0.0.1:7449"
[[link]]
name = "scan"
from = "robot"
to = "base"
quality = 0.6
delay = { model = "constant", value = "20 ms" }
"""


def expecting(text: str) -> WirePlan:
    """A wire with expectations."""
    return wire_of(tomllib.loads(EXPECTING + text))


def test_expectations(tmp_path: Path) -> None:
    """Each metric holds or fails by its bounds, with a line, and the exit status is 1 if one fails."""
    plan = expecting(
        """
[[expect]]
metric = "scan.delivery"
above = 0.55
below = 0.65
[[expect]]
metric = "scan.latency"
quantile = 0.9
below = "25 ms"
[[expect]]
metric = "scan.gap_messages"
below = 3
[[expect]]
metric = "scan.gap_seconds"
above = "1 min"
[[expect]]
link = "scan"
"""
    )
    assert wire_of(tomllib.loads(resolved_wire(plan))) == plan
    written, status = run(tmp_path, plan)
    assert status == 1
    assert [expectation["held"] for expectation in written["expectations"]] == [True, True, False, False, True]
    summary = read(tmp_path)
    sentences = list(wire_sentences(summary))
    assert "expected 0.9 quantile of scan.latency below 0.025: held, found 0.02" in sentences
    assert any(line.startswith("expected scan.gap_messages below 3: FAILED") for line in wire_failures(summary))
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    write_wire_report(tmp_path)
    page = checked(tmp_path)
    assert page.headings == [
        "Wire of robot and base",
        "Expectations",
        "Links",
        "Over time",
        "Losses by reason",
        "Repeat it",
    ]
    assert "2 of 5 expectations FAILED" in page.texts
    assert {cell for row in wire_table(summary).rows for cell in row} <= set(page.texts)
    assert {"{:.4f} to {:.4f}".format(*written["links"]["scan"]["bounds"]), "lost: loss"} <= set(page.texts)
    assert {*sentences[1:], *wire_failures(summary)} <= set(page.texts)
    assert "bernoulli: quality = 0.6" in page.texts
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(UsageError, match="not the summary of a wire of this version"):
        write_wire_report(tmp_path)
    (tmp_path / "summary.json").unlink()
    write_wire_report(tmp_path)
    assert checked(tmp_path).headings == page.headings
    nothing, status = run(tmp_path / "silent", plan, messages=0)
    assert status == 1
    assert {(judged["held"], judged["why"]) for judged in nothing["expectations"]} == {(None, "the link heard nothing")}
    assert NOTHING_HEARD in closing_lines(read(tmp_path / "silent"))
    assert NOTHING_HEARD not in sentences
    (tmp_path / "silent" / WIRE_FILE).write_text(resolved_wire(plan))
    write_wire_report(tmp_path / "silent")
    page = checked(tmp_path / "silent")
    assert {"5 of 5 expectations FAILED", "expected scan.gap_messages below 3: FAILED, the link heard nothing"} <= set(
        page.texts
    )


def test_the_page_of_a_start_is_not_made_from_the_summary_of_an_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is still there, because it could neither be removed nor replaced."""
    out, file = tmp_path / "out", tmp_path / "robot.toml"
    file.write_text('[side.robot]\n[side.base]\n[[link]]\nfrom = "robot"\nto = "base"\nquality = 0.5\n')
    words = ["wire", str(file), "--out", str(out), "--for", "0.1 s"]
    assert main(words) == 0
    same = "start it in its folder: the same messages have the same fates, apart from changes by hand."
    assert same in "".join(checked(out).texts)
    earlier = (out / "summary.json").read_text()
    monkeypatch.setattr(
        "evedrop.wire.scorekeeper.replace_private", lambda *_: (out / "summary.json").write_text(earlier)
    )
    assert main(words) == 0
    assert read(out).start == 1
    texts = checked(out).texts
    assert "2 in this folder" in texts
    assert "start it in its folder: its fates are those of start 1, not of start 2, apart from" in "".join(texts)


def test_the_wire_file_travels_with_the_page_without_its_passwords(tmp_path: Path) -> None:
    """A wire of the same links, events and expectations on any machine; nothing in the page tells addresses or users."""
    text = """
        [side.robot]
        listen = "tcp/127.0.0.1:7448"
        users = { ada = "a long password" }
        keys = "robot/**"
        [side.base]
        connect = "tcp/192.0.2.7:7447"
        [[link]]
        from = "robot"
        to = "base"
        quality = 0.7
        [[event]]
        at = "12 s"
        note = "the lift"
        """
    plan = wire_of(tomllib.loads(text))
    run(tmp_path, plan)
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    page = checked(write_wire_report(tmp_path).parent)
    travelling = downloads(page)[WIRE_FILE]
    again = wire_of(tomllib.loads(travelling))
    assert (again.seed, again.links, again.events) == (plan.seed, plan.links, plan.events)
    assert again.sides["robot"].keys == plan.sides["robot"].keys
    for private in ("long password", "ada", "7448", "192.0.2.7"):
        assert private not in travelling
        assert private not in "".join(page.texts)
    assert "evedrop wire wire.toml --out again" in "".join(page.texts)


@pytest.mark.parametrize(
    ("fate", "text", "why"),
    [
        (WireFate.LOST, '[[expect]]\nmetric = "scan.latency"\nquantile = 0.5\nbelow = 1', "no message was delivered"),
        (WireFate.CUT, '[[expect]]\nlink = "scan"', "the link's models decided on no message"),
    ],
)
def test_a_metric_without_a_value_has_failed(fate: WireFate, text: str, why: str, tmp_path: Path) -> None:
    """With the reason, on a link that heard something."""
    plan = expecting(text)
    with WireJournal(tmp_path, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        journal.records.record(1.0, 0, -1, 0.0, journal.words.key_code("a"), 0, 0, 0, Kind.PUT, fate)
    summary = keeper.summary()
    assert keeper.finish(tmp_path) == 1
    assert summary.failed_expectations == 1
    assert [line for line in wire_failures(summary) if line.endswith(f": FAILED, {why}")] != []


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"heard": "many"}, "heard: Input should be a valid integer"),
        ({"seed": None}, "seed: Input should be a valid integer"),
        ({"state": "asleep"}, "state: Input should be 'running', 'ended' or 'killed'"),
        ({"journal": []}, "journal: "),
        ({"links": []}, "links: "),
        ({"links": {"link": {"heard": 5}}}, "links.link.source: Field required"),
        ({"events": [{"event": "cut link"}]}, "events.0.seconds: Field required"),
        ({"expectations": 7}, "expectations: "),
        ({"made_with": ["python"]}, "made_with: "),
    ],
)
def test_a_summary_with_another_entry_is_refused(entries: dict[str, Any], message: str, tmp_path: Path) -> None:
    """With its file, the entry, and what is wrong with it."""
    summary, _ = run(tmp_path, wire_plan(), messages=1)
    path = tmp_path / "summary.json"
    path.write_text(json.dumps(summary | entries))
    with pytest.raises(UsageError, match=re.escape(f"{path} is not the summary of a wire of this version ({message}")):
        WireSummary.read(path)


@pytest.mark.parametrize("name", ["rate", "expected_rate", "bounds", "within_bounds"])
def test_a_link_that_lacks_a_part_of_its_comparison_is_refused(name: str, tmp_path: Path) -> None:
    """The rate is given with all that the models say about it."""
    summary, _ = run(tmp_path, wire_plan(), messages=1)
    for link in summary["links"].values():
        link[name] = None
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(UsageError, match="rate, expected_rate, bounds and within_bounds must be given together"):
        read(tmp_path)


@pytest.mark.parametrize("text", ["", "[", "7", "[" * 100_000, "\ud800"])
def test_a_file_that_is_no_summary_is_refused(text: str, tmp_path: Path) -> None:
    """Also one that is not JSON, or not text."""
    path = tmp_path / "summary.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(UsageError, match=re.escape(f"{path} is not the summary of a wire ")):
        WireSummary.read(path)
    with pytest.raises(UsageError, match="is not the summary of a wire"):
        WireSummary.read(tmp_path)


def test_a_wire_without_links_has_a_summary_and_a_page(tmp_path: Path) -> None:
    """The page says so."""
    plan = wire_of({"side": {"robot": {}, "base": {}}})
    run(tmp_path, plan)
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    assert read(tmp_path).links == {}
    write_wire_report(tmp_path)
    assert checked(tmp_path).headings[0] == "Wire without links"


def test_the_summary_of_an_older_version_is_of_a_wire_that_ended(tmp_path: Path) -> None:
    """It has no state."""
    summary, _ = run(tmp_path, wire_plan(), messages=1)
    del summary["state"]
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    assert read(tmp_path).state == "ended"


def test_mistakes_in_expectations() -> None:
    """Each is named with its entry and what to write."""
    with pytest.raises(ScenarioError) as caught:
        expecting(
            """
[[expect]]
metric = "scam.delivery"
[[expect]]
metric = "scan.latencies"
below = "3 apples"
[[expect]]
metric = "scan.gap_seconds"
quantile = 0.5
below = 1
[[expect]]
metric = "scan.latency"
below = 1
[[expect]]
link = "scan"
below = 0.5
[[expect]]
below = 0.5
"""
        )
    text = "\n".join(caught.value.mistakes)
    for line in (
        "expect.0.below: is missing, and so is above; add one of them, or both",
        'expect.1.metric: is "scan.latencies"; expected LINK.heard, LINK.delivery, LINK.latency, LINK.gap_messages or LINK.ga',
        'expect.1.below: is "3 apples"; expected a number, or a length of time such as "20 ms"',
        "expect.2.quantile: is set, but only a latency has quantiles",
        "expect.3.quantile: is missing; a latency needs one",
        "expect.4.below: is set, but a table with link has no other entries",
        "expect.5.metric: is missing",
    ):
        assert line in text, text
    with pytest.raises(ScenarioError) as caught:
        expecting('[[expect]]\nmetric = "scam.delivery"\nabove = 0.5\n')
    (line,) = caught.value.mistakes
    assert line.startswith(
        'expect.0.metric: is "scam.delivery", but there is no link scam; expected a metric or the name of scan'
    )


@pytest.mark.parametrize(("bound", "value", "holds"), [
    ("below", 0.4, True), ("below", 0.5, False), ("below", 0.6, False),
    ("above", 0.4, False), ("above", 0.5, False), ("above", 0.6, True),
])  # fmt: skip
def test_a_bound_itself_is_neither_below_nor_above(bound: str, value: float, holds: bool) -> None:
    """A metric must be on its side of the bound."""
    assert WireExpectTable.model_validate({"metric": "scan.delivery", bound: 0.5}).holds(value) is holds


def test_a_latency_is_that_of_its_quantile(tmp_path: Path) -> None:
    """Of 100 different delays, the 90th."""
    plan = expecting('[[expect]]\nmetric = "scan.latency"\nquantile = 0.9\nbelow = 1\n')
    with WireJournal(tmp_path, plan) as journal:
        keeper = WireScorekeeper(plan, journal)
        for n in range(100):
            journal.records.record(
                1.0, n, -1, (n + 1) / 1000, journal.words.key_code("a"), 0, 0, 0, Kind.PUT, WireFate.DELIVERED
            )
    (judged,) = keeper.judged(keeper.links())
    assert judged.value == 0.09


def test_the_exit_status_tells_of_an_incomplete_journal_and_of_unaccounted_messages(tmp_path: Path) -> None:
    """The exit status is 1 or 3, each with a line."""
    with WireJournal(tmp_path, wire_plan()) as journal:
        keeper = WireScorekeeper(wire_plan(), journal)
    assert keeper.finish(tmp_path) == 0
    assert list(wire_failures(keeper.summary())) == []
    journal.place.incomplete_since = 5.0
    assert keeper.finish(tmp_path) == 1
    assert "the journal has all messages" in "".join(wire_failures(keeper.summary()))
    journal.records.missing = 7
    assert list(wire_failures(keeper.summary())) == [
        "the journal lacks 7 messages, because its folder could not be written"
    ]
    journal.records.recorded += 1
    assert keeper.finish(tmp_path) == 3
    assert "unaccounted for: 1 message; this is a fault of Evedrop" in wire_failures(keeper.summary())


def test_a_journal_without_a_summary_says_what_it_lacks(tmp_path: Path) -> None:
    """And how long its wire ran, although nothing was heard at last; of a next start, what it recovered."""
    plan = wire_plan(radio=BURSTS)
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    with WireJournal(tmp_path, plan) as journal:
        journal.place.incomplete_since, journal.records.missing = 5.0, 7
        wait_until(lambda: journal.seconds > 0.3, "a part of a second")
    summary = summary_of_wire(tmp_path)
    assert (summary.state, summary.journal) == ("ended", JournalSummary(0, 7, 5.0))
    assert summary.seconds == pytest.approx(journal.seconds, abs=0.25)
    assert [*wire_failures(summary)] == ["the journal lacks 7 messages, because its folder could not be written"]
    with WireJournal(tmp_path, plan) as journal:
        journal.history.begin(plan, time.time(), 12)
        assert summary_of_wire(tmp_path).journal == JournalSummary(12, 0, None)


def test_the_summary_of_an_earlier_start_is_not_that_of_a_wire_that_was_killed(tmp_path: Path) -> None:
    """A power cut may bring it back; without a history that can be read, it is all that there is."""
    plan = wire_plan(radio=BURSTS)
    run(tmp_path, plan)
    (tmp_path / WIRE_FILE).write_text(resolved_wire(plan))
    journal = WireJournal(tmp_path, plan).begin()
    assert (summary_of_wire(tmp_path).start, summary_of_wire(tmp_path).state) == (2, "running")
    journal.close()
    (tmp_path / "journal" / "history.jsonl").write_text("{\n")
    assert summary_of_wire(tmp_path).start == 1


def test_a_metric_of_a_link_is_one_line_of_the_registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wire file may expect something of a metric that is only in the registry, and its own method gives the value."""

    class Bytes:
        name = "bytes"
        has_quantile = is_time = False
        most = math.inf

        def value(self, link: WireLinkSummary, tally: LinkTally, quantile: float | None) -> float | None:
            assert (tally.heard, quantile) == (link.heard, None)
            return link.bytes

    monkeypatch.setitem(WIRE_METRICS, "bytes", Bytes())
    summary, _ = run(tmp_path, expecting('[[expect]]\nmetric = "scan.bytes"\nabove = 0.5\n'), messages=30)
    (judged,) = summary["expectations"]
    assert (judged["held"], judged["value"]) == (True, summary["links"]["scan"]["bytes"])


def test_the_page_lists_every_metric_of_a_link() -> None:
    """In the section about expectations."""
    page = (Path(__file__).parents[2] / "docs" / "wire" / "results.md").read_text(encoding="utf-8")
    section = page.partition("## Expectations")[2].partition("\n## ")[0]
    assert [name for name in WIRE_METRICS if name not in section] == []


def test_the_report_names_the_reasons_on_which_no_model_decided() -> None:
    """As a fate says of itself, so that a new one is not forgotten."""
    assert {fate.name.lower() for fate in WireFate if not fate.decided} == WITHOUT_MODEL

"""What an attacker does is in the recording: acknowledgements, a replay of measurements, links that are cut."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop import load_results, montecarlo, run
from evedrop.model.acknowledgements import ACTS, ATTACKS, AckChannel, AckFate
from evedrop.model.receiver import Flags
from evedrop.show.view.attacks import Attacks, cut_off, lane_count
from evedrop.show.view.lanes import EAVESDROPPER
from evedrop.show.view.scene import AckScene, AttackSpan, Scene, SceneSlots, Shown
from evedrop.show.view.scene_slots import replay
from tests.examples import mostly_long
from tests.show.view.read_back import lane, rows

RECEIVERS = (Shown("legitimate", "legitimate", "acknowledged", 0.9), Shown("eve", "eavesdropper", "reference", 0.9))
WORDS = ("nothing", "acknowledged", "lost", "blocked", "forged", "ignored")


def a_scene(**entries: Any) -> Scene:
    """A scene of ten slots with an eavesdropper."""
    return Scene("", "r", 10, 1, 2, 0.0, RECEIVERS, 1.0, **entries)


def some_slots(first: int, count: int, fates: list[int] | None = None) -> SceneSlots:
    """Slots at the origin."""
    acknowledged = None if fates is None else np.array(fates, np.uint8)
    return SceneSlots(first, np.zeros((count, 2)), np.zeros(count, np.bool_), {}, acknowledged=acknowledged)


def all_of(results: Any, column: str, peer: str) -> list[Any]:
    """A column of a receiver's first recorded trial."""
    table = [row for row in results.trials.to_pylist() if row["peer"] == peer]
    first = min(row["trial"] for row in table)
    return [row[column] for row in sorted(table, key=lambda row: row["slot"]) if row["trial"] == first]


@pytest.fixture
def arrivals(monkeypatch: pytest.MonkeyPatch) -> dict[int, Flags]:
    """Slot → the acknowledgements that reach the sensor of a run in this process, (R,)."""
    arrivals: dict[int, Flags] = {}
    arrived = AckChannel.arrived

    def spied(channel: AckChannel, k: int, *rest: Any) -> Flags:
        arrivals[k] = arrived(channel, k, *rest)
        return arrivals[k]

    monkeypatch.setattr(AckChannel, "arrived", spied)
    return arrivals


@pytest.mark.parametrize("attack", mostly_long(sorted(ATTACKS), ["critical", "hijack"]))
def test_the_lane_is_what_the_sensor_got(attack: str, tmp_path: Path, arrivals: dict[int, Flags]) -> None:
    """Of the first of the trials, which is not trial 0; blocked where the estimator received and the air was silent."""
    acks: dict[str, Any] = {"link": {"quality": 0.8}, "attack": attack}
    acks |= {"jammer": "jammer"} if attack in ("critical", "hijack") else {"flip": 0.3} if attack == "flip" else {}
    changes: dict[str, Any] = {"first_trial": 3, "acknowledgements": acks, "expect": []}
    montecarlo("acknowledged", trials=2, out=tmp_path / "run", workers=1, **changes)
    results = load_results(tmp_path / "run")
    seen = lane(replay(tmp_path / "run"), "packets/4_acknowledged", 41)
    assert [word in ("acknowledged", "forged") for word in seen] == [bool(arrivals[k][0]) for k in range(41)]
    received = [word != "dropped" for word in all_of(results, "action", "legitimate")]
    heard = [word != "dropped" for word in all_of(results, "action", "jammer")]
    for word, got, overheard in zip(seen, received, heard, strict=True):
        assert (word in ("nothing", "forged")) == (not got)
        if attack == "critical":
            assert (word == "blocked") == (got and not overheard)
    acts = {WORDS[act] for act in ACTS[attack]}
    done = set(seen) - {"nothing", "acknowledged", "lost"}
    assert done <= acts
    assert bool(done) == bool(acts)


@pytest.mark.parametrize("attack", mostly_long(["critical", "hijack"], ["hijack"]))
def test_the_lane_is_right_where_receivers_are_away_and_packets_late(
    attack: str, tmp_path: Path, arrivals: dict[int, Flags]
) -> None:
    """Who is away acknowledges and overhears nothing, nor is a late packet acknowledged; an attack may last for a while."""
    events = [
        {"from": 5, "to": 12, "pause": "legitimate"},
        {"from": 10, "to": 20, "kill": "jammer"},
        {"from": 22, "to": 26, "cut": "jammer"},
        {"from": 8, "to": 38, "jam": "acknowledgements"},
    ]
    delay = {"model": "normal", "mean": 0.6, "standard_deviation": 0.7}
    changes: dict[str, Any] = {
        "acknowledgements": {"link": {"quality": 0.7}, "attack": attack, "jammer": "jammer"},
        "legitimate": {"link": {"quality": 0.9, "delay": delay}, "window": 3},
        "event": events,
        "expect": [],
    }
    montecarlo("acknowledged", trials=2, out=tmp_path / "run", workers=1, **changes)
    seen = lane(replay(tmp_path / "run"), "packets/4_acknowledged", 41)
    assert [word == "acknowledged" for word in seen] == [bool(arrivals[k][0]) for k in range(41)]
    assert {"acknowledged", "nothing", {"critical": "blocked", "hijack": "ignored"}[attack]} <= set(seen)


@pytest.mark.thorough
def test_a_live_run_shows_what_its_replay_shows(tmp_path: Path) -> None:
    """Its acknowledgements in every slot, the words at the top of the plane, the marks on the path, and the events."""
    folder = run("acknowledged", trials=2, out=tmp_path / "run", view="web").folder
    live, again = folder / "recording.rrd", replay(folder, tmp_path / "again.rrd")
    blocked = [k for k, word in enumerate(lane(live, "packets/4_acknowledged", 41)) if word == "blocked"]
    assert blocked
    for rrd in (live, again):
        assert [k for k, word in enumerate(lane(rrd, "packets/4_acknowledged", 41)) if word == "blocked"] == blocked
        assert [k for k, marks in rows(rrd, "plane/Truth/attacks", "Points2D:positions").items() if marks] == blocked
        texts = rows(rrd, "plane/Truth/attacked", "Points2D:labels")
        assert texts[blocked[0]] == ["acknowledgement blocked by jammer, 1 so far"]
        assert texts[40] == [f"{len(blocked)} acknowledgements blocked by jammer so far"]
        assert not texts[0] or blocked[0] == 0
        lines = rows(rrd, "events", "TextDocument:text")[blocked[0]][0]
        assert f"#{blocked[0]}   WARN   an acknowledgement was blocked by jammer, for the first time" in lines


def test_a_replay_of_measurements_is_shown_while_it_lasts(tmp_path: Path) -> None:
    """As a lane, and as marks on the curve of what happens; the scenario says when."""
    folder = montecarlo("replay-attack", trials=1, out=tmp_path / "run").folder
    path = replay(folder)
    words = lane(path, "packets/3_attack", 260)
    assert words == [" "] * 160 + ["measurements are a recording"] * 100
    levels, marks = rows(path, "levels/0/Truth", "Scalars:scalars"), rows(path, "levels/0/Attacks/0", "Scalars:scalars")
    assert marks == {k: levels[k] for k in range(160, 260)}


def test_a_link_that_is_cut_is_named(tmp_path: Path) -> None:
    """In the lane, above what happens, and in the world of the receiver that it cuts off, and in no other."""
    events = [{"from": 20, "to": 30, "cut": "smart"}, {"from": 25, "to": 40, "cut": "legitimate"}]
    folder = montecarlo("cut", trials=1, slots=50, out=tmp_path / "run", event=events, expect=[]).folder
    path = replay(folder)
    both = "cut off: smart, legitimate"
    words = [" "] * 20 + ["cut off: smart"] * 5 + [both] * 5 + ["cut off: legitimate"] * 10 + [" "] * 10
    assert lane(path, "packets/3_attack", 50) == words
    shown = rows(path, "plane/Truth/attacked", "Points2D:labels")
    assert [(shown[k] or [" "])[0] for k in range(50)] == words
    cut = rows(path, "plane/legitimate/cut", "Points2D:labels")
    assert [k for k in range(50) if cut[k]] == [*range(25, 40)]
    assert {reason for row in all_rows(folder) if 25 <= row["slot"] < 30 for reason in [row["action"]]} == {"dropped"}


def all_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of the recorded trials."""
    rows_of: list[dict[str, Any]] = load_results(folder).trials.to_pylist()
    return rows_of


def test_a_run_without_attack_shows_none(tmp_path: Path) -> None:
    """No lane and no word; acknowledgements alone have a lane, but no words."""
    assert lane_count(a_scene()) == 0
    assert Attacks(a_scene()).lanes() == []
    assert Attacks(a_scene()).texts(some_slots(0, 3), np.arange(3)) == [""] * 3
    quiet = Attacks(a_scene(acknowledgements=AckScene("none", None)))
    assert [name for name, _ in quiet.lanes()] == ["acknowledged"]
    assert quiet.title == "   acknowledged   pale: yes"
    assert quiet.texts(some_slots(0, 3, [0, 1, 2]), np.arange(3)) == [""] * 3
    path = replay(montecarlo("eavesdroppers", trials=1, slots=50, out=tmp_path / "run").folder)
    assert rows(path, "plane/Truth/attacked", "Points2D:labels") == {}
    assert not any("acknowledgement" in text[0] for text in rows(path, "events", "TextDocument:text").values())


def test_many_attacks_that_overlap_are_named_together() -> None:
    """Also more kinds than a byte has codes, in the order in which they began."""
    spans = tuple(AttackSpan("", i, i + 2, f"e{i}") for i in range(600))
    attacks = Attacks(a_scene(spans=spans))
    texts = attacks.texts(some_slots(0, 602), np.arange(602))
    assert texts[0] == "cut off: e0"
    assert texts[1:600] == [f"cut off: e{i}, e{i + 1}" for i in range(599)]
    assert texts[600:] == ["cut off: e599", ""]
    ((_, named),) = attacks.lanes()
    (codes,) = attacks.codes(some_slots(0, 602))
    assert [named.words[code].strip() for code in codes.tolist()] == texts


def test_a_cut_during_another_attack_is_named_after_it() -> None:
    """Where one attack ends as another one begins, only the latter is named."""
    spans = AttackSpan("measurements are replaced", 1, 4), AttackSpan("", 2, 3, "eve"), AttackSpan("", 4, 5, "eve")
    texts = Attacks(a_scene(spans=spans)).texts(some_slots(0, 6), np.arange(6))
    replaced = "measurements are replaced"
    assert texts == ["", replaced, f"{replaced}, cut off: eve", replaced, "cut off: eve", ""]


def test_words_count_across_pieces_and_name_the_attacker() -> None:
    """However the slots are cut; a slot with an act says so."""
    fates = [AckFate.BLOCKED, AckFate.ARRIVED, AckFate.FORGED, AckFate.BLOCKED, AckFate.LOST]
    for cut in (1, 2, 5):
        attacks, texts = Attacks(a_scene(acknowledgements=AckScene("flip", None))), []
        for first in range(0, 5, cut):
            part = [int(fate) for fate in fates[first : first + cut]]
            texts += attacks.texts(some_slots(first, len(part), part), np.arange(len(part)))
        assert texts == [
            "acknowledgement blocked, 1 so far",
            "1 acknowledgement blocked so far",
            "1 acknowledgement blocked so far · acknowledgement forged, 1 so far",
            "acknowledgement blocked, 2 so far · 1 acknowledgement forged so far",
            "2 acknowledgements blocked so far · 1 acknowledgement forged so far",
        ]
    served = Attacks(a_scene(acknowledgements=AckScene("hijack", "eve")))
    assert served.words(AckFate.IGNORED) == "ignored in favour of eve"
    assert served.title == "   acknowledged   pale: yes, in the colour of eve: ignored"


def test_the_colour_of_an_attack_is_the_attackers() -> None:
    """Or a tone where the scenario names none: never vermilion, which is broken secrecy, nor a receiver's."""
    scene = a_scene(acknowledgements=AckScene("critical", "eve"), spans=(AttackSpan("", 2, 5, "eve"),))
    (_, acks), (_, attack) = Attacks(scene).lanes()
    assert acks.colours[AckFate.BLOCKED] == scene.colours["eve"]
    assert set(attack.colours) <= set(EAVESDROPPER.colours)
    for name in ATTACKS:
        ((_, lane_of_acks),) = Attacks(a_scene(acknowledgements=AckScene(name, None))).lanes()
        assert set(lane_of_acks.colours) <= set(EAVESDROPPER.colours)
        assert len({lane_of_acks.colours[act] for act in ACTS[name]} | {lane_of_acks.colours[1]}) == 1 + len(ACTS[name])
    assert cut_off(scene, "eve", np.arange(7)).tolist() == [False, False, True, True, True, False, False]
    assert not cut_off(scene, "legitimate", np.arange(7)).any()

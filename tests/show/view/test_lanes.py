"""Whether a receiver is synchronised, uncertain or overconfident, and the lanes that show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from evedrop.model.process import Floats
from evedrop.score.synchronisation import FACTOR, Synchronisation
from evedrop.score.verdict import SecrecyOutcome, Verdict, distance_text
from evedrop.show.view.lanes import KNOWLEDGE, SPIED, ErrorDistance, KnowledgeLane, knowledge
from evedrop.show.view.panels.fates import WhoKnowsWhat
from evedrop.show.view.panels.texts import VerdictLine
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.scene import PeerSlots, Scene, Shown
from evedrop.show.view.scene_slots import drawable
from tests.show.view.read_back import lane, rows
from tests.show.view.simulated_run import Simulated

SMART = Shown("smart", "eavesdropper", "smart", 1.0)
SCENE = Scene("", "r", 10, 1, 2, 0.0, (SMART,), noise=0.05, units=("m", "m"))


def known(error: float, trace: float, scene: Scene = SCENE) -> Synchronisation:
    """What a receiver knows with this squared error and tr P, shared by two states."""
    none = np.zeros(1)
    P = np.diag([trace / 4, 3 * trace / 4])[None]
    off = np.sqrt(error / 4), -np.sqrt(3 * error / 4)
    peer = PeerSlots(0, np.array([off]), P, none.astype(np.uint8), none, none, none, none)
    return Synchronisation(knowledge(scene, np.zeros((1, 2)), peer.x_hat, peer.P)[0])


@pytest.mark.parametrize(
    ("error", "trace", "expected"),
    [
        (0.0, 0.0, Synchronisation.SYNCHRONISED),
        (0.99, 0.0, Synchronisation.SYNCHRONISED),  # 20 times the noise of a step is 1
        (1.01, 0.0, Synchronisation.OVERCONFIDENT),
        (1.01, 0.1, Synchronisation.UNCERTAIN),
        (0.0, 1.01, Synchronisation.UNCERTAIN),  # near the truth by chance
        (99.0, 5.0, Synchronisation.UNCERTAIN),
        (101.0, 5.0, Synchronisation.OVERCONFIDENT),
        (np.nan, 5.0, Synchronisation.OVERCONFIDENT),
        (np.inf, 5.0, Synchronisation.OVERCONFIDENT),
    ],
)
def test_a_word_for_error_and_covariance(error: float, trace: float, expected: Synchronisation) -> None:
    """The bounds of docs/view.md."""
    assert known(error, trace) is expected


def test_a_right_covariance_is_hardly_ever_called_overconfident() -> None:
    """The bound of the docstring; errors in one direction exceed it most often, and those in several hardly ever."""
    assert stats.chi2.sf(FACTOR, 1) < 1e-5
    for n in (2, 4, 10):
        assert stats.chi2.sf(FACTOR * n, n) < stats.chi2.sf(FACTOR, 1)


def walk(distances: list[float], levels: list[int], knows: KnowledgeLane, first: int = 0) -> dict[int, str]:
    """Slot → the lane's word from there on, for distances in the next slots."""
    slots, codes = knows.changes(first, np.array(levels, np.uint8), np.array(distances))
    return {k: knows.lane.words[code] for k, code in zip(slots.tolist(), codes, strict=True)}


def test_words_say_the_largest_distance_of_a_stretch() -> None:
    """They name powers of ten, do not flicker, and continue over calls."""
    knows = KnowledgeLane(SMART, ErrorDistance(SCENE))
    assert walk([0.2] * 6 + [3.0] * 5 + [30.0, 9.0, 9.0, 9.0], [0] * 6 + [2] * 9, knows) == {
        0: "synchronised <1 m",
        6: "overconfident >1 m",
        11: "overconfident",
    }
    assert walk([9.0, 9.0, 9.0, 0.5], [2, 2, 2, 1], knows, 15) == {11: "overconfident >10 m", 18: "uncertain"}
    assert walk([np.inf, np.nan] + [0.1] * 9, [2] * 11, knows, 19)[19] == "overconfident >1e9 m"
    words, colours = knows.lane.words, knows.lane.colours
    assert len(set(words)) == len(words)
    inks = dict(zip(SPIED.words, SPIED.colours, strict=True))
    assert [inks[word.partition(" ")[0]] for word in words] == list(colours)
    assert knows.labels == [word.partition(" ")[2] or " " for word in words]
    legitimate = KnowledgeLane(replace(SMART, role="legitimate"), ErrorDistance(SCENE)).lane
    assert (legitimate.words, {*legitimate.colours}) == (words, {*KNOWLEDGE.colours})


def test_no_word_of_a_lane_is_cut(simulated: Callable[..., Simulated]) -> None:
    """A stretch with a word has more slots than the word has letters; the numbers come first, and are short."""
    run = simulated(300)
    distance = ErrorDistance(replace(run.scene, units=("m", "m")))
    for shown in run.scene.receivers:
        knows, peer = KnowledgeLane(shown, distance), run.slots.peers[shown.name]
        levels = knowledge(run.scene, run.slots.x, peer.x_hat, peer.P)
        slots, codes = knows.changes(0, levels, distance.of(run.slots.x, peer.x_hat))
        changes = dict(zip(slots.tolist(), codes.tolist(), strict=True))
        labels = [knows.labels[code] for code in changes.values()]
        for start, end, label in zip(changes, [*[*changes][1:], 300], labels, strict=True):
            assert label == " " or (end - start > len(label) and label[0] in "<>" and len(label) <= 8)
        assert any(label != " " for label in labels)


def test_distances_have_a_unit() -> None:
    """Only states with the unit of the first count; without units, all do."""
    moving = replace(SCENE, n=3, units=("m", "m", "m/s"))
    x: Floats = np.array([[3.0, 4.0, 12.0]])
    assert ErrorDistance(moving).of(x, np.zeros((1, 3)))[0] == 5.0
    assert ErrorDistance(replace(moving, units=())).of(x, np.zeros((1, 3)))[0] == 13.0
    texts = [ErrorDistance(moving).text(distance_) for distance_ in (0.0, 0.316, 12.34, 4567.0, 1e9, np.inf)]
    assert texts == ["0 m", "0.32 m", "12 m", "4,600 m", "1e9 m", "everything"]


@given(distance=st.floats(1e-5, 1e7))
@example(distance=9.95e-4)
@example(distance=0.001)
@example(distance=98.9)
@example(distance=99.5)
@example(distance=9500.0)
@example(distance=8.99e5)
def test_distances_are_written_as_in_the_verdict(distance: float) -> None:
    """Also those that are written fast."""
    assert ErrorDistance(replace(SCENE, noise=1e-20, units=("m", "m"))).text(distance) == distance_text(distance, "m")


def test_distances_of_rounding_are_none() -> None:
    """√(tr Q) is 0.22 m here: less than a thousandth of it is 0, and the finest distance that is said has two digits."""
    assert [ErrorDistance(SCENE).text(distance_) for distance_ in (2e-15, 2.2e-4, 2.3e-4)] == [
        "0 m",
        "0 m",
        "0.00023 m",
    ]
    finer = ErrorDistance(replace(SCENE, noise=1e-20))
    assert [finer.text(distance_) for distance_ in (9e-14, 2e-13)] == ["0 m", "2e-13 m"]


def test_the_strip_shows_who_knows_what(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """However slots are handed over, a lane has the words of its receiver; naive is overconfident, smart is not."""
    run, lanes = simulated(300), {}
    for length in (7, 300):
        recording = ViewRecording(tmp_path / f"{length}.rrd", run.scene)
        for slots in run.chunks(length):
            recording.add(slots)
        assert recording.close()
        for i, shown in enumerate(run.scene.receivers, 1):
            lanes[shown.name, length] = lane(tmp_path / f"{length}.rrd", f"knows/{i}_{shown.name}", 300)
    for i, shown in enumerate(run.scene.receivers, 1):
        assert lanes[shown.name, 7] == lanes[shown.name, 300]
        changes = rows(tmp_path / "7.rrd", f"knows/{i}_{shown.name}", "StateChange:state")
        assert [word for _, (word,) in sorted(changes.items())] == [word for word, _ in groupby(lanes[shown.name, 7])]
        peer = run.slots.peers[shown.name]
        expected = knowledge(run.scene, run.slots.x, peer.x_hat, peer.P)
        assert [word.split()[0] for word in lanes[shown.name, 7]] == [KNOWLEDGE.words[code] for code in expected]
    words = {name: " ".join(words_) for (name, _), words_ in lanes.items()}
    assert "overconfident" in words["naive"]
    assert "overconfident" not in words["smart"]
    assert "uncertain" in words["smart"]
    assert set(words["legitimate"].split()) & {"overconfident", "uncertain"} == set()
    assert set(WhoKnowsWhat(run.scene).styles()) == {
        f"knows/{i + 1}_{s.name}" for i, s in enumerate(run.scene.receivers)
    }


def test_titles_in_any_letters_are_drawn() -> None:
    """Letters that the viewer's font lacks become question marks, and Markdown stays as it was typed."""
    assert drawable("Größe σ² ≥ 1 Ж x\u0302") == "Größe σ² ≥ 1 Ж x\u0302"
    assert drawable("東 🚗 \u0387\u038b\u038d\u03a2") == "? ? ????"
    assert title_of(replace(SCENE, title="a *b* # c")) == r"**a \*b\* \# c**"


def title_of(scene: Scene) -> str:
    """The title below the verdict, in Markdown."""
    (column,) = VerdictLine(scene).conclusion(scene.slots - 1, Verdict(SecrecyOutcome.RELATIVE, "far off", "smart"))
    assert column.slots.tolist() == [scene.slots - 1]
    texts = [text for values in column.values for text in values.as_arrow_array().to_pylist() if "secret" in text[0]]
    headline, _, title = str(texts[0][0]).partition("\n\n")
    assert headline == "#### ✓ secret: far off"
    return title


def test_the_title_says_which_trials_are_shown() -> None:
    """If there are several."""
    assert title_of(replace(SCENE, title="a", trials=1)) == "**a**"
    many = "**a** · curves of errors and tr P: means of 2,000 trials, everything else: the first of them"
    assert title_of(replace(SCENE, title="a", trials=2000)) == many

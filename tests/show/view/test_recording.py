import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from scipy.special import stdtrit

from evedrop.show.view.column import laid_out
from evedrop.show.view.panels.curves import SquaredError, StateOverTime, TraceOfP, WhatMovesThePlant
from evedrop.show.view.panels.panel import ViewPanel
from evedrop.show.view.panels.plane import StatePlane, frames, stride
from evedrop.show.view.panels.texts import Legend
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.scene import Moved, Scene
from tests.conftest import LIMIT
from tests.examples import mostly_long
from tests.show.view.read_back import lane, new_events, rows
from tests.show.view.simulated_run import Simulated

SLOTS = 400


def record(run: Simulated, rrd: Path, chunk: int = 60) -> None:
    """Put a run on file, some slots at a time."""
    recording = ViewRecording(rrd, run.scene)
    for slots in run.chunks(chunk):
        recording.add(slots)
    recording.note(5, "WARN", "a note")
    assert recording.close()
    assert recording.failure is None


@pytest.fixture(scope="module")
def run(simulated: Callable[..., Simulated]) -> Simulated:
    """A run of every strategy."""
    return simulated(SLOTS)


@pytest.fixture(scope="module")
def rrd(run: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its recording."""
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    record(run, path)
    return path


def test_curves_are_logarithms_at_full_rate(run: Simulated, rrd: Path) -> None:
    """Every receiver has its error, reported and theoretical trace in every slot; what is exact lies on a common floor."""
    lowest = []
    for name, peer in run.slots.peers.items():
        for kind, values in (("error", peer.squared_error), ("trace", peer.trace), ("theory", peer.theoretical_trace)):
            shown = rows(rrd, f"{kind}/{name}", "Scalars:scalars")
            curve = np.array([shown[k][0] for k in range(SLOTS)])
            above = curve > curve.min()
            np.testing.assert_allclose(curve[above], np.log10(np.sqrt(values[above])), rtol=1e-12)
            if kind == "error":
                lowest.append(curve.min())
                assert (np.sqrt(values[~above]) <= 1.001 * 10.0 ** curve.min()).all()
    assert max(lowest) == min(lowest)


def test_styles_come_before_the_first_slot(rrd: Path) -> None:
    """Otherwise a viewer shows the first slots in colours of Rerun's choice."""
    chunks = [chunk for chunk in RrdReader(rrd).stream() if "properties" not in chunk.entity_path]
    static = [chunk.is_static for chunk in chunks]
    assert static.count(True) > 10
    assert static == sorted(static, reverse=True)


def test_bands_of_several_trials(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """Their edges are those of the 95 % intervals of logarithms, in every slot; a single trial has none."""
    several, alone = simulated(30, trials=12), simulated(30)
    record(several, tmp_path / "several.rrd")
    for name, peer in several.slots.peers.items():
        for side, sign in (("low", -1), ("high", 1)):
            shown = rows(tmp_path / "several.rrd", f"band/{name}/{side}", "Scalars:scalars")
            edge = peer.squared_error * np.exp(sign * stdtrit(11, 0.975) * peer.standard_error / peer.squared_error)
            assert sorted(shown) == list(range(30))
            # A tenth of tr Q / trials = 0.04 / 12, rounded down to a power of ten, is the least that is shown.
            heights = [shown[k][0] for k in range(30)]
            np.testing.assert_allclose(heights, np.log10(np.sqrt(np.maximum(edge, 1e-4))), rtol=1e-9)
        assert (peer.standard_error > 0.0).any()
    assert any("band" in path for path in SquaredError(several.scene).styles())
    assert not any("band" in path for path in SquaredError(alone.scene).styles())
    assert {column.path for column in SquaredError(alone.scene).columns(alone.slots)} == {
        f"error/{name}" for name in alone.slots.peers
    }


def test_bands_do_not_fall_to_the_floor(simulated: Callable[..., Simulated]) -> None:
    """A band around a mean above the floor stays within a factor of ten of it, although the mean minus two errors is below 0."""
    run = simulated(3, trials=20)
    mean, error = np.array([1.0, 0.05, 0.0]), np.array([0.9, 0.04, 0.0])
    peers = {name: peer.changed(squared_error=mean, standard_error=error) for name, peer in run.slots.peers.items()}
    drawn = {
        column.path: next(iter(column.values)).as_arrow_array().flatten().to_numpy()
        for column in SquaredError(run.scene).columns(run.slots.changed(peers=peers))
    }
    curve, low, high = drawn["error/smart"], drawn["band/smart/low"], drawn["band/smart/high"]
    assert (curve[:2] - low[:2] < 0.5).all()
    np.testing.assert_allclose(curve - low, high - curve, atol=1e-12)
    assert low[2] == curve[2] == curve.min()


def test_numbers_of_a_logarithmic_axis_are_explained(simulated: Callable[..., Simulated]) -> None:
    """In the panels' titles, with the unit of the states if they have a common one."""
    scene = simulated(20).scene
    titles = {
        units: [
            str(placed.view.name)
            for panel in (SquaredError, TraceOfP)
            for placed in panel(replace(scene, units=units)).views()
        ]
        for units in ((), ("m", "m"), ("m", "m/s"))
    }
    assert titles == {
        (): ["Error   −1: 0.1 · 1: 10", "Root of tr P   dim: theory   −1: 0.1 · 1: 10"],
        ("m", "m"): ["Error   −1: 0.1 m · 1: 10 m", "Root of tr P   dim: theory   −1: 0.1 m · 1: 10 m"],
        ("m", "m/s"): ["Error   −1: 0.1 · 1: 10   (m, m/s)", "Root of tr P   dim: theory   −1: 0.1 · 1: 10"],
    }


@pytest.mark.parametrize(
    ("growth", "title", "unit"),
    [(0.0, "−1: 0.1 m · 1: 10 m", 1), (5.84, "−1: 0.01 m · 1: 100 m", 2), (40.0, "−1: 1e-10 m · 1: 1e10 m", 10)],
)
def test_an_unstable_process_has_larger_units(
    growth: float, title: str, unit: int, simulated: Callable[..., Simulated]
) -> None:
    """So that its axis has a few of them, and a number at each, however small the panel."""
    run = simulated(20)
    panel = SquaredError(replace(run.scene, units=("m", "m"), growth=growth))
    assert str(next(iter(panel.views())).view.name) == f"Error   {title}"
    drawn = next(column for column in panel.columns(run.slots) if column.path == "error/naive")
    heights = next(iter(drawn.values)).as_arrow_array().flatten().to_numpy()
    errors = np.maximum(run.slots.peers["naive"].squared_error, 1e-3)
    np.testing.assert_allclose(10.0 ** (2 * unit * heights), errors, rtol=1e-9)


def test_lanes_tell_what_happened(run: Simulated, rrd: Path) -> None:
    """Each lane says in every slot what became of the packet, and an innovation used as the state misled."""
    nu = run.slots.nu
    assert lane(rrd, "packets/0_sent", SLOTS) == ["innovation" if flag else "state" for flag in nu]
    for i, shown in enumerate(run.scene.receivers):
        words = {0: "dropped", 1: "state", 2: "innovation", 3: "discarded"}
        expected = [words[int(action)] for action in run.slots.peers[shown.name].action]
        if i > 0:
            expected = ["misled" if nu[k] and word == "state" else word for k, word in enumerate(expected)]
            assert "misled" in expected or shown.strategy == "smart"
        assert lane(rrd, f"packets/{i + 1}_{shown.name}", SLOTS) == expected


def test_plane_shows_truth_estimates_and_ellipses(run: Simulated, rrd: Path) -> None:
    """The plane holds each point, mirrored, and ellipses whose points are all 2σ from their centre."""
    truth = rows(rrd, "plane/Truth/at", "Points2D:positions")
    for k in (0, 1, 200, SLOTS - 1):
        np.testing.assert_allclose(truth[k][0], run.slots.x[k] * [1, -1], rtol=1e-6)
    smart = run.slots.peers["smart"]
    ellipses = rows(rrd, "plane/smart/cov", "LineStrips2D:strips")
    unsure = [k for k in range(SLOTS) if np.trace(smart.P[k]) > 0]
    for k in unsure[:20]:
        offsets = np.array(ellipses[k][0]) * [1, -1] - smart.x_hat[k]
        distances = np.einsum("ci,ij,cj->c", offsets, np.linalg.inv(smart.P[k]), offsets)
        np.testing.assert_allclose(np.sqrt(distances), 2.0, rtol=1e-3)


def test_trail_passes_through_every_slot(run: Simulated, rrd: Path) -> None:
    """The trail's pieces join up to the whole way."""
    pieces = rows(rrd, "plane/Truth/trail", "LineStrips2D:strips")
    for k in range(1, SLOTS):
        np.testing.assert_allclose(pieces[k][0], run.slots.x[k - 1 : k + 1] * [1, -1], rtol=1e-6)


def test_events_name_receivers_and_notes(run: Simulated, rrd: Path) -> None:
    """There are lines about the run, about a long stretch without packets, and the note."""
    shown = new_events(rrd)
    assert "WARN   a note" in shown[5]
    lines = [line for lines in shown.values() for line in lines]
    assert any(line.startswith("WARN   smart lost synchronisation") for line in lines)
    assert any("for the first time" in line for line in lines)


def test_layout_and_styles_are_in_the_file(rrd: Path) -> None:
    """The file alone is enough to look at: it holds the layout, and a static style for every curve and lane."""
    assert RrdReader(rrd).blueprints()
    styled = {str(chunk.entity_path) for chunk in RrdReader(rrd).stream().filter(is_static=True)}
    assert {"/error/legitimate", "/trace/naive", "/theory/smart", "/packets/0_sent", "/packets/4_smart"} <= styled


def test_chunks_do_not_show(run: Simulated, rrd: Path, tmp_path: Path) -> None:
    """However the slots are handed over, the same is recorded."""
    record(run, tmp_path / "other.rrd", chunk=7)
    for entity, component in (
        ("error/naive", "Scalars:scalars"),
        ("packets/3_suspicious", "StateChange:state"),
        ("plane/smart/trail", "LineStrips2D:strips"),
        ("plane/Frame", "LineStrips2D:strips"),
        ("events", "TextDocument:text"),
    ):
        assert rows(tmp_path / "other.rrd", entity, component) == rows(rrd, entity, component)


def test_one_state_is_drawn_over_time(simulated: Callable[..., Simulated], tmp_path: Path) -> None:
    """A process of one state has curves in place of the plane."""
    run = simulated(50, n=1)
    record(run, tmp_path / "r.rrd")
    shown = rows(tmp_path / "r.rrd", "plane/smart", "Scalars:scalars")
    assert [shown[k][0] for k in range(50)] == run.slots.peers["smart"].x_hat[:, 0].tolist()


@pytest.mark.parametrize(("n", "kind"), [(2, StatePlane), (1, StateOverTime)])
def test_a_receiver_may_have_any_name(n: int, kind: type[ViewPanel], simulated: Callable[..., Simulated]) -> None:
    """Also that of something else in the panel: nothing is recorded in place of it, or shown together with it."""
    run = simulated(50, n=n)
    others = {"naive": "truth", "suspicious": "scale", "smart": "attacks"}
    named = tuple(replace(shown, name=others.get(shown.name, shown.name)) for shown in run.scene.receivers)
    panel = kind(replace(run.scene, receivers=named))
    peers = {others.get(name, name): peer for name, peer in run.slots.peers.items()}
    paths = [column.path for column in panel.columns(run.slots.changed(peers=peers))]
    assert len(set(paths)) == len(paths)
    assert {path.split("/")[1] for path in paths} - {shown.name for shown in named} <= {"Truth", "Frame", "Scale"}
    happens: Any = [view.view.contents for view in panel.views()][1]
    assert not any(f"/{name}" in str(path) for name in others.values() for path in happens)


def test_each_input_has_a_curve(run: Simulated) -> None:
    """Also where their names differ in characters that a path cannot have."""
    panel = WhatMovesThePlant(replace(run.scene, moving=("P (kW)", "P [kW]", "α", "β")))
    assert len(panel.styles()) == 4
    moved = Moved(np.arange(4.0 * run.slots.count).reshape(-1, 4))
    columns = list(panel.columns(run.slots.changed(moved=moved)))
    assert [column.path for column in columns] == [*panel.styles()]
    assert len({column.path for column in columns}) == 4


def test_of_a_sensor_that_measures_its_estimate_is_shown(simulated: Callable[..., Simulated]) -> None:
    """The view does not call it the truth, which it does not show."""
    for n in (1, 2):
        run = simulated(20, n=n)
        for of_estimate, word in ((False, "truth"), (True, "sensor's estimate")):
            scene = replace(run.scene, of_estimate=of_estimate)
            panels = [Legend(scene), *(kind(scene) for kind in (StatePlane, StateOverTime) if kind.applies(scene))]
            titles = [str(view.view.name) for panel in panels for view in panel.views()]
            assert any(title.startswith("What happens") for title in titles) is not of_estimate
            assert Legend(scene)._entries()[0][0] == word
            assert any("grey: truth" in title for title in titles) is (n == 1 and not of_estimate)


def test_long_runs_have_bounded_frames() -> None:
    """200 000 slots as fast as they go have some thousand frames, the last slot among them; real time has 30 a second."""
    fast = Scene("", "r", 200_000, 1, 2, 0.0, (), 1.0)
    offsets = np.concatenate([first + frames(fast, first, 1000) for first in range(0, 200_000, 1000)])
    assert len(offsets) <= 4001
    assert offsets[-1] == 199_999
    assert stride(Scene("", "r", 3000, 1, 2, 0.02, (), 1.0)) == 2
    assert stride(Scene("", "r", 300, 1, 2, 0.0, (), 1.0)) == 1


def test_place_that_cannot_be_written_is_told(run: Simulated, tmp_path: Path) -> None:
    """Without a file the run goes on, and the reason is kept."""
    recording = ViewRecording(tmp_path / "missing" / "r.rrd", run.scene)
    for slots in run.chunks(100):
        recording.add(slots)
    recording.close()
    assert recording.failure is not None
    assert "No such file" in recording.failure


def test_slots_that_cannot_be_drawn_end_the_recording_and_not_the_run(
    run: Simulated, simulated: Callable[..., Simulated], tmp_path: Path
) -> None:
    """Slots of another process than the scene's: adding and closing end, and the reason is kept."""
    recording = ViewRecording(tmp_path / "r.rrd", simulated(50, n=1).scene)
    smart = run.slots.peers["smart"]
    recording.add(replace(run.slots, peers={name: replace(smart, x_hat=smart.x_hat[:3]) for name in run.slots.peers}))
    recording.close()
    assert recording.failure is not None


FULL_DISK = """
import os, resource, signal, sys
sys.path.insert(0, sys.argv[1])
from tests.show.view.simulated_run import orbit, simulate
from pathlib import Path
from evedrop.show.view.recording import ViewRecording
run = simulate(orbit(), 900)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
recording = ViewRecording(Path(sys.argv[2]), run.scene)
for slots in run.chunks(300):
    recording.add(slots)
safe = recording.close()
print("safe" if safe else "unsafe", recording.failure, flush=True)
os._exit(0)
"""


@pytest.mark.long
@pytest.mark.parametrize("most", mostly_long([100, 30_000, 80_000], [30_000]))
def test_full_disk_ends_the_recording_and_not_the_run(most: int, tmp_path: Path) -> None:
    """When the file can grow no more, beginning, adding and closing still end in time, and the reason is kept.

    most: its size, which the layout, the styles, or the slots exceed.
    """
    command = [sys.executable, "-B", "-c", FULL_DISK, str(Path(__file__).parent), str(tmp_path / "r.rrd"), str(most)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=True)
    assert done.stdout.startswith("unsafe the recording is incomplete")


def test_close_leaves_no_thread(run: Simulated, tmp_path: Path) -> None:
    """A closed recording has ended its threads; those of other tests, whose viewers hang, are none of its."""
    before = set(threading.enumerate())
    record(run, tmp_path / "r.rrd")
    left = set(threading.enumerate()) - before
    assert not [thread for thread in left if thread.name == "recording"]


def test_a_view_shows_its_content_alone_and_follows_its_own_time_line() -> None:
    """The viewer's panels are hidden, and it plays the newest moment of the time line that the view has."""
    content = rrb.Vertical()
    layout = laid_out(content, "elapsed")
    assert layout.root_container is content
    assert (layout.time_panel.timeline, layout.time_panel.play_state) == ("elapsed", "following")
    hidden = (layout.top_panel, layout.blueprint_panel, layout.selection_panel)
    assert [panel.state for panel in hidden] == ["hidden"] * 3
    assert not (layout.auto_views)
    assert not (layout.auto_layout)

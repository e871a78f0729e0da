import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from simulated_run import Simulated

from emulator.errors import UsageError
from emulator.runs.ports import free_port
from emulator.runs.viewer import Stand, Viewer, choose, open_run
from emulator.view.recording import Recording
from tests.conftest import LIMIT, wait_until

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
SLOTS = 3000
BLOCKED = 4.5
"""Seconds after which the run counts as held up: Rerun itself waits five for a viewer that is not there."""


def gone(pid: int) -> bool:
    """Whether the process has ended, be it as a zombie that its parent has not yet collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


def listening(pid: int) -> list[str]:
    """Local addresses, in hexadecimal, of the sockets a process listens on."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        target = os.readlink(link)
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                found.append(fields[1].split(":")[0])
    return found


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    """A viewer in the browser, without a browser."""
    started = Viewer.start("web", tmp_path / "logs")
    assert started is not None
    yield started
    started.stop()


def test_auto_takes_a_window_only_with_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A window where there is a screen, the browser elsewhere."""
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", ":0")
    assert choose("auto") == "native"
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert choose("auto") == "web"
    with pytest.raises(UsageError, match="--view web"):
        choose("native")
    with pytest.raises(UsageError, match="auto, native, web or off"):
        choose("hologram")


def test_off_starts_nothing(tmp_path: Path) -> None:
    """Without a view there is no viewer."""
    assert Viewer.start("off", tmp_path) is None


@LINUX
def test_only_loopback_listens(viewer: Viewer) -> None:
    """The viewer's two sockets are on 127.0.0.1, and its page is there."""
    assert listening(viewer._process.pid) == ["0100007F", "0100007F"]
    assert viewer.address is not None
    with urllib.request.urlopen(viewer.address, timeout=LIMIT) as page:  # noqa: S310 - our own address
        assert b"<html" in page.read()


def test_stop_ends_it_and_may_be_repeated(viewer: Viewer) -> None:
    """After stop nothing runs, and a second stop is harmless."""
    assert viewer.alive()
    viewer.stop()
    assert not viewer.alive()
    viewer.stop()


@LINUX
def test_a_viewer_is_given_the_screen_and_no_tokens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of our environment it gets what it needs to run and to draw, and nothing else."""
    for name in ("ACCESS_TOKEN", "VK_EXAMPLE", "LC_EXAMPLE"):
        monkeypatch.setenv(name, f"of {name}")
    started = Viewer.start("web", tmp_path)
    assert started is not None
    try:
        given = Path(f"/proc/{started._process.pid}/environ").read_bytes()
    finally:
        started.stop()
    assert {name for name in (b"ACCESS_TOKEN", b"VK_EXAMPLE", b"LC_EXAMPLE") if name in given} == {
        b"VK_EXAMPLE",
        b"LC_EXAMPLE",
    }


@LINUX
def test_hung_viewer_is_stopped(viewer: Viewer) -> None:
    """A viewer that does not react is killed."""
    os.kill(viewer._process.pid, signal.SIGSTOP)
    viewer.stop()
    assert not viewer.alive()


STARTER = """
import sys, time
from pathlib import Path
from emulator.runs.viewer import Viewer
viewer = Viewer.start("web", Path(sys.argv[1]))
print(viewer._process.pid, flush=True)
time.sleep(600)
"""


@LINUX
def test_viewer_dies_with_a_killed_parent(tmp_path: Path) -> None:
    """Nothing is left behind even if we are killed."""
    parent = subprocess.Popen([sys.executable, "-c", STARTER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    with parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert not gone(pid)
        parent.kill()
    wait_until(lambda: gone(pid), "a viewer that ends")


def test_viewer_that_cannot_start_says_why(tmp_path: Path) -> None:
    """A folder without a recording is told from one with."""
    with pytest.raises(UsageError, match=r"recording\.rrd does not exist"):
        open_run(tmp_path, "web")


@pytest.mark.parametrize("fault", ["absent", "frozen", "killed"])
def test_faulty_viewer_changes_nothing(
    fault: str, simulated: Callable[..., Simulated], viewer: Viewer, tmp_path: Path
) -> None:
    """A viewer that is not there, hangs or dies holds up no slot, and the file is complete."""
    run = simulated(SLOTS)
    run = replace(run, scene=replace(run.scene, run=fault))
    url = "rerun+http://127.0.0.1:9/proxy" if fault == "absent" else viewer.url
    recording = Recording(tmp_path / "r.rrd", run.scene, url)
    longest = 0.0
    for slots in run.chunks(100):
        if slots.first == 1000 and fault != "absent":
            os.kill(viewer._process.pid, signal.SIGSTOP if fault == "frozen" else signal.SIGKILL)
        begun = time.monotonic()
        recording.add(slots)
        longest = max(longest, time.monotonic() - begun)
    recording.close()
    assert longest < BLOCKED
    assert recording.failure is None
    viewer._process.kill()
    chunks = RrdReader(tmp_path / "r.rrd").stream().filter(content="/error/smart", is_static=False)
    assert sum(chunk.num_rows for chunk in chunks) == SLOTS


def test_live_viewer_gets_the_run(simulated: Callable[..., Simulated], viewer: Viewer, tmp_path: Path) -> None:
    """With a healthy viewer nothing is left out, and a normal exit is safe."""
    run = simulated(SLOTS)
    recording = Recording(tmp_path / "r.rrd", run.scene, viewer.url)
    for slots in run.chunks(500):
        recording.add(slots)
    recording.close()
    assert recording.dropped == 0


def test_a_view_is_served_where_it_is_wanted(tmp_path: Path) -> None:
    """The page at the port that was asked for, the data at the next; whoever asks for the same place is refused."""
    stand = Stand("127.0.0.1", free_port())
    viewer = Viewer.serve(stand, tmp_path / "logs")
    try:
        data = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{stand.port + 1}%2Fproxy"
        assert viewer.address == f"http://127.0.0.1:{stand.port}/?url={data}"
        with urllib.request.urlopen(f"http://127.0.0.1:{stand.port}/") as page:
            assert page.status == 200
        with pytest.raises(UsageError, match=f":{stand.port} cannot be had"):
            Viewer.serve(stand, tmp_path / "logs")
    finally:
        viewer.stop()


@pytest.mark.parametrize("text", ["", "17450", "here:17450", "127.0.0.1:", "127.0.0.1:65535", "127.0.0.1:x"])
def test_a_place_that_is_none_is_refused(text: str) -> None:
    """An address and a port that has a next one."""
    with pytest.raises(UsageError, match=r"is no address and port; give one such as 127\.0\.0\.1:17450"):
        Stand.of(text)


def test_every_address_is_seen_at_loopback() -> None:
    """What a browser on this machine is to be pointed at."""
    assert Stand.of("0.0.0.0:17450").seen == Stand.of("127.0.0.1:17450").seen == "127.0.0.1"

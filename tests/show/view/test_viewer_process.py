"""Rerun's viewer as a child process: it leaves nothing behind, gets no secrets, and shows nothing to others."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from evedrop.errors import Interrupted, UsageError
from evedrop.show.view import picture, viewer
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.viewer import _LSOF, PortTaken, Viewer, WebAddress, _lsof_says, end, owns, spawn
from evedrop.system.ports import free_port
from tests.conftest import LIMIT, wait_until, with_mark
from tests.privileged import CannotRun, skip
from tests.show.view.simulated_run import Simulated

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
NOBODY = 65_534
THIEF = f"""
import os, socket, sys
os.setgroups([])
os.setgid({NOBODY})
os.setuid({NOBODY})
with socket.create_server(("127.0.0.1", int(sys.argv[1]))) as server:
    print("listens", flush=True)
    while True:
        taken = server.accept()[0]
        taken.settimeout(5)
        print(taken.recv(100), flush=True)
"""
STARTER = """
import sys, time
from pathlib import Path
from evedrop.system.ports import free_port
from evedrop.show.view.viewer import spawn
port = free_port()
print(spawn(port, ["--serve-grpc", "--port", str(port)], Path(sys.argv[1])).pid, flush=True)
time.sleep(600)
"""


def gone(pid: int) -> bool:
    """Whether the process has ended, be it as a zombie that its parent has not yet collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder, empty."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's command as a server, which needs no driver."""
    for name in ("ACCESS_TOKEN", "VK_EXAMPLE", "LC_EXAMPLE"):
        monkeypatch.setenv(name, f"of {name}")
    port = free_port()
    process = spawn(port, ["--serve-grpc", "--port", str(port)], tmp_path)
    yield process
    end(process)


def test_a_viewer_that_draws_leaves_no_temporary_folder(tmp_path: Path, temporary: Path) -> None:
    """Whether it is terminated or ends by itself because there is no driver; folders of other viewers stay."""
    (temporary / "rerun-data-1-other").mkdir()
    port = free_port()
    try:
        process = spawn(port, ["--headless", "--port", str(port)], tmp_path)
    except UsageError as error:
        assert "no Vulkan driver" in str(error)  # noqa: PT017 - the only reason to end
    else:
        wait_until(lambda: process.poll() is not None or len(list(temporary.iterdir())) > 1, "a viewer under way")
        end(process)
    assert [path.name for path in temporary.iterdir()] == ["rerun-data-1-other"]


@LINUX
def test_a_viewer_is_given_the_screen_and_no_tokens(server: subprocess.Popen[bytes]) -> None:
    """Of our environment it gets what it needs to run and to draw, and nothing else."""
    given = Path(f"/proc/{server.pid}/environ").read_bytes()
    assert {name for name in (b"ACCESS_TOKEN", b"VK_EXAMPLE", b"LC_EXAMPLE") if name in given} == {
        b"VK_EXAMPLE",
        b"LC_EXAMPLE",
    }


@LINUX
def test_hung_viewer_is_stopped(server: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that does not react is killed."""
    monkeypatch.setattr(viewer, "_STOP_SECONDS", 0.3)
    os.kill(server.pid, signal.SIGSTOP)
    end(server)
    assert server.poll() is not None


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


def test_who_listens_is_known(tmp_path: Path) -> None:
    """A port is that of the process that listens there; lsof, which macOS is asked with, says the same."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        other = spawn(free := free_port(), ["--serve-grpc", "--port", str(free)], tmp_path)
        try:
            table = {
                (os.getpid(), port): True,
                (os.getpid(), free): False,
                (other.pid, free): True,
                (other.pid, port): False,
            }
            assert {place: owns(*place) for place in table} == table
            if (lsof := Path("/usr/bin/lsof" if sys.platform == "linux" else _LSOF)).exists():
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr("evedrop.show.view.viewer._LSOF", str(lsof))
                    assert {place: _lsof_says(*place) for place in table} == table
        finally:
            end(other)
    assert not owns(os.getpid(), port)


@pytest.fixture
def shared_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system that allows a viewer no network of its own."""
    monkeypatch.setattr("evedrop.show.view.viewer._APART", "")
    monkeypatch.setenv("DISPLAY", ":0")


@pytest.mark.parametrize("how", ["window", "picture"])
@pytest.mark.usefixtures("shared_network")
def test_who_takes_the_port_of_a_viewer_gets_nothing(
    how: str, simulated: Callable[..., Simulated], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rerun would send the recording to another viewer that it finds at its port, as to one that another user runs."""
    run = simulated(300)
    recording = ViewRecording(tmp_path / "r.rrd", run.scene)
    for slots in run.chunks(100):
        recording.add(slots)
    assert recording.close()
    port = free_port()
    monkeypatch.setattr(viewer, "free_port", lambda: port)
    stolen = tmp_path / "stolen.rrd"
    thief = spawn(port, ["--port", str(port), "--save", str(stolen)], tmp_path)
    show: Callable[[], object] = {
        "window": lambda: Viewer.start("native", tmp_path, tmp_path / "r.rrd", complete=True, options=("--headless",)),
        "picture": lambda: picture.opened(tmp_path / "r.rrd", (400, 300)).__enter__(),
    }[how]
    try:
        with pytest.raises(PortTaken, match=f"listens at 127.0.0.1:{port}.*nothing was shown"):
            show()
    finally:
        thief.send_signal(signal.SIGINT)
        end(thief)
    with warnings.catch_warnings(action="ignore"):  # it has no footer
        assert not stolen.exists() or RrdReader(stolen).recordings() == []


def test_a_viewer_that_ends_after_it_listened_is_no_stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is said that it ended, and with which status; or what to install if it found nothing to draw with."""
    program = tmp_path / "viewer"
    listens = (
        "import socket, sys\nsocket.create_server(('127.0.0.1', int(sys.argv[-1]))).accept()\n"
        "print('no graphics adapter' * (len(sys.argv) == 5), *range(9), sep='\\n')\nsys.exit(7)\n"
    )
    program.write_text(f"#!{sys.executable}\n{listens}")
    program.chmod(0o700)

    def asked_too_late(pid: int, port: int) -> bool:
        wait_until(lambda: gone(pid), "the viewer's end")
        return owns(pid, port)

    monkeypatch.setattr(viewer, "executable", lambda: program)
    monkeypatch.setattr(viewer, "owns", asked_too_late)
    port = free_port()
    with pytest.raises(UsageError, match="the viewer ended with status 7"):
        spawn(port, [str(port)], tmp_path)
    with pytest.raises(UsageError, match="mesa-vulkan-drivers"):
        spawn(port, ["--headless", str(port)], tmp_path)


def test_who_waits_for_a_viewer_may_give_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer that does not listen is ended then."""
    program = tmp_path / "viewer"
    program.write_text(f"#!{sys.executable}\nimport time\ntime.sleep(600.0)\n")
    program.chmod(0o700)

    def interrupted() -> None:
        raise Interrupted

    monkeypatch.setattr(viewer, "executable", lambda: program)
    with pytest.raises(Interrupted):
        spawn(free_port(), [], tmp_path, meanwhile=interrupted)
    assert with_mark(str(program)) == {}


@pytest.fixture
def thief() -> Iterator[Callable[[int], subprocess.Popen[str]]]:
    """Starts a listener of another user at a port, and waits until it listens."""
    if sys.platform != "linux" or os.getuid() != 0:
        skip(CannotRun("a second user is needed, which only root can become"))
    processes = []

    def start(port: int) -> subprocess.Popen[str]:
        command = [sys.executable, "-I", "-S", "-c", THIEF, str(port)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd="/")
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "listens\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait(LIMIT)
        assert process.stdout is not None
        process.stdout.close()


@pytest.mark.usefixtures("shared_network")
def test_another_user_at_the_port_of_a_window_gets_nothing(
    thief: Callable[[int], subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """His process is not taken for the viewer, and all that reaches it is connections without a word."""
    port = free_port()
    monkeypatch.setattr("evedrop.show.view.viewer.free_port", lambda: port)
    (tmp_path / "r.rrd").write_bytes(b"the truth" * 1000)
    taken = thief(port)
    with pytest.raises(PortTaken):
        Viewer.start("native", tmp_path, tmp_path / "r.rrd", complete=True)
    taken.kill()
    assert set(taken.communicate(timeout=LIMIT)[0].splitlines()) <= {"b''"}


@pytest.mark.parametrize("which", [0, 1])
def test_another_user_at_the_port_of_a_page_serves_none(
    which: int, thief: Callable[[int], subprocess.Popen[str]], tmp_path: Path
) -> None:
    """Whether he has the port of the page or that of the recording, the command refuses, and serves neither."""
    port, before = free_port(), set(threading.enumerate())
    thief(port + which)
    with pytest.raises(UsageError, match=rf"127\.0\.0\.1:{port + which} cannot be used \(Address already in use\)"):
        Viewer.serve(WebAddress("127.0.0.1", port), tmp_path / "r.rrd")
    with socket.create_server(("127.0.0.1", port + 1 - which)):
        pass  # it is free again
    assert "recording" not in {thread.name for thread in set(threading.enumerate()) - before}, (
        "nobody waits for the files"
    )


def test_a_window_whose_port_is_free_at_the_second_try_opens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that is taken is not the last word."""
    opened = []

    def taken_once(*_: object, **__: object) -> None:
        opened.append(1)
        if len(opened) == 1:
            raise PortTaken("taken")
        raise UsageError("no driver")

    monkeypatch.setattr(viewer, "spawn", taken_once)
    monkeypatch.setenv("DISPLAY", ":0")
    with pytest.raises(UsageError, match="no driver"):
        Viewer.start("native", tmp_path, tmp_path / "r.rrd")
    assert len(opened) == 2

import base64
import contextlib
import errno
import hashlib
import os
import re
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from rerun.chunk import RrdReader

from evedrop.errors import UsageError
from evedrop.show.view.recording import ViewRecording
from evedrop.show.view.serving import Followed, feed, own_page
from evedrop.show.view.viewer import Viewer, WebAddress, choose, open_run
from evedrop.system.ports import free_port
from tests.conftest import LIMIT, wait_until
from tests.examples import mostly_long
from tests.privileged import CannotRun, skip
from tests.show.view.simulated_run import Simulated

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
SLOTS, FEWER = 3000, 1200
"""Of a run that fills what lies between it and a viewer that does not read, and of one that need not."""
BLOCKED = 4.5
"""Seconds after which the run counts as held up: Rerun itself waits five for a viewer that is not there."""


def places(pid: int, port: int | None = None) -> list[str]:
    """Local addresses, in hexadecimal, of the sockets a process listens on, at a port or at any."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile, as that of the folder is
            inodes.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
    addresses = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            address, _, number = fields[1].partition(":")
            if fields[3] == "0A" and fields[9] in inodes and port in {None, int(number, 16)}:
                addresses.append(address)
    return addresses


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    """A viewer in the browser, without a browser."""
    started = Viewer.start("web", tmp_path / "logs", tmp_path / "r.rrd")
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
    with pytest.raises(UsageError, match="choose the web view"):
        choose("native")
    with pytest.raises(UsageError, match="auto, native, web or off"):
        choose("hologram")


def test_off_starts_nothing(tmp_path: Path) -> None:
    """Without a view there is no viewer."""
    assert Viewer.start("off", tmp_path, tmp_path / "r.rrd") is None


@LINUX
def test_only_loopback_listens(viewer: Viewer, tmp_path: Path) -> None:
    """Evedrop itself serves page and recording, on 127.0.0.1: it starts no Rerun process and writes no log."""
    assert viewer.address is not None
    for url in (viewer.address, data_of(viewer)):
        assert places(os.getpid(), urlsplit(url).port) == ["0100007F"]
    assert viewer.pid is None
    assert list(tmp_path.iterdir()) == []


def test_the_page_can_ask_no_other_host(viewer: Viewer) -> None:
    """It names no other host, and its policy allows none: only its own scripts, and the port of the recording."""
    data = urlsplit(data_of(viewer)).netloc
    assert viewer.address is not None
    port = urlsplit(viewer.address).port
    asked = urllib.request.Request(viewer.address, headers={"Host": f"localhost:{port}"})  # noqa: S310 - our own address
    with urllib.request.urlopen(asked, timeout=LIMIT) as reply:  # noqa: S310 - the same
        page = reply.read().decode()
        rules = dict(rule.split(" ", 1) for rule in reply.headers["Content-Security-Policy"].split("; "))
        assert reply.headers["Referrer-Policy"] == "no-referrer"
    assert "<canvas" in page
    assert "wasm_bindgen.WebHandle" in page
    assert "//" not in re.sub(r"(?<!:)//.*", "", page), "no address, with or without a scheme"
    assert "fonts" not in page
    assert rules["default-src"] == rules["frame-ancestors"] == "'none'"
    assert rules["connect-src"].split() == [
        "'self'",
        f"http://{data}",
        f"http://localhost:{urlsplit(data_of(viewer)).port}",
    ]
    inline = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in inline]
    assert inline
    assert rules["script-src"].split() == [
        "'self'",
        "'wasm-unsafe-eval'",
        *(f"'sha256-{digest}'" for digest in digests),
    ]
    for words in rules.values():
        assert not {"*", "http:", "https:", "'unsafe-eval'"} & {*words.split()}
    origin = f"http://127.0.0.1:{port}"
    for name, begin in (("re_viewer.js", b"let wasm_bindgen"), ("re_viewer_bg.wasm", b"\0asm")):
        with urllib.request.urlopen(f"{origin}/{name}", timeout=LIMIT) as reply:  # noqa: S310 - our own address
            assert reply.read(len(begin)) == begin
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{origin}/sw.js", timeout=LIMIT)  # noqa: S310 - the same


def test_links_to_other_hosts_are_dropped_from_any_page() -> None:
    """Fonts are not loaded, and other addresses lead nowhere; what is the page's own stays."""
    page = own_page(
        '<link rel="icon" href="favicon.ico"/>\n<link\n href="https://fonts.example/css"\n rel="stylesheet"/>'
        '<script>s.src = "https://statistics.example/a.js";</script><a href=https://issues.example/new>'
    )
    assert page == '<link rel="icon" href="favicon.ico"/>\n<script>s.src = "#";</script><a href=#>'


def data_of(viewer: Viewer) -> str:
    """Where the page of a viewer finds the recording."""
    assert viewer.address is not None
    return parse_qs(urlsplit(viewer.address).query)["url"][0]


def test_the_recording_is_at_a_secret_address_alone(viewer: Viewer, tmp_path: Path) -> None:
    """A reader with the address gets the file as it grows, to its end; one that knows only the port gets nothing of it."""
    data = data_of(viewer)
    with urllib.request.urlopen(data, timeout=LIMIT) as reply:  # noqa: S310 - the same; and there is no file yet
        assert reply.headers["Access-Control-Allow-Origin"] == "*"
        with (tmp_path / "r.rrd").open("wb", buffering=0) as file:
            for piece in (b"first", b"second"):
                file.write(piece)
                assert reply.read(len(piece)) == piece
            (tmp_path / "r.rrd").rename(tmp_path / "moved.rrd")
            file.write(b"third")
        viewer.complete()
        assert reply.read() == b"third"
    token = urlsplit(data).path.split("/")[1]
    assert len(token) >= 32
    for guess in ("", "/", "/recording.rrd", f"/{token[:-1]}/recording.rrd", f"/{token}", f"/{token}/recording.rrd/"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://{urlsplit(data).netloc}{guess}", timeout=LIMIT)


def test_a_page_for_a_notebook_is_for_this_machine_and_this_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only pages of this machine may frame it. The address is in the notebook's file, so no other user gets the recording."""
    (tmp_path / "r.rrd").write_bytes(b"all")
    started = Viewer.start("notebook", tmp_path, tmp_path / "r.rrd", complete=True)
    assert started is not None
    assert started.address is not None
    try:
        with urllib.request.urlopen(started.address, timeout=LIMIT) as reply:  # noqa: S310 - our own address
            rules = reply.headers["Content-Security-Policy"].split("; ")
        assert "frame-ancestors http://127.0.0.1:* http://localhost:*" in rules
        with urllib.request.urlopen(data_of(started), timeout=LIMIT) as reply:  # noqa: S310 - the same
            assert reply.read() == b"all"
        for user in (os.getuid() + 1, -1):
            monkeypatch.setattr("evedrop.show.view.serving.other_user", lambda _, user=user: user)
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(data_of(started), timeout=LIMIT)  # noqa: S310 - the same
    finally:
        started.stop()


@pytest.fixture
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer readers than the system lets wait for a server, whose further attempts would take seconds."""
    monkeypatch.setattr("evedrop.show.view.bounded_http._MOST_READERS", 2)


@pytest.mark.usefixtures("few_places")
def test_those_who_only_connect_keep_nobody_out_for_long(viewer: Viewer, tmp_path: Path) -> None:
    """Connections that ask for nothing are bounded in number; once they are gone, the recording is served again."""
    data = urlsplit(data_of(viewer))
    (tmp_path / "r.rrd").write_bytes(b"all")
    viewer.complete()
    assert data.hostname is not None
    idle = [socket.create_connection((data.hostname, data.port or 0), LIMIT) for _ in range(3)]
    assert any(connection.recv(1) == b"" for connection in idle[-1:]), "one too many is turned away"
    for connection in idle:
        connection.close()

    def served() -> bytes:
        try:
            with urllib.request.urlopen(data.geturl(), timeout=LIMIT) as reply:  # noqa: S310 - our own address
                return bytes(reply.read())
        except OSError:
            return b""

    assert wait_until(served, "the recording") == b"all"


@pytest.fixture
def headless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A screen for a window, which needs none."""
    monkeypatch.setenv("DISPLAY", ":0")


def window(logs: Path, recording: Path) -> Viewer:
    """A window that shows a recording. Skips the test where nothing can draw one."""
    try:
        started = Viewer.start("native", logs, recording, options=("--headless",))
    except UsageError as error:
        if "graphics adapter" not in str(error) and "render context" not in str(error):
            raise
        skip(CannotRun(f"no Vulkan driver: {error}"))
    assert started is not None
    return started


@LINUX
@pytest.mark.pictures
@pytest.mark.usefixtures("headless")
def test_nobody_can_connect_to_a_window(tmp_path: Path) -> None:
    """Its port is in a network of its own where the system allows that, and else a warning says so."""
    started = window(tmp_path / "logs", tmp_path / "r.rrd")
    try:
        pid = started.pid
        assert started.address is None
        assert pid is not None
        assert places(pid) == ["0100007F"]
        with socket.socket() as probe:
            error = probe.connect_ex(("127.0.0.1", port_of(pid)))
        assert (error == errno.ECONNREFUSED) == (started.warning is None)
    finally:
        started.stop()
    assert not started.alive()


@LINUX
@pytest.mark.pictures
@pytest.mark.usefixtures("headless")
def test_a_window_without_a_network_of_its_own_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the system allows none it is started all the same, and the user is told what others can do."""
    monkeypatch.setattr("evedrop.show.view.viewer._APART", "")
    started = window(tmp_path / "logs", tmp_path / "r.rrd")
    try:
        assert started.warning is not None
        assert "other users of this machine can find the window's port" in started.warning
    finally:
        started.stop()


def port_of(pid: int) -> int:
    """The port among a viewer's arguments."""
    words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    return int(words[words.index("--port") + 1])


def test_a_pipe_gets_the_recording_as_it_grows(tmp_path: Path) -> None:
    """From its beginning to its end, whenever the file is made; a reader that stops holds up no other."""
    followed = Followed(tmp_path / "r.rrd")
    reading, writing = os.pipe()
    feed(followed, os.fdopen(writing, "wb", buffering=0))
    (tmp_path / "r.rrd").write_bytes(b"x" * 3_000_000)
    with open(reading, "rb") as pipe:
        assert pipe.read(1000) == b"x" * 1000
        followed.complete()
        assert len(pipe.read()) == 3_000_000 - 1000
    reading, writing = os.pipe()
    others = set(threading.enumerate())
    feed(followed, os.fdopen(writing, "wb", buffering=0))
    os.close(reading)
    wait_until(lambda: "view" not in {thread.name for thread in set(threading.enumerate()) - others}, "no thread left")


def test_stop_ends_it_and_may_be_repeated(viewer: Viewer) -> None:
    """After stop nothing listens, and a second stop is harmless."""
    assert viewer.alive()
    assert viewer.address is not None
    viewer.stop()
    assert not viewer.alive()
    for url in (viewer.address, data_of(viewer)):
        with pytest.raises(urllib.error.URLError):
            urllib.request.urlopen(url, timeout=LIMIT)  # noqa: S310 - our own address
    viewer.stop()


def test_viewer_that_cannot_start_says_why(tmp_path: Path) -> None:
    """A folder without a recording is told from one with."""
    with pytest.raises(UsageError, match=r"recording\.rrd does not exist"):
        open_run(tmp_path, "web")


@pytest.mark.parametrize("fault", mostly_long(["frozen", "killed", "unread"], ["killed"]))
def test_faulty_viewer_changes_nothing(
    fault: str, simulated: Callable[..., Simulated], viewer: Viewer, tmp_path: Path
) -> None:
    """A window that hangs or dies, and a browser that does not read what it asked for, hold up no slot; the file is complete."""
    run = simulated(slots := SLOTS if fault != "killed" else FEWER)
    run = replace(run, scene=replace(run.scene, run=fault))
    recording = ViewRecording(tmp_path / "r.rrd", run.scene)
    longest = 0.0
    followed = Followed(tmp_path / "r.rrd")
    reading, writing = os.pipe()
    feed(followed, os.fdopen(writing, "wb", buffering=0))
    with open(reading, "rb", buffering=0) as pipe, urllib.request.urlopen(data_of(viewer), timeout=LIMIT):  # noqa: S310
        for some in run.chunks(100):
            if some.first == 1000 and fault == "killed":
                pipe.close()
            begun = time.monotonic()
            recording.add(some)
            longest = max(longest, time.monotonic() - begun)
        assert recording.close()
        viewer.stop()
        followed.complete()
    assert longest < BLOCKED
    chunks = RrdReader(tmp_path / "r.rrd").stream().filter(content="/error/smart", is_static=False)
    assert sum(chunk.num_rows for chunk in chunks) == slots


def test_a_browser_gets_the_run(simulated: Callable[..., Simulated], viewer: Viewer, tmp_path: Path) -> None:
    """The bytes served while a run is recorded are the whole recording."""
    run = simulated(FEWER)
    recording = ViewRecording(tmp_path / "r.rrd", run.scene)
    with urllib.request.urlopen(data_of(viewer), timeout=LIMIT) as reply:  # noqa: S310 - our own address
        for slots in run.chunks(500):
            recording.add(slots)
        assert recording.close()
        viewer.complete()
        assert reply.read() == (tmp_path / "r.rrd").read_bytes()


def test_a_view_is_served_where_it_is_wanted(tmp_path: Path) -> None:
    """The page at the port that was asked for, the data at the next; a second request for the same port is refused."""
    web_address = WebAddress("127.0.0.1", free_port())
    viewer = Viewer.serve(web_address, tmp_path / "r.rrd")
    try:
        assert viewer.address is not None
        assert viewer.address.startswith(f"http://127.0.0.1:{web_address.port}/?url=")
        assert data_of(viewer).startswith(f"http://127.0.0.1:{web_address.port + 1}/")
        with urllib.request.urlopen(f"http://127.0.0.1:{web_address.port}/") as page:
            assert page.status == 200
        with pytest.raises(UsageError, match=f"--serve 127.0.0.1:{web_address.port}: .* cannot be used"):
            Viewer.serve(web_address, tmp_path / "r.rrd")
    finally:
        viewer.stop()


@pytest.mark.parametrize("text", ["", "17450", "here:17450", "127.0.0.1:", "127.0.0.1:65535", "127.0.0.1:x"])
def test_a_place_that_is_none_is_refused(text: str) -> None:
    """An address and a port that has a next one."""
    with pytest.raises(UsageError, match=r"is not an address and port; give one such as 127\.0\.0\.1:17450"):
        WebAddress.of(text)


def test_every_address_is_seen_at_loopback() -> None:
    """The address for a browser on this machine."""
    assert WebAddress.of("0.0.0.0:17450").seen == WebAddress.of("127.0.0.1:17450").seen == "127.0.0.1"

"""The page comes from the installed Rerun: it is what Rerun itself serves, and nothing else is taken for it."""

from __future__ import annotations

import errno
import http.client
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from evedrop.errors import UsageError
from evedrop.show.view.serving import Followed, RerunPage, Served
from evedrop.show.view.viewer import end, executable, spawn
from evedrop.system.lacks import lack_of
from evedrop.system.ports import free_port
from tests.conftest import LIMIT, wait_until

PAGE = b"<!doctype html>\n<script src=re_viewer.js></script>\n</html>\n"
SCRIPT = b"let wasm_bindgen = (function() {\n    WebAssembly.instantiate();\n})({ __proto__: null });\n"
MODULE = (
    b"\0asm\1\0\0\0"
    b"\1\5\1\x60\0\1\x7f"  # a type: no argument, an i32
    b"\3\2\1\0"  # a function of this type
    b"\x0a\6\1\4\0\x41\x07\x0b"  # its code: 7
    b"\0\x08\4nameabc"  # a custom section
)


@pytest.fixture(scope="module")
def rerun() -> RerunPage:
    """The page of the installed Rerun."""
    return RerunPage(executable())


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where Rerun itself serves its page."""
    port = free_port()
    words = ["--serve-web", "--web-viewer-port", str(port), "rerun+http://127.0.0.1:9/proxy"]
    process = spawn(port, words, tmp_path_factory.mktemp("logs"))
    yield f"http://127.0.0.1:{port}"
    end(process)


def served(url: str) -> bytes:
    """The content at an address."""
    with urllib.request.urlopen(url, timeout=LIMIT) as reply:  # noqa: S310 - of loopback
        return bytes(reply.read())


def test_a_reader_that_left_has_no_place(tmp_path: Path) -> None:
    """A browser may load the page of a paused run any number of times."""
    (tmp_path / "r.rrd").write_bytes(b"abc")
    followed = Followed(tmp_path / "r.rrd")
    served_at = Served(followed, "127.0.0.1", 0)
    try:
        for _ in range(40):
            wait_until(lambda: first_bytes(served_at) == b"abc", "the recording")
    finally:
        followed.complete()
        served_at.stop()


def threads_named(name: str) -> set[threading.Thread]:
    """All threads with this name, also those that other tests started."""
    return {thread for thread in threading.enumerate() if thread.name == name}


def first_bytes(served_at: Served) -> bytes:
    """What a reader gets who leaves at once; nothing without a place."""
    try:
        with urllib.request.urlopen(
            f"http://127.0.0.1:{served_at.server_port}{served_at.path}", timeout=LIMIT
        ) as reply:
            return bytes(reply.read(3))
    except (OSError, http.client.HTTPException):
        return b""


def test_a_recording_is_found_although_its_folder_was_moved(tmp_path: Path) -> None:
    """The first reader may come later than that."""
    others = threads_named("recording")
    followed = Followed(tmp_path / "run" / "r.rrd")
    followed.open_early()
    (opener,) = threads_named("recording") - others
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "r.rrd").write_bytes(b"abc")
    opener.join(LIMIT)
    (tmp_path / "run").rename(tmp_path / "moved")
    followed.complete()
    assert b"".join(followed.pieces()) == b"abc"


def test_the_page_is_what_rerun_serves(rerun: RerunPage, theirs: str) -> None:
    """Page, script and program, byte by byte; only a remark after the page is left out."""
    assert b"".join(rerun.pieces(rerun.script)) == served(f"{theirs}/re_viewer.js")
    assert b"".join(rerun.pieces(rerun.program)) == served(f"{theirs}/re_viewer_bg.wasm")
    page, html = served(theirs), rerun.html.encode()
    assert page.startswith(html)
    rest = page[len(html) :].strip()
    assert rest.startswith(b"<!--")
    assert rest.find(b"-->") == len(rest) - 3


def test_the_parts_are_where_they_are(tmp_path: Path) -> None:
    """In any order, with other pages, scripts and modules before them, and any bytes after them."""
    decoys = [
        b"<!doctype html>\n</html>\n",
        b"let wasm_bindgen;\n})(",
        b"\0asm\1\0\0\0<html>",
        b"\0asm\1\0\0\0\1\2\0\0\xff",
        b"\0asm\1\0\0\0\1\xff\xff\xff\xff\xff\xff",
        MODULE[:15],
    ]
    for order in ((PAGE, SCRIPT, MODULE), (MODULE, PAGE, SCRIPT)):
        for after in (b"", b"\0\0\0\0", b"\0\2\0\0", b"\1\1\0", b"\xff", b"\0asm\1\0\0\0", b"\0\x7f\1\xff"):
            (tmp_path / "rerun").write_bytes(b"ELF" + b"..".join([*decoys, *(part + after for part in order)]))
            page = RerunPage(tmp_path / "rerun")
            assert page.html.encode() == PAGE
            assert b"".join(page.pieces(page.script)) == SCRIPT
            assert b"".join(page.pieces(page.program)) == MODULE


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "empty file"),
        (SCRIPT + MODULE, "<!doctype html>"),
        (PAGE + MODULE, "let wasm_bindgen"),
        (PAGE + SCRIPT, "WebAssembly module"),
        (PAGE + SCRIPT + MODULE[:19], "WebAssembly module"),
        (PAGE.replace(b"src", b"\xff") + SCRIPT + MODULE, "decode"),
    ],
)
def test_a_command_without_a_page_is_refused(content: bytes, why: str, tmp_path: Path) -> None:
    """The sentence says what is missing and what to do."""
    (tmp_path / "rerun").write_bytes(content)
    with pytest.raises(
        UsageError, match=f"the page of the view cannot be read from .*rerun .*{why}.*choose the native"
    ):
        RerunPage(tmp_path / "rerun")
    with pytest.raises(UsageError, match="No such file"):
        RerunPage(tmp_path / "other")


def test_too_little_memory_for_the_page_is_not_taken_for_another_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machine lacks something, and no other version would help."""

    def without_memory(*_: object, **_also: object) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    (tmp_path / "rerun").write_bytes(PAGE + SCRIPT + MODULE)
    monkeypatch.setattr("evedrop.show.view.serving.mmap.mmap", without_memory)
    with pytest.raises(OSError, match="Cannot allocate memory") as raised:
        RerunPage(tmp_path / "rerun")
    assert lack_of(raised.value) is not None


def test_a_replaced_command_changes_no_page(tmp_path: Path) -> None:
    """Another version that is installed meanwhile does not mix with this one; a file that is cut short ends the reply."""
    command = tmp_path / "rerun"
    command.write_bytes(PAGE + SCRIPT + MODULE)
    rerun = RerunPage(command)
    (tmp_path / "new").write_bytes(b"new")
    (tmp_path / "new").rename(command)
    assert b"".join(rerun.pieces(rerun.program)) == MODULE
    command.write_bytes(PAGE + SCRIPT + MODULE)
    rerun = RerunPage(command)
    command.write_bytes(b"")
    with pytest.raises(EOFError):
        list(rerun.pieces(rerun.program))

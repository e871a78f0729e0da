"""Zenoh's log of processes that others connect to: strangers' bytes steer no terminal, and fill no disk."""

from __future__ import annotations

import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from evedrop.system import native_log
from evedrop.system.native_log import native_log_apart
from evedrop.system.output import Output, escaped
from evedrop.system.ports import free_port
from tests.conftest import Evedrop, wait_until

MOST = 140_000
"""Bytes that a log may have at most, with what else is in it."""
END = "evedrop: Zenoh has logged 128 KiB; its further lines are left out"
PROGRAM = r"""
import os, sys
from evedrop.system import native_log
from evedrop.system.native_log import native_log_apart
from evedrop.system.output import standard_streams
with standard_streams():
    print("before")
    with native_log_apart():
        print("within")
        os.write(1, b"\x1b[31mERROR\x1b[0m \x1b]0;OWNED\x07 \xe2\x80\xae evedrop: not ours\n")
        for _ in range(int(sys.argv[1])):
            assert os.write(1, b"x" * 999 + b"\n") == 1000
        print("later")
    os.write(1, b"as it was\n")
    print("after")
"""


def frame(length: int) -> bytes:
    """A message of Zenoh with an extension that nobody knows, which Zenoh writes into its log four times as long."""
    size = bytes([length & 0x7F | 0x80, length >> 7 & 0x7F | 0x80, length >> 14])
    message = b"\x84\x54" + size + b"x" * length
    return struct.pack("<H", len(message)) + message


def flood(port: int, count: int = 5) -> None:
    """Send such messages to a router, without credentials, and wait for its replies."""
    for _ in range(count):
        with socket.create_connection(("127.0.0.1", port), 60) as stranger:
            stranger.settimeout(60)
            stranger.sendall(frame(30_000))
            stranger.recv(10)


@pytest.mark.parametrize("lines", [0, 1000])
def test_what_is_written_to_descriptor_1_is_passed_on(lines: int) -> None:
    """Escaped, marked and no more than so much, to standard error; Python's own lines stay on standard output."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(lines)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.stdout.splitlines() == ["before", "within", "later", "as it was", "after"], done.stderr
    first, *others = done.stderr.splitlines()
    assert first == r"zenoh: ERROR \x1b]0;OWNED\x07 \u202e evedrop: not ours"
    if lines:
        assert others[-1] == END
        assert len(done.stderr) < MOST
        assert set(others[:-1]) == {f"zenoh: {'x' * 999}"}
    else:
        assert others == []


def test_a_log_can_be_written_while_nobody_reads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh neither waits nor writes to standard error itself while the thread that passes its lines on stands still.

    What a pipe has no room for, Zenoh wrote to standard error, neither marked nor escaped.
    """
    goes_on, passed_on = threading.Event(), []

    def write(text: str) -> None:
        assert goes_on.wait(60)
        passed_on.append(text)

    monkeypatch.setattr(native_log, "_write", write)
    with native_log.native_log_apart():
        for _ in range(100):
            assert os.write(1, b"x" * 9_999 + b"\n") == 10_000
        goes_on.set()
    assert passed_on[-1].startswith("evedrop: Zenoh has logged 128 KiB")
    assert sum(map(len, passed_on)) < MOST


def test_without_a_stream_of_ours_nothing_is_moved(capfd: pytest.CaptureFixture[str]) -> None:
    """A standard output that is not at descriptor 1, or not ours, stays as it is; the log goes to standard error."""
    with native_log_apart():
        os.write(1, b"a line\n")
    assert capfd.readouterr().err == "zenoh: a line\n"


def test_a_stream_returns_to_its_place(tmp_path: Path) -> None:
    """What is written meanwhile goes to the other descriptor; a full disk is noticed there, too."""
    with (tmp_path / "here").open("w") as here, (tmp_path / "there").open("w") as there:
        output = Output(here)
        output.write("one\n")
        with output.at(there.fileno(), of=here.fileno()):
            output.write("two\n")
        output.write("three\n")
        output.flush()
        with output.at(there.fileno(), of=12345):
            output.write("four\n")
        with open("/dev/full", "w") as full, output.at(full.fileno(), of=here.fileno()):
            output.write("lost\n")
        assert output.failed is not None
        output.write("lost\n")
    assert (tmp_path / "here").read_text() == "one\nthree\nfour\n"
    assert (tmp_path / "there").read_text() == "two\n"


WIRE = """
[side.robot]
listen = "tcp/127.0.0.1:{port}"
[side.base]
listen = "tcp/127.0.0.1:0"
[[link]]
from = "robot"
to = "base"
quality = 1.0
"""


@pytest.mark.parametrize("logged", [None, "error"])
def test_strangers_at_a_wire_reach_no_terminal(logged: str | None, evedrop: Evedrop) -> None:
    """By default Zenoh says nothing of frames that it cannot read; with RUST_LOG it does, within the limit, and escaped."""
    port = free_port()
    (evedrop.folder / "wire.toml").write_text(WIRE.format(port=port), encoding="utf-8")
    environment = {**evedrop.environment, **({} if logged is None else {"RUST_LOG": logged})}
    live = evedrop.started("wire", "wire.toml", env=environment)
    wait_until((live.folder / "control.json").exists, "the wire")
    flood(port)
    live.process.send_signal(signal.SIGINT)
    done = live.end()
    text = done.out + done.err
    assert "results: run" in done.out
    assert "ERROR" not in done.out
    assert escaped(text) == text
    if logged is None:
        assert "zenoh: " not in done.err
    else:
        assert re.search(r"^zenoh: \S+ ERROR .*Unknown", done.err, re.MULTILINE)
        assert END in done.err
        assert len(done.err) < MOST


@pytest.mark.thorough
def test_strangers_at_a_router_fill_no_log(evedrop: Evedrop) -> None:
    """Its log ends at the limit, and the run goes on."""
    port = free_port()
    options = ("--slots", "100000", "--set", "pace=0.002", "--listen", f"tcp/127.0.0.1:{port}")
    live = evedrop.live("eavesdroppers", *options, env={**evedrop.environment, "RUST_LOG": "error"})
    live.running()
    log = live.folder / "logs" / "router.log"
    flood(port)
    wait_until(lambda: END in log.read_text(), "the end of the log")
    flood(port)
    assert evedrop("status", "run").status == 0
    live.process.terminate()
    assert live.end().status == 130
    assert log.stat().st_size < MOST
    assert escaped(log.read_text()) == log.read_text()

"""What a launcher writes to the standard input of a process."""

from __future__ import annotations

import os
import threading

import pytest

from evedrop.live.network.launcher_pipe import input_lines


def lines_of(data: bytes, monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The lines that are read where a pipe brings this."""
    read, write = os.pipe()
    with os.fdopen(read, "rb") as source, os.fdopen(write, "wb") as sink:

        def send() -> None:
            sink.write(data)
            sink.close()

        sender, system_read = threading.Thread(target=send), os.read
        monkeypatch.setattr(os, "read", lambda _, most: system_read(source.fileno(), most))
        sender.start()
        lines = list(input_lines())
        sender.join()
    return lines


@pytest.mark.parametrize("end", [b"", b"cut off"])
def test_lines_are_whole_wherever_they_are_parted(end: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many in one part, an empty one, and one of many parts; what the end cuts off is no line."""
    lines = [b"a", b"", b"b" * 2_000_000, b"c"]
    assert lines_of(b"".join(line + b"\n" for line in lines) + end, monkeypatch) == lines

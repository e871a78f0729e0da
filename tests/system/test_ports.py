"""Ports on loopback."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

import pytest

from evedrop.system import ports
from evedrop.system.ports import other_user
from tests.conftest import LIMIT


def test_the_user_at_the_other_end_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a connection on this machine; -1 once the other end is closed, None where the system has no such table."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LIMIT)
        with socket.create_connection(server.getsockname(), LIMIT) as client:
            connection, _ = server.accept()
            with connection:
                if sys.platform == "linux":
                    assert other_user(connection) == other_user(client) == os.getuid()
                    table = tmp_path / "tcp"
                    ends = [ports._in_table(*end) for end in (connection.getpeername(), connection.getsockname())]
                    others = f"0: {ends[1]} {ends[0]} 01 0:0 0:0 0 4321 0 1"  # the same connection, seen from this end
                    table.write_text(f"the heads\n{others}\n")
                    monkeypatch.setattr(ports, "_TABLE", table)
                    assert other_user(connection) == -1
                monkeypatch.setattr(ports, "_TABLE", tmp_path / "none")
                assert other_user(connection) is None

"""A process that waits for its router says so, and takes no cut connection for a refusal."""

from __future__ import annotations

import contextlib
import re
import socket
import ssl
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from evedrop.errors import RunError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.network import connecting
from evedrop.live.network.connecting import Failures
from evedrop.live.network.control_file import Control
from evedrop.live.network.session import Session
from evedrop.live.protocol.keys import ZenohConfig
from evedrop.system.ports import free_port
from tests.clock import time_of_a_test
from tests.live.network.bench import small_network


def test_a_process_says_that_it_waits_for_its_router(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Every few seconds, on standard error: who waits, for which router, for how long, and what came of the last attempt."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    brief = briefs_of(small_network(), endpoints_at(endpoint), RecorderTask(tmp_path, False), ends_with_stdin=False)[
        "eve"
    ]
    with time_of_a_test(), pytest.raises(RunError, match="no router answered"):
        Session(replace(brief, patience=10))
    lines = capfd.readouterr().err.splitlines()
    line = rf"evedrop: eve: waiting for the router at {endpoint}: no answer yet \((3|6|9) s; Connection refused\)"
    assert [bool(re.fullmatch(line, text)) for text in lines] == [True] * len(lines)
    assert len(lines) == 3


@contextlib.contextmanager
def listener(lasting: float | None) -> Iterator[tuple[Control, ZenohConfig]]:
    """A listener that ends every connection after this number of seconds, unless the client ends it first."""
    with socket.create_server(("127.0.0.1", 0)) as server, contextlib.ExitStack() as links:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    link = links.enter_context(server.accept()[0])
                    if lasting is not None:
                        threading.Timer(lasting, lambda link=link: link.shutdown(socket.SHUT_RDWR)).start()

        threading.Thread(target=accept, daemon=True).start()
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        config = {
            "mode": "client",
            "connect": {"endpoints": [endpoint], "timeout_ms": 0, "exit_on_failure": True},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"unicast": {"open_timeout": 500}},
        }
        yield Control("r01", endpoint, "operator", ""), config
        server.shutdown(socket.SHUT_RDWR)


@pytest.mark.long
def test_a_network_that_cuts_connections_is_no_refusal() -> None:
    """Connections that flap are lost in the middle of a handshake, as of a router that refuses; an idle one is lost as well."""
    with listener(0.3) as given, pytest.raises(RunError, match="no router answered"):
        connecting.connected(*given, 6.0)


@pytest.mark.thorough
@pytest.mark.parametrize("lasting", [0.0, None], ids=["hangs up on everybody", "says nothing"])
def test_what_ends_connections_by_itself_is_not_the_network(lasting: float | None) -> None:
    """A program that hangs up at once, and one, as a router that refused a brief, that keeps an idle connection."""
    with listener(lasting) as (control, _):
        assert not connecting.cut_off(connecting.endpoint_of(control.router, None))


def test_a_connection_that_ends_before_there_is_a_certificate_is_no_refusal(tmp_path: Path) -> None:
    """A proxy accepts and hangs up while its router is down: a process waits for it as for one that does not listen."""
    with listener(0.0) as (control, _):
        endpoint = control.router.replace("tcp/", "tls/")
        brief = briefs_of(
            small_network(), endpoints_at(endpoint), RecorderTask(tmp_path, False), ends_with_stdin=False
        )["eve"]
        assert brief.identity is not None
        with time_of_a_test(), pytest.raises(RunError, match=r"no router answered at .* within 10 s"):
            Session(replace(brief, patience=10))


@pytest.mark.parametrize("error", [ssl.SSLEOFError, ssl.SSLZeroReturnError, ConnectionResetError, BrokenPipeError])
@pytest.mark.parametrize("secure", [True, False])
def test_a_connection_that_ends_is_a_refusal_only_unencrypted(error: type[OSError], secure: bool) -> None:
    """With each of the errors by which versions of Python and of OpenSSL report it."""
    failures = Failures(secure)
    with time_of_a_test() as clock:
        for _ in range(8):
            failures.add_attempt(error("the connection has been closed"), 0.1)
            clock.sleep(1.0)
        assert failures.refused is not secure

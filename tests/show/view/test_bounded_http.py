"""The HTTP servers of views and metrics refuse requests that name a foreign host."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from evedrop.live.launch.metrics_server import MetricsAddress, RunMetrics, metrics_served
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import silent
from evedrop.show.view.bounded_http import own_host
from evedrop.show.view.viewer import Viewer
from tests.conftest import LIMIT

OWN = {
    "127.0.0.1": "127.0.0.1",
    "127.0.0.1:13708": "127.0.0.1",
    "10.1.2.3:80": "10.1.2.3",
    "LOCALHOST:9000": "localhost",
    "[::1]:9464": "[::1]",
    "[FE80::1]": "[fe80::1]",
    "recorder:9464": "recorder",
    "view.localhost": "view.localhost",
    "host.docker.internal:9464": "host.docker.internal",
    "laboratory.example:80": "laboratory.example",
    "laboratory.local": "laboratory.local",
}
FOREIGN = (
    *("evil.example", "evil.example:13708", "127.0.0.1.evil.example", "localhost.evil.example", "evil.local"),
    *("laboratory.local.evil.example", "127.0.0.1.", "127.0.0.256", "1.2.3", "[::1", "[evil]", "[127.0.0.1]", "::1"),
    *("", "a b", "evil.example/127.0.0.1", "user@localhost", "localhost:port", "localhost:123456", "f\u00fcr", "a,b"),
)


@pytest.fixture(autouse=True)
def _machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Laboratory.example")


@pytest.mark.parametrize(("text", "host"), OWN.items())
def test_addresses_and_private_names_are_our_own(text: str, host: str) -> None:
    """Names that cannot belong to somebody else, also by a forwarded port."""
    assert own_host(text) == host


@pytest.mark.parametrize("text", FOREIGN)
def test_other_names_are_foreign(text: str) -> None:
    """A name that may point to our address, and texts that are not hosts."""
    assert own_host(text) is None


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Viewer]:
    """A view in a browser."""
    viewer = Viewer.start("web", tmp_path / "logs", tmp_path / "r.rrd")
    assert viewer is not None
    (tmp_path / "r.rrd").write_bytes(b"the truth")
    viewer.complete()
    yield viewer
    viewer.stop()


@pytest.fixture
def url_of(page: Viewer, tmp_path: Path) -> Iterator[Callable[[str], str]]:
    """The address of a server."""
    assert page.address is not None
    scenario = load("eavesdroppers")
    with metrics_served(MetricsAddress("127.0.0.1", 0), RunMetrics(scenario, tmp_path, silent)) as metrics:
        urls = {"page": page.address, "recording": parse_qs(urlsplit(page.address).query)["url"][0], "metrics": metrics}
        yield urls.__getitem__


def ask(url: str, *hosts: str) -> tuple[int, bytes]:
    """The status and the content of a reply to a request with these Host headers."""
    place = urlsplit(url)
    assert place.hostname is not None
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=LIMIT)
    connection.putrequest("GET", f"{place.path}?{place.query}" if place.query else place.path, skip_host=True)
    for host in hosts:
        connection.putheader("Host", host)
    connection.endheaders()
    reply = connection.getresponse()
    content = reply.read()
    connection.close()
    return reply.status, content


@pytest.mark.parametrize("server", ["page", "recording", "metrics"])
def test_a_foreign_host_is_misdirected(server: str, url_of: Callable[[str], str]) -> None:
    """421 for a foreign name, 400 for none or two; our own get the content."""
    url = url_of(server)
    status, content = ask(url, urlsplit(url).netloc)
    assert status == 200
    assert content
    assert ask(url, "localhost:1")[0] == 200, "a port that ssh forwards may have another number"
    status, refused = ask(url, "evil.example")
    assert status == 421
    assert b"the address that Evedrop printed" in refused
    for hosts in ((), ("127.0.0.1", "evil.example"), ("evil.example", "127.0.0.1")):
        assert ask(url, *hosts)[0] == 400

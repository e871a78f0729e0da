"""The simulated check of a router's certificate finds what OpenSSL finds."""

from __future__ import annotations

import datetime
import socket
import ssl
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from evedrop.live.network.certificates import Authority
from evedrop.live.protocol.brief import Identity
from evedrop.system.world import RealWorld
from evedrop.virtual.zenoh.certificates import check

NOW = time.time()
HOST = "127.0.0.1"


def shown(identity: Identity, trust: ssl.SSLContext, host: str, folder: Path) -> bytes:
    """The certificate of a real server, which the machine's OpenSSL checks."""
    files = folder / "certificate", folder / "key"
    for file, text in zip(files, (identity.certificate, identity.key), strict=True):
        file.write_text(text)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*files)
    mine, its = socket.socketpair()

    def serve() -> None:
        with suppress(OSError), context.wrap_socket(its, server_side=True) as secured:
            secured.recv(1)

    server = threading.Thread(target=serve)
    server.start()
    try:
        with mine:
            return RealWorld().certificate(mine, trust, host)
    finally:
        server.join()


def trusting(authority: str | None) -> ssl.SSLContext:
    """A context that trusts an authority, or everybody."""
    context = ssl.create_default_context(cadata=authority)
    if authority is None:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


@pytest.mark.parametrize(
    ("made", "hosts", "host", "trusted", "code"),
    [
        (0, [HOST], HOST, True, None),
        (0, ["router.lan"], "router.lan", True, None),
        (0, [HOST], "router.lan", True, 62),
        (0, ["router.lan"], HOST, True, 64),
        (0, [], HOST, True, 26),
        (-90, [HOST], HOST, True, 10),
        (90, [HOST], HOST, True, 9),
        (0, [HOST], HOST, False, 20),
        (-90, ["router.lan"], HOST, None, None),
    ],
)
def test_it_finds_what_openssl_finds(
    made: int, hosts: list[str], host: str, trusted: bool | None, code: int | None, tmp_path: Path
) -> None:
    """The first problem alone; made: so many days ago; trusted: whether its maker is trusted, None: everybody is."""
    authority = Authority("r", datetime.datetime.fromtimestamp(NOW, datetime.UTC) + datetime.timedelta(days=made))
    identity = authority.identity("router", hosts)
    other = Authority("other").identity("router", [HOST])
    trust = trusting(None if trusted is None else (identity if trusted else other).authority)
    der = ssl.PEM_cert_to_DER_cert(identity.certificate)
    if code is None:
        assert shown(identity, trust, host, tmp_path) == der
        check(der, trust, host, NOW)
        return
    with pytest.raises(ssl.SSLCertVerificationError) as real:
        shown(identity, trust, host, tmp_path)
    with pytest.raises(ssl.SSLCertVerificationError) as simulated:
        check(der, trust, host, NOW)
    assert real.value.verify_code == simulated.value.verify_code == code

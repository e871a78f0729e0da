"""Addresses of a router, as `evedrop brief` takes them: where it listens, and where the other processes connect."""

from __future__ import annotations

import pytest

from evedrop.errors import UsageError
from evedrop.live.launch.ports import RouterEndpoint, router_endpoint


@pytest.mark.parametrize(
    ("listen", "connect", "message"),
    [
        (
            "tcp/0.0.0.0:7447",
            "tcp/router.lan:7447",
            r"not encrypted, and other.*give tls/0\.0\.0\.0:7447, or add --insecure",
        ),
        ("tcp/router.lan:7447", None, "is not encrypted"),
        ("tcp/[::]:7447", "tcp/10.0.0.7:7447", "is not encrypted"),
        ("tls/0.0.0.0:7447", None, r"nothing can connect to it; add --connect tls/HOST:7447"),
        ("tls/router.lan:7447", "tls/0.0.0.0:7447", "--connect tls/0.0.0.0:7447 means every address"),
        ("tls/0.0.0.0:7447", "tcp/router.lan:7447", "differs in protocol from --listen tls/0.0.0.0:7447"),
        ("tls/[::]:7447", "tls/[fe80::1]:7447", r"^--connect .*give the host's name"),
        ("tls/[::1]:7447", None, r"^--listen tls/\[::1\]:7447: no certificate"),
        ("7447", None, "--listen 7447 is not an endpoint; give one such as tls/router.lan:7447"),
        ("tls/router.lan", None, "is not an endpoint"),
        ("tls/router.lan:0", None, "names no port"),
        ("tls/router..lan:7447", None, "names no host"),
        ("tls/127.1:7447", None, "names no host"),
        ("tls/router.lan:7447", "tls/192.168.1.256:7447", "names no host"),
        ("tls/[12]:7447", None, "names no address"),
        ("quic/router.lan:7447", None, "is not an endpoint"),
        ("tls/0.0.0.0:7447", "router.lan", "--connect router.lan is not an endpoint"),
    ],
)
def test_addresses_at_which_no_router_can_be_reached_are_refused(
    listen: str, connect: str | None, message: str
) -> None:
    """Each with the option and what to give instead."""
    with pytest.raises(UsageError, match=message) as caught:
        router_endpoint(listen, connect)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("listen", "connect", "names"),
    [
        ("tls/0.0.0.0:7447", "tls/router.lan:7447", ("router.lan",)),
        ("tls/10.0.0.7:7447", None, ("10.0.0.7",)),
        ("tls/10.0.0.7:7447", "tls/router.lan:80", ("router.lan", "10.0.0.7")),
        ("tcp/127.0.0.9:7447", None, ("127.0.0.9",)),
        ("tcp/[::1]:7447", "tcp/tunnel.lan:7447", ("tunnel.lan", "::1")),
    ],
)
def test_a_router_is_known_by_its_names(listen: str, connect: str | None, names: tuple[str, ...]) -> None:
    """What is connected to, then what is listened on; unencrypted on loopback alone, unless the user says otherwise."""
    result = router_endpoint(listen, connect)
    assert result.names == names
    assert (str(result.listen), str(result.connect)) == (listen, connect or listen)
    assert result.secure == listen.startswith("tls/")
    assert isinstance(router_endpoint("tcp/0.0.0.0:7447", "tcp/a:7447", insecure=True), RouterEndpoint)

"""Opening the session of a router, which listens where the brief says."""

from __future__ import annotations

import json
import socket

import zenoh

from evedrop.errors import BriefError
from evedrop.live.network.connecting import endpoint_of
from evedrop.live.network.endpoint import AnyEndpoint, SocketEndpoint
from evedrop.live.network.opening import open_session
from evedrop.live.protocol.brief_parts import Identity
from evedrop.live.protocol.keys import ZenohConfig


def listening(listen: str, identity: Identity | None, config: ZenohConfig) -> zenoh.Session:
    """Open a router's session. Raises BriefError if it cannot listen at the address in its brief."""
    endpoint = endpoint_of(listen, identity)
    try:
        endpoint.try_to_listen()
        return open_session(zenoh.Config.from_json5(json.dumps(config)))
    except (OSError, zenoh.ZError) as error:
        raise _cannot_listen(endpoint, error) from error


def _cannot_listen(endpoint: AnyEndpoint, error: OSError | zenoh.ZError) -> BriefError:
    """The error of a router that cannot listen, with the remedy."""
    why = (error.strerror or error) if isinstance(error, OSError) else error
    if isinstance(endpoint, SocketEndpoint):
        return BriefError(
            f"the router cannot listen at {endpoint} ({why}); set TMPDIR to a folder where sockets can be made, or run again "
            "with --listen tls/127.0.0.1:PORT"
        )
    if isinstance(error, socket.gaierror):
        return BriefError(
            f"the host of {endpoint} is not known here ({why}); write it into /etc/hosts, or write the "
            f"briefs again with --listen {endpoint.protocol}/0.0.0.0:{endpoint.port} and --connect"
        )
    if isinstance(error, zenoh.ZError):
        return BriefError(
            f"the router cannot listen at {endpoint} ({why}); write the briefs again with another --listen"
        )
    return BriefError(
        f"the router cannot listen at {endpoint} ({why}); end the program that does, or write the briefs "
        f"again with another --listen {endpoint.protocol}/HOST:PORT, of the host that the router is started on"
    )

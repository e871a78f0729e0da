"""Whether a process is on the network now, according to the router: only the router's view counts for other processes."""

from __future__ import annotations

import json

import zenoh

from evedrop.live.network.endpoint import endpoint_in
from evedrop.live.network.opening import open_session
from evedrop.live.network.session import client_config
from evedrop.live.protocol.brief import AnyBrief
from evedrop.live.protocol.brief_parts import RelayPart, RoutingPart
from evedrop.live.protocol.keys import RunKeys

_CONNECT_SECONDS = 3.0
_ANSWER_SECONDS = 3.0


def is_there(brief: AnyBrief) -> bool:
    """Whether the router sees the process of a brief: connected, ready, and not lost since.

    Asks with the credentials of the process itself, which may ask for no other process.
    """
    zenoh.init_log_from_env_or("off")
    config = client_config(brief)
    config["connect"]["timeout_ms"] = int(_CONNECT_SECONDS * 1000)
    if isinstance(brief.part, RoutingPart):
        # The router asks itself. It may listen on every address, which its certificate does not name.
        listens = brief.part.listen if isinstance(brief.part, RelayPart) else brief.router
        config["connect"]["endpoints"] = [str(endpoint_in(listens).nearby)]
        config["transport"]["link"].get("tls", {})["verify_name_on_connect"] = False
    try:
        with open_session(zenoh.Config.from_json5(json.dumps(config))) as session:
            answers = session.liveliness().get(RunKeys(brief.run).alive(brief.process), timeout=_ANSWER_SECONDS)
            return any(answer.ok is not None for answer in answers)
    except zenoh.ZError:
        return False

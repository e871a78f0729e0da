"""The relay: the second of two routers, at the receivers' site. It decides nothing, and passes on the granted messages.

Source: docs/protocol.md, two routers.
"""

from __future__ import annotations

from evedrop.live.network.access import access_control, at_relay, grants, until_all_left, users_file
from evedrop.live.network.connecting import connected
from evedrop.live.network.session import ATTEMPT, Session, client_config, router_address_of, router_config
from evedrop.live.protocol.brief import Brief, RelayPart
from evedrop.live.protocol.commands import EndRun
from evedrop.live.protocol.keys import ZenohConfig


def relay(brief: Brief[RelayPart]) -> None:
    """Run the relay of a brief until the conductor ends it and all processes connected to it have left.

    Raises BriefError if the router does not accept the brief, RunError if no router answers within the brief's patience.
    """
    part = brief.part
    table = at_relay(brief.run, grants(brief.run, tuple(part.receivers), part.controller, relayed=True), part.zid)
    # Connect as a client first, which reports errors; Zenoh links routers in the background and reports none.
    with connected(router_address_of(brief), float(brief.patience)):
        pass
    with _opened(brief, access_control(table, brief.identity is not None)) as session:
        present = session.presence(grant.process for grant in table if grant.token is not None and grant.zid is None)
        session.wait_for_link()
        session.ready()
        session.wait_for(EndRun)
        until_all_left(present)


def _opened(brief: Brief[RelayPart], access: ZenohConfig) -> Session:
    with users_file(brief.part.users) as users:
        return Session(brief, _config(brief, str(users), access), brief.part.listen)


def _config(brief: Brief[RelayPart], users: str, access: ZenohConfig) -> ZenohConfig:
    """Configuration of a router that also connects to the first router as a client, and reconnects when the link is lost."""
    listening = router_config(brief, users, access, brief.part.listen)
    connecting = client_config(brief)
    auth = {"usrpwd": {**listening["transport"]["auth"]["usrpwd"], **connecting["transport"]["auth"]["usrpwd"]}}
    return {
        **listening,
        "connect": {**connecting["connect"], "timeout_ms": -1, "exit_on_failure": False},
        "transport": {**listening["transport"], "auth": auth, "unicast": dict(ATTEMPT)},
    }

"""A Zenoh router that is asked for its queryables while a client declares some stops forever. Needs only eclipse-zenoh."""

from __future__ import annotations

import json
import os
import threading
import time

import zenoh

PORT = 18961
SECONDS, PATIENCE = 30.0, 12.0  # how long to try, and longer than any query may take


def opened(mode: str, where: str) -> zenoh.Session:
    """A router that listens, or a client that connects."""
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    config = {"mode": mode, where: {"endpoints": [f"tcp/127.0.0.1:{PORT}"]}, "scouting": scouting}
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**config, "adminspace": {"enabled": True}})))


def main() -> int:
    """Ask and declare at the same time; 1 if no answer came any more."""
    router, client = opened("router", "listen"), opened("client", "connect")
    answered, declared = 0, []

    def ask() -> None:
        nonlocal answered
        while True:
            over = threading.Event()
            handler = zenoh.handlers.Callback(lambda _: None, drop=over.set, indirect=False)
            router.get(f"@/{router.zid()}/router/queryable/**", handler)
            over.wait()
            answered += 1

    def declare() -> None:
        while True:
            declared.append(client.declare_queryable(f"key/{len(declared)}", lambda query: query.drop()))
            time.sleep(0.001)

    for work in (ask, declare):
        threading.Thread(target=work, daemon=True).start()
    begun = changed = time.monotonic()
    seen = 0
    while time.monotonic() - begun < SECONDS:
        time.sleep(0.1)
        if answered != seen:
            seen, changed = answered, time.monotonic()
        elif time.monotonic() - changed > PATIENCE:
            print(
                f"stopped after {changed - begun:.1f} s, {answered} questions and at most {len(declared)} declarations"
            )
            return 1
    print(f"{answered} questions were answered while {len(declared)} queryables were declared")
    return 0


if __name__ == "__main__":
    os._exit(main())  # a session of a router that has stopped cannot be closed

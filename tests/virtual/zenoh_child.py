"""A process with a session of Zenoh, for the tests that kill and suspend one; its import takes as little time as possible."""

from __future__ import annotations

import json
import sys
from typing import Any

import zenoh


def declare(module: Any, session: Any, kind: str, key: str) -> object:
    """Declare something on the session of a child."""
    match kind:
        case "token":
            return session.liveliness().declare_token(key)
        case "subscriber":
            return session.declare_subscriber(key, module.handlers.FifoChannel(1000))
        case "standing subscriber":
            return session.declare_subscriber(key, module.handlers.FifoChannel(1))
        case "answers":
            return session.declare_queryable(key, lambda query: (query.reply(key, b"answer"), query.drop()))
        case "silent":
            questions: list[Any] = []
            return questions, session.declare_queryable(key, questions.append)
        case "publisher":
            return session.declare_publisher(key)
    raise AssertionError(kind)


def main() -> None:
    """Declare things, and wait until standard input ends."""
    told = json.loads(sys.argv[1])
    zenoh.init_log_from_env_or("off")
    with zenoh.open(zenoh.Config.from_json5(json.dumps(told["config"]))) as session:
        kept = [declare(zenoh, session, kind, key) for kind, key in told["does"]]
        print("ready", flush=True)  # noqa: T201 - its parent reads it
        sys.stdin.read()
        del kept


if __name__ == "__main__":
    main()

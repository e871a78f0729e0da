"""Prints the numbers that it receives, until the talker ends: listener.py ENDPOINT."""

import sys

import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')  # connects to this endpoint and nowhere else
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("connect/timeout_ms", "-1")  # waits for a wire that starts later
with zenoh.open(config) as session:
    heard = session.declare_subscriber("chatter/**", zenoh.handlers.FifoChannel(10_000))
    token = session.liveliness().declare_token("listener")  # undeclared with the object
    for sample in heard:
        if str(sample.key_expr) == "chatter/end":
            break
        print(sample.payload.to_string(), flush=True)

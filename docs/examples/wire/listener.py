"""Prints the numbers that it hears, and ends when the talker does: listener.py ENDPOINT.

A program as any other that uses Zenoh: it knows nothing of Evedrop.
"""

import sys

import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
with zenoh.open(config) as session:
    heard = session.declare_subscriber("chatter/**", zenoh.handlers.FifoChannel(10_000))
    token = session.liveliness().declare_token("listener")  # undeclared with the object
    for sample in heard:
        if str(sample.key_expr) == "chatter/end":
            break
        print(sample.payload.to_string(), flush=True)

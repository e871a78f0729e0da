"""Publishes numbers once a listener is there, for as long as it is told to: talker.py ENDPOINT COUNT SECONDS_BETWEEN.

A program as any other that uses Zenoh: it knows nothing of Evedrop.
"""

import sys
import threading
import time

import zenoh

endpoint, count, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
with zenoh.open(config) as session:
    listening = threading.Event()
    listeners = session.liveliness().declare_subscriber("listener", lambda _: listening.set(), history=True)
    if not listening.wait(60):
        sys.exit("no listener came")
    chatter = session.declare_publisher("chatter/numbers")
    for number in range(count):
        chatter.put(str(number))
        time.sleep(seconds)
    session.put("chatter/end", "")

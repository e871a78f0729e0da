"""Publishes numbers as soon as a listener is there: talker.py ENDPOINT COUNT SECONDS_BETWEEN."""

import sys
import threading
import time

import zenoh

endpoint, count, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
config = zenoh.Config()
config.insert_json5("mode", '"client"')  # connects to this endpoint and nowhere else
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
config.insert_json5("connect/timeout_ms", "-1")  # waits for a wire that starts later
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

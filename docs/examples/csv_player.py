"""Publishes the lines of a CSV file on a Zenoh key, one after the other, as a robot publishes its pose.

    python csv_player.py pose.csv robot/pose --connect tcp/127.0.0.1:7447 --every 0.05

A line becomes a JSON object with the names of the first line, such as {"x": 0.1, "y": 0.2}. The program knows nothing of
Evedrop: it stands for one of your own. It waits until somebody subscribes to the key before it publishes the first line.
"""

import argparse
import csv
import json
import time
from collections.abc import Iterator

import zenoh


def lines(path: str) -> Iterator[str]:
    """The lines of a CSV file as JSON; a unit after a name, as in `x [m]`, is left out."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = csv.reader(file, skipinitialspace=True)
        names = [name.partition("[")[0].strip() for name in next(rows)]
        for row in rows:
            yield json.dumps(dict(zip(names, map(float, row), strict=True)))


def configuration(connect: str | None, listen: str | None) -> zenoh.Config:
    """A client of the router at `connect`; or a router at which Evedrop's sensor connects."""
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    if listen is not None:
        return zenoh.Config.from_json5(
            json.dumps({"mode": "router", "listen": {"endpoints": [listen]}, "scouting": scouting})
        )
    where = {"endpoints": [connect], "timeout_ms": -1}
    return zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": where, "scouting": scouting}))


def main() -> None:
    """Play the file of the command line."""
    parser = argparse.ArgumentParser(description="Publish the lines of a CSV file on a Zenoh key.")
    parser.add_argument("file")
    parser.add_argument("key")
    parser.add_argument("--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447")
    parser.add_argument(
        "--listen", metavar="ENDPOINT", help="be a router at this endpoint instead of connecting to one"
    )
    parser.add_argument("--every", type=float, default=0.1, metavar="SECONDS", help="0: as fast as possible")
    options = parser.parse_args()
    with zenoh.open(configuration(options.connect, options.listen)) as session:
        publisher = session.declare_publisher(
            options.key, encoding=zenoh.Encoding.APPLICATION_JSON, congestion_control=zenoh.CongestionControl.BLOCK
        )
        while not publisher.matching_status.matching:
            time.sleep(0.02)
        start, count = time.monotonic(), 0
        for count, line in enumerate(lines(options.file), 1):
            publisher.put(line)
            time.sleep(max(0.0, start + count * options.every - time.monotonic()))
        while publisher.matching_status.matching:  # messages may be under way: end when the subscriber has gone
            time.sleep(0.02)
    print(f"published {count} lines on {options.key}")


if __name__ == "__main__":
    main()

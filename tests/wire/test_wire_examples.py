"""The official examples of zenoh-python run between two sides of a wire as they are.

They are copied without a change from the folder `examples` of github.com/eclipse-zenoh/zenoh-python, with their licence.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import wait_until
from tests.wire.wire_at_work import LOSSY, WireAtWork, at_work, both_ways, is_declared
from tests.wire.wire_links import key_fates

EXAMPLES = Path(__file__).parent / "zenoh_examples"


class Example:
    """An example that runs, and the lines that it has printed."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.lines: list[str] = []
        self._process = process
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self.lines.append(line.rstrip("\n"))

    def end(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait()
        self._thread.join()

    @property
    def results(self) -> list[str]:
        """The lines about what it received."""
        return [line for line in self.lines if line.startswith(">>")]


@contextlib.contextmanager
def example(wire: WireAtWork, side: str, name: str, *options: str) -> Iterator[Example]:
    """An example that is connected to a side."""
    where = ["-m", "client", "-e", wire.relay.endpoints[side][0], "--no-multicast-scouting"]
    command = [sys.executable, "-u", str(EXAMPLES / f"{name}.py"), *where, *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    example = Example(process)
    try:
        yield example
    finally:
        example.end()


def known(wire: WireAtWork, side: str, subject: str, key: str) -> None:
    """Return when the router of a side knows a declaration."""
    wait_until(lambda: is_declared(wire, side, subject, key), f"{subject} of {key}")


def test_z_sub_hears_of_z_pub_exactly_what_the_link_lets_through(tmp_path: Path) -> None:
    """The n-th message by the n-th fate."""
    plan = both_ways(LOSSY)
    key = "demo/example/zenoh-python-pub"
    with at_work(plan, tmp_path) as wire, example(wire, "base", "z_sub") as sub:
        known(wire, "base", "subscriber", "demo/example/**")
        with example(wire, "robot", "z_pub", "--iter", "60", "--interval", "0.01") as pub:
            wait_until(lambda: sum("Putting" in line for line in pub.lines) == 60, "all are put")

            def expected() -> list[str]:
                """What arrives if the wire has heard all but the first messages, which nobody took yet."""
                first = 60 - len(wire.rows)
                fates = key_fates(plan.links[0], key, "put", plan.seed)
                through = [first + n for n in range(60 - first) if fates.next()[0] == 0]
                return [
                    f">> [Subscriber] Received SampleKind.PUT ('{key}': '[{n:4d}] Pub from Python!')" for n in through
                ]

            wait_until(lambda: len(wire.rows) >= 55 and sub.results == expected(), "exactly these arrive")
            assert len(sub.results) < 50


def test_z_get_asks_z_queryable(tmp_path: Path) -> None:
    """The query arrives whole, and so does the reply."""
    with at_work(both_ways(), tmp_path) as wire, example(wire, "base", "z_queryable") as queryable:
        known(wire, "base", "queryable", "demo/example/zenoh-python-queryable")
        with example(wire, "robot", "z_get", "-s", "demo/example/zenoh-python-queryable", "-p", "please") as get:
            wait_until(lambda: get.results, "a reply")
            assert get.results == [">> Received ('demo/example/zenoh-python-queryable': 'Queryable from Python!')"]
        assert queryable.results == [
            ">> [Queryable ] Received Query 'demo/example/zenoh-python-queryable' with payload: 'please'"
        ]


def test_z_sub_liveliness_sees_z_liveliness_come_and_go(tmp_path: Path) -> None:
    """It is killed, and so does not say goodbye."""
    with at_work(both_ways(), tmp_path) as wire, example(wire, "base", "z_sub_liveliness", "--history", "1") as watch:
        with example(wire, "robot", "z_liveliness"):
            wait_until(
                lambda: watch.results == [">> [LivelinessSubscriber] New alive token ('group1/zenoh-py')"], "it comes"
            )
            with example(wire, "base", "z_get_liveliness") as get:
                wait_until(lambda: get.results, "a token")
                assert get.results == [">> Alive token ('group1/zenoh-py')"]
        wait_until(
            lambda: watch.results[1:] == [">> [LivelinessSubscriber] Dropped token ('group1/zenoh-py')"], "it goes"
        )

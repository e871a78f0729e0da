"""Speed of live runs, side by side with raw Zenoh carrying the same messages. Prints a table; about three minutes.

    python benchmarks/live.py [--quick]
    python benchmarks/live.py tls       # what certificates and a second router cost; about two minutes

Machines are noisy: compare the columns of one table, not tables; every pair is measured in turn, the median is quoted.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import raw
from processes import Usage, watch

from evedrop.live.launch.briefs import ObserverTask, briefs_of
from evedrop.live.network.session import Session
from evedrop.live.protocol.brief import AnyBrief, Brief
from evedrop.live.protocol.brief_parts import ObserverPart, SensorPart
from evedrop.live.protocol.codec import progress
from evedrop.live.protocol.commands import End, Start
from evedrop.live.protocol.packets import uplink
from evedrop.loading import load
from evedrop.names import LEGITIMATE, ROUTER, SENSOR
from evedrop.ports import free_port

RECEIVERS = 4


def run(*options: str) -> tuple[dict[str, float], dict[str, Usage]]:
    """One live run without a view: its summary, and what its processes used."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "evedrop", "run", "eavesdroppers", "--view", "off", "--json"]
        process = subprocess.Popen([*command, "--out", f"{folder}/run", *options], stdout=subprocess.PIPE)
        usage = watch(process)
        assert process.stdout is not None
        summary = json.loads(process.stdout.read())
    return summary, usage


def throughput(slots: int, trials: int, rounds: int) -> None:
    """Ours beside raw Zenoh, in turn."""
    ours, theirs = [], []
    for _ in range(rounds):
        summary, _ = run("--slots", str(slots), "--trials", str(trials))
        ours.append(summary["slots_per_second"])
        theirs.append(raw.throughput(slots, trials, RECEIVERS))
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    mine, bare = statistics.median(ours), statistics.median(theirs)
    deliveries = mine * trials * RECEIVERS
    print(
        f"{trials:>5} trials, {RECEIVERS} receivers: {mine:>8,.0f} slots/s ({deliveries / 1e6:.2f} million deliveries/s) "
        f"into the results; raw Zenoh {bare:>8,.0f} slots/s; ratio {ratio:.2f}"
    )


def latency(slots: int, rounds: int) -> None:
    """One-way latency at 1 kHz from the sensor's send to the receiver's receipt, through our router and through Zenoh's."""
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(_routed_latency(slots, 1000.0))
        theirs.append(raw.latency(slots, 1000.0, RECEIVERS))
    for name, column in (("median", 0), ("99th percentile", 1)):
        added = statistics.median(a[column] - b[column] for a, b in zip(ours, theirs, strict=True))
        mine = statistics.median(a[column] for a in ours)
        bare = statistics.median(b[column] for b in theirs)
        print(f"latency at 1 kHz, {name}: {mine:.0f} µs; raw Zenoh {bare:.0f} µs; added {added:.0f} µs")


def _routed_latency(slots: int, rate: float) -> tuple[float, float]:
    """A real router process from a real brief, with senders and receivers that only look at the clock."""
    scenario = load("eavesdroppers", {"slots": slots, "pace": 1.0 / rate})
    with tempfile.TemporaryDirectory() as folder:
        observation = ObserverTask(Path(folder), False)
        briefs = briefs_of(scenario, f"tcp/127.0.0.1:{free_port()}", observation, ends_with_stdin=False)
        paths = {name: str(brief.write(Path(folder))) for name, brief in briefs.items()}
        router = subprocess.Popen([sys.executable, "-m", "evedrop", "router", paths[ROUTER]])
        command = [sys.executable, __file__]
        sender = subprocess.Popen([*command, "send", paths[SENSOR]], stdout=subprocess.PIPE)
        watcher = subprocess.Popen([*command, "watch", paths["observer"]])
        others = [
            subprocess.Popen([*command, "receive", paths[name]], stdout=subprocess.PIPE) for name in scenario.receivers
        ]
        sent = json.loads(sender.communicate()[0])
        delays: list[tuple[float, float]] = []
        for other in others:
            one = sorted((got - sent[k]) * 1e6 for k, got in enumerate(json.loads(other.communicate()[0])))
            delays.append((one[len(one) // 2], one[len(one) * 99 // 100]))
        watcher.wait()
        router.wait()
    return max(delay[0] for delay in delays), max(delay[1] for delay in delays)


def _send(brief: Brief[SensorPart]) -> None:
    import numpy as np  # noqa: PLC0415

    z = np.zeros((2, 1))
    times = []
    with Session(brief) as session:
        for name in (LEGITIMATE, "naive", "suspicious", "smart", "observer"):
            session.funnel(session.keys.progress(name), lambda _: None)
        send = session.outlet(session.keys.uplink)
        session.ready()
        session.wait_for(Start)
        start = time.monotonic()
        for k in range(brief.slots):
            time.sleep(max(0.0, start + k * brief.part.pace - time.monotonic()))
            times.append(time.monotonic())
            send(uplink(k, z))
        session.wait_for(End)
    print(json.dumps(times), flush=True)


def _receive(brief: AnyBrief) -> None:
    times = []
    with Session(brief) as session:
        deliveries = session.inbox(session.keys.downlink(brief.process))
        put_progress = session.outlet(session.keys.progress(brief.process))
        session.ready()
        for _ in range(brief.slots):
            deliveries.recv()
            times.append(time.monotonic())
        put_progress(progress(brief.slots))
        session.wait_for(End)
    print(json.dumps(times), flush=True)


def _watch(brief: Brief[ObserverPart]) -> None:
    """The conductor's part: start when all are there, end when the journal is complete."""
    from evedrop.live.observer.conductor import Conductor, Stop  # noqa: PLC0415

    receivers = tuple(brief.part.scenario["eavesdroppers"])
    with Session(brief) as session:
        conductor = Conductor(session, (LEGITIMATE, *receivers), Stop())
        conductor.assemble()
        conductor.start()
        slots = 0
        while slots < brief.slots:
            news = conductor.news()
            if news is not None and news[0] == ROUTER:
                import msgpack  # noqa: PLC0415

                slots += msgpack.unpackb(news[1])["c"]
        conductor.end(30.0)


def memory(slots: int) -> None:
    """Resident memory of every process after a tenth of a long run and at its end."""
    _, usage = run("--slots", str(slots))
    print(f"memory over {slots:,} slots, MB after a quarter and at the end:")
    for name, one in usage.items():
        quarter = one.resident[len(one.resident) // 4]
        print(f"    {name:<12} {quarter:6.0f} {one.resident[-1]:6.0f}   (peak {max(one.resident):.0f})")


def connections(rounds: int) -> None:
    """In clear, with certificates, and with two routers and certificates, in turn."""
    ways = {
        "in clear": lambda: (),
        "with certificates": lambda: ("--listen", f"tls/127.0.0.1:{free_port()}"),
        "two routers, with certificates": lambda: ("--set", "network.routers=2"),
    }
    for slots, trials in ((10_000, 1), (1_000, 1000)):
        found: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(rounds):
            for name, options in ways.items():
                summary, _usage = run("--slots", str(slots), "--trials", str(trials), *options())
                found[name].append(summary["slots_per_second"])
        for name, rates in found.items():
            ratio = statistics.median(a / b for a, b in zip(rates, found["in clear"], strict=True))
            print(f"{trials:>5} trials, {name}: {statistics.median(rates):>8,.0f} slots/s; ratio {ratio:.2f}")


def start_up(rounds: int) -> None:
    """How long --help takes, and a run until its first slot."""
    times = {"evedrop --help": [sys.executable, "-m", "evedrop", "--help"]}
    for what, command in times.items():
        taken = []
        for _ in range(rounds):
            start = time.monotonic()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            taken.append(time.monotonic() - start)
        print(f"{what}: {statistics.median(taken) * 1000:.0f} ms")
    taken = []
    for view in ["off"] * rounds + ["web"] * rounds:
        with tempfile.TemporaryDirectory() as folder:
            code = (
                "import sys, time\nfrom pathlib import Path\nfrom evedrop.scenario import load\n"
                "from evedrop.live.launch.launcher import launch\n"
                "def tell(news):\n    if news.event == 'started': print(time.monotonic(), flush=True)\n"
                f"launch(load('eavesdroppers', {{'slots': 10}}), Path({folder!r}) / 'run', {view!r}, None, tell)\n"
            )
            start = time.monotonic()
            found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
            taken.append(float(found.stdout.split()[0]) - start)
    for view, column in (("off", taken[:rounds]), ("web", taken[rounds:])):
        print(f"from the command to the first slot, view {view}: {statistics.median(column):.2f} s")


def main(quick: bool) -> None:
    """All of it."""
    rounds = 1 if quick else 3
    start_up(rounds)
    throughput(5_000 if quick else 20_000, 1, rounds)
    throughput(500 if quick else 8_000, 1000, rounds)
    latency(1_000 if quick else 3_000, rounds)
    memory(20_000 if quick else 200_000)


if __name__ == "__main__":
    from evedrop.live.protocol.brief import read_brief

    if sys.argv[1:] == ["tls"]:
        connections(3)
    elif len(sys.argv) > 2:
        {"send": _send, "receive": _receive, "watch": _watch}[sys.argv[1]](read_brief(Path(sys.argv[2])))
    else:
        main("--quick" in sys.argv)

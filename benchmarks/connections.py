"""What certificates and a second router cost: live runs without certificates, with them, and with two routers, in turn.

python benchmarks/connections.py [--quick]
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable

from live_run import rate

from evedrop.system.ports import free_port

WAYS: dict[str, Callable[[], tuple[str, ...]]] = {
    "unencrypted": lambda: (),
    "with certificates": lambda: ("--listen", f"tls/127.0.0.1:{free_port()}"),
    "two routers, with certificates": lambda: ("--set", "network.routers=2"),
}


def main(quick: bool) -> None:
    """One trial and a thousand."""
    for slots, trials in ((300, 1),) if quick else ((10_000, 1), (1_000, 1000)):
        rates_of: dict[str, list[float]] = {name: [] for name in WAYS}
        for _ in range(1 if quick else 3):
            for name, options in WAYS.items():
                rates_of[name].append(rate("eavesdroppers", "--slots", str(slots), "--trials", str(trials), *options()))
        for name, rates in rates_of.items():
            ratio = statistics.median(a / b for a, b in zip(rates, rates_of["unencrypted"], strict=True))
            print(f"{trials:>5} trials, {name}: {statistics.median(rates):>8,.0f} slots/s; ratio {ratio:.2f}")


if __name__ == "__main__":
    main("--quick" in sys.argv)

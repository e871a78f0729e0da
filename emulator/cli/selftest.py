"""The self-test: versions, processor, and whether this machine computes the golden digests."""

from __future__ import annotations

import importlib.metadata
import platform
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from evedrop.memory.montecarlo import simulate
from evedrop.news import silent
from evedrop.results.writer import load_results
from evedrop.scenario import Scenario

GOLDEN: Mapping[str, str] = {
    "legitimate": "f67d871db0a1243f4183e6f4d5c157b636f8c055479dd62b57be0795c984a11e",
    "naive": "caf0841009760d153bf93a9120577b0073e62df915a146205c6bf1078c13174b",
    "smart": "933cb95c2b1dfe4f43d259f43dff6f3da1343b387662780b4d99fc5aa40d2f06",
    "suspicious": "1453d70b15896b60904e59673cd5328b8db63a2960893837aecddebbbde645c6",
}
"""Receiver → its digest in `SCENARIO`. Digests change only if the protocol of random numbers or the schemes change."""

SCENARIO = {
    "title": "selftest",
    "slots": 300,
    "seed": 20_240_229,
    "trials": 40,
    "process": {
        "A": [[1.0, 0.05, 0.0], [0.0, 1.0, 0.1], [0.0, -0.1, 0.99]],
        "Q": [[1e-3, 0.0, 0.0], [0.0, 2e-3, 1e-4], [0.0, 1e-4, 1e-3]],
        "initial_covariance": [[1.0, 0.2, 0.0], [0.2, 0.5, 0.0], [0.0, 0.0, 0.3]],
    },
    "encoding": {"scheme": "innovation", "state_probability": 0.4},
    "legitimate": {"link": {"quality": 0.8}},
    "eavesdroppers": {
        "naive": {"strategy": "naive", "link": {"quality": 0.7}},
        "smart": {"strategy": "smart", "link": {"quality": 0.9}},
        "suspicious": {
            "strategy": "suspicious",
            "use_state": 0.8,
            "use_innovation": 0.2,
            "link": {"quality": 0.9},
        },
    },
}


@dataclass(frozen=True)
class Check:
    """A description of the machine, and the digests that it computed."""

    machine: Mapping[str, str]
    digests: Mapping[str, str | None]

    @property
    def passed(self) -> bool:
        """Whether every digest is the golden one."""
        return dict(self.digests) == dict(GOLDEN)


def selftest() -> Check:
    """Compute the golden digests on this machine."""
    with tempfile.TemporaryDirectory(prefix="evedrop-") as folder:
        simulate(Scenario.model_validate(SCENARIO), Path(folder) / "run", silent)
        peers = load_results(Path(folder) / "run").typed_summary.peers
    packages = ("evedrop", "numpy", "cryptography", "eclipse-zenoh", "rerun-sdk", "msgpack", "pyarrow", "scipy")
    machine = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processor": _processor(),
        **{name: importlib.metadata.version(name) for name in packages},
    }
    return Check(machine, {name: peer.digest for name, peer in peers.items()})


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()

"""The self-test: versions, processor, and whether this machine computes the golden digests."""

from __future__ import annotations

import importlib.metadata
import platform
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from evedrop.model.kernels.choice import KERNELS
from evedrop.results.reading import Results
from evedrop.scenario.progress_events import silent
from evedrop.scenario.tables import Scenario
from evedrop.simulate.montecarlo import simulate

GOLDEN: Mapping[str, str] = {
    "legitimate": "b169b9801374777ee60666307baf8ca1192618cdd97f119347486dcdef124266",
    "naive": "ae6b2a42de22adaabd0df015c0dea889736d99e46d9e28ec0cf98a1c33b49388",
    "smart": "6d5bf6ecf8fc1b9ec3cf2747b8a3e1570a0130ba53054b00733001f3031deec5",
    "suspicious": "a29540cedfae07e0cf2aaf5ea6cff618e1e8713ea0c402abb88fc65da03216b1",
}
"""Receiver → its digest in `SCENARIO`. Digests change only if the streams, the schemes or the digest change."""

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
        peers = Results.read(Path(folder) / "run").typed_summary.peers
    packages = (
        "evedrop",
        "numpy",
        "cryptography",
        "eclipse-zenoh",
        "rerun-sdk",
        "msgpack",
        "pyarrow",
        "scipy",
        "xxhash",
    )
    machine = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processor": _processor(),
        "kernels": KERNELS,
        **{name: importlib.metadata.version(name) for name in packages},
    }
    return Check(machine, {name: peer.digest for name, peer in peers.items()})


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()

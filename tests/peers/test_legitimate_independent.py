"""A legitimate estimator written from docs/protocol.md and the pages that it names agrees with ours to the last bit."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evedrop import montecarlo
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol import codec as wire
from evedrop.live.protocol import telemetry
from evedrop.live.protocol.packets import delivery
from evedrop.model.digest import BlockDigests, Blocks, Digests, RunDigest
from evedrop.model.process import Process, Trajectory
from evedrop.model.receiver import Reception
from evedrop.model.schemes import SCHEMES
from evedrop.model.slot.link_core import Arrivals
from evedrop.model.streams import Batch
from evedrop.results.reading import Results
from evedrop.scenario.loading import load
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.system.ports import free_port
from tests.builders import DRIFTING, one_slot, scenario_of
from tests.conftest import LIMIT
from tests.messages import delivered
from tests.peers.independent_legitimate import Estimator

PEER = Path(__file__).with_name("independent_legitimate.py")
UNSTABLE = Process(
    np.array([[1.0, 0.3], [0.5, 1.001]]), np.array([[1e-3, 2e-4], [2e-4, 1e-3]]), np.array([[1.0, 0.5], [0.5, 1.0]])
)
TABLES: dict[str, Any] = {
    "seed": 5,
    "trials": 9,
    "record_trials": 2,
    "encoding": {"scheme": "innovation", "state_probability": 0.4},
    "legitimate": {"link": {"quality": 0.7}},
}
"""Of a scenario without eavesdroppers."""


@pytest.mark.parametrize("most", [1, 7])
@pytest.mark.parametrize(("process", "slots", "first_trial"), [(DRIFTING, 300, 0), (UNSTABLE, 60, 12_345)])
def test_same_deliveries_same_bits(process: Process, slots: int, first_trial: int, most: int) -> None:
    """Fed with the deliveries of a run, `most` slots in a message, it has our digest, and reports what we report."""
    scenario = scenario_of(process, slots=slots, first_trial=first_trial, **TABLES)
    keys, batch = StreamKeys.from_scenario(scenario), Batch(slots, 9, first_trial)
    made = briefs_of(scenario, endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))
    peer = Estimator(json.loads(made["legitimate"].text))
    model = scenario.process.process
    trajectory = Trajectory(model, keys.process, batch)
    secret = keys.secret(("schedule", "noise"))
    encoder = SCHEMES["innovation"](model, 0.4).encoder(secret, batch)
    estimator = SCHEMES["innovation"](model, 0.4).estimator(secret, batch)
    belief, log, digest = estimator.prior(), BlockDigests(9, slots), RunDigest()
    gammas = np.random.default_rng(1).random((slots, 9)) < 0.7
    beliefs, payloads = [], []
    blocks: dict[int, Digests] = {}
    for k, gamma in enumerate(gammas):
        z = encoder.encode(k, trajectory.advance(), trajectory.predicted).z
        belief = estimator.step(k, belief, Reception(gamma, z))
        beliefs.append(belief)
        blocks |= log.add(range(k, k + 1), one_slot(belief))
        payloads.append(z)
    for first in range(0, slots, most):
        part = slice(first, min(first + most, slots))
        peer.receive(delivery(range(part.start, part.stop), Arrivals(gammas[part], np.array(payloads[part]))))
    extent = telemetry.Extent(slots, slots, model.n, 9, 2)
    report = telemetry.read_report(wire.Reader("telemetry", peer.report()), 0, extent, Blocks(slots))
    assert np.array_equal(report.slots.x_hat, [belief.x_hat for belief in beliefs])
    assert np.array_equal(report.slots.action, [belief.action for belief in beliefs])
    assert np.array_equal(report.slots.P, [belief.P[:, :, :2] for belief in beliefs])
    traces = report.slots.trace
    assert traces is not None
    assert np.allclose(traces[:, 0], [np.trace(belief.P).sum() for belief in beliefs], rtol=1e-12)
    digest.add(blocks)
    assert peer.digest() == digest.hexadecimal


def test_it_refuses_a_gap() -> None:
    """A slot that is not due is an error, as the protocol says."""
    scenario = scenario_of(UNSTABLE, slots=10, **TABLES)
    made = briefs_of(scenario, endpoints_at("tcp/127.0.0.1:1"), RecorderTask(Path("nowhere"), False))
    peer = Estimator(json.loads(made["legitimate"].text))
    with pytest.raises(ValueError, match="slot 1 arrived, slot 0 was due"):
        peer.receive(delivered(1, np.zeros(9, np.bool_), np.zeros((2, 9))))


@pytest.mark.thorough
def test_it_takes_part_in_a_real_run(tmp_path: Path) -> None:
    """In the place of our estimator, among our router, sensor, eavesdroppers and recorder, it ends with our digest."""
    scenario = load("eavesdroppers", {"slots": 300, "trials": 2})
    out = tmp_path / "out"
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    briefs = briefs_of(scenario, endpoints_at(endpoint), RecorderTask(out, False), ends_with_stdin=False)
    with ExitStack() as stack:
        running = {}
        for name, brief in briefs.items():
            program = [str(PEER)] if name == "legitimate" else ["-m", "evedrop", brief.role]
            running[name] = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, *program, str(brief.write(tmp_path))],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            )
            stack.callback(running[name].kill)
        outputs = {name: process.communicate(timeout=LIMIT)[0] for name, process in running.items()}
        statuses = {name: process.returncode for name, process in running.items()}
    assert set(statuses.values()) <= {0, 1}, (statuses, outputs)
    digest = montecarlo(scenario, trials=2, out=tmp_path / "memory").summary["peers"]["legitimate"]["digest"]
    summary = Results.read(out).summary
    assert summary["peers"]["legitimate"]["digest"] == digest
    assert outputs["legitimate"].strip() == digest


def test_it_is_independent() -> None:
    """It imports neither this project nor numpy."""
    assert not [
        line for line in PEER.read_text().splitlines() if line.split()[:2] in (["import", "numpy"], ["from", "numpy"])
    ]
    code = f"import sys; sys.path.insert(0, {str(PEER.parent)!r}); import independent_legitimate; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"evedrop", "numpy"} & set(modules)

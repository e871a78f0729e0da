"""A live run computes the same bits with numpy as trials in memory do with the C kernels."""

from __future__ import annotations

import pytest

from evedrop.model.kernels import choice
from evedrop.names import KERNELS_VARIABLE
from tests.builders import digests_of
from tests.conftest import Evedrop

MODULE = '''
from evedrop.extend import Innovation, Naive
from evedrop.model.kernels.choice import KERNELS

print("the kernels are", KERNELS)


class Mine(Innovation):
    """The paper's scheme, whose processes say which kernels they use."""


class Eve(Naive):
    """The naive eavesdropper, which says it, too."""
'''
SCENARIO = """
title = "Kernels"
slots = 300
trials = 3

[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]

[encoding]
scheme = "saying:Mine"
state_probability = 0.6

[legitimate]
window = 2
link = { quality = 0.9, delay = { model = "normal", mean = 0.8, standard_deviation = 0.5 } }

[eavesdroppers.naive]
strategy = "saying:Eve"
link = { quality = 0.8 }

[eavesdroppers.suspicious]
strategy = "suspicious"
use_state = 0.8
use_innovation = 0.3
link = { loss = { model = "gilbert-elliott", p = 0.1, r = 0.4 } }
"""


@pytest.mark.thorough
def test_a_live_run_with_numpy_has_the_digests_of_memory_with_c(evedrop: Evedrop) -> None:
    """For all receivers, with late packets and a digest of more than one block; the processes do use numpy."""
    (evedrop.folder / "saying.py").write_text(MODULE)
    (evedrop.folder / "mine.toml").write_text(SCENARIO)
    memory = evedrop.process("montecarlo", "mine.toml", "--trials", "3", "--out", "memory")
    assert memory.status == 0, memory.err
    assert f"the kernels are {choice.KERNELS}" in memory.out
    environment = {**evedrop.environment, KERNELS_VARIABLE: "numpy"}
    # A fork of this process, or of its server, would have chosen the kernels already.
    live = evedrop.begun("run", "mine.toml", "--view", "off", "--out", "live", env=environment).end()
    assert live.status == 0, live.err
    for process in ("sensor", "legitimate", "naive", "recorder"):
        log = (evedrop.folder / "live" / "logs" / f"{process}.log").read_text()
        assert f"the kernels are numpy, as {KERNELS_VARIABLE} says" in log, process
    digests = digests_of(evedrop.folder / "live")
    assert set(digests) == {"legitimate", "naive", "suspicious"}
    assert digests == digests_of(evedrop.folder / "memory")

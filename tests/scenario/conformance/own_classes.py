"""Classes of anybody's own: the pages about them, a scenario, and the beginning of a module."""

from __future__ import annotations

import re
from pathlib import Path

FOLDER = Path(__file__).parents[3] / "docs" / "your-own"
PAGES = [FOLDER / f"{name}.md" for name in ("scheme", "eavesdropper", "link", "overview")]
PAGES += sorted({*FOLDER.glob("*.md")} - {*PAGES})
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
"""All pages: first those whose classes the scenario of the overview names."""
BLOCK = re.compile(r"^```(?:python|toml)\n# (\S+\.\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

SCENARIO = """
title = "Somebody's own"
slots = 40
trials = 3

[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]

[encoding]
scheme = "plain"

[legitimate]
link = { quality = 0.9 }

[eavesdroppers.eve]
strategy = "naive"
link = { quality = 0.8 }
"""


HEAD = """
import numpy as np
from evedrop.extend import (
    Bernoulli, ConstantDelay, Naive, NoInnovations, Packet, PacketBlock, PacketReader, Plain, PlainEncoder, PlainEstimator,
    Scheme,
)


class Sends(Plain):
    def shared(self, keys, batch):
        encode = lambda encoder, k, x, predicted: self.packet(k, x)
        encoder = type("Encoder", (PlainEncoder,), {"encode": encode})
        return NoInnovations(self.process, batch.trials, encoder, lambda: PlainEstimator(self.process, batch.trials))
"""
ENTRY = {
    "scheme": "encoding.scheme",
    "eavesdropper": "eavesdroppers.eve.strategy",
    "link": "legitimate.link.loss.model",
    "delay": "legitimate.link.delay.model",
}

"""What an eavesdropper of the paper's class may be handed, and how it is made."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from emulator.model.packet_user import PacketUser
from emulator.model.process import Process
from emulator.streams import Batch


@dataclass(frozen=True)
class Knowledge:
    """Everything an eavesdropper may know: the public model, its own parameters, the keys of its streams."""

    process: Process
    state_probability: float
    """μ_d."""
    parameters: Mapping[str, float]
    keys: Mapping[str, bytes]
    """Of the strategy's `streams`: `schedule`, and `coin` for its own random numbers."""


class Eavesdropper(PacketUser):
    """A strategy: which packets it takes for the state. `streams` and `parameters` name what it must be given."""

    streams: ClassVar[tuple[str, ...]] = ()
    parameters: ClassVar[tuple[str, ...]] = ()

    def __init__(self, knowledge: Knowledge, batch: Batch) -> None:
        super().__init__(knowledge.process, batch.trials)

    @classmethod
    @abstractmethod
    def use_probabilities(cls, parameters: Mapping[str, float]) -> tuple[float, float]:
        """P(b = 1 given ν = 0) and P(b = 1 given ν = 1), for the theory."""

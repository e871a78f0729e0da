"""`[wire]`: receivers whose links draw their random numbers as the links of a wire do, so that packets have the same fates.

Source: docs/scenario.md, wire; docs/wire.md, a wire as the network of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from evedrop.model.streams import root_of_seed, stream_key
from evedrop.scenario.table import Table

PUT = "put"
"""The kind of a published message, among the kinds that draw numbers of their own."""


def wire_stream(stream: str, kind: str, key: str) -> str:
    """The name of the random stream of a Zenoh key's messages on a link of a wire, under the root of the wire's seed.

    stream: as in `streams_of`, with the name of the link; kind: of the messages.
    """
    return f"wire/{stream}/{kind}/{key}"


def wire_stream_key(root: bytes, stream: str, kind: str, key: str) -> bytes:
    """The key of the random numbers of `wire_stream`."""
    return stream_key(root, wire_stream(stream, kind, key))


class WireTable(Table):
    """`[wire]`: the packet of slot k has the fate of the k-th message that is published on a key."""

    seed: Annotated[int, Field(ge=0, lt=2**256, strict=True, examples=[7])]
    key: Annotated[str, Field(strict=True, min_length=1, examples=["robot/pose"])]
    links: Annotated[
        dict[str, Annotated[str, Field(strict=True, min_length=1)]], Field(examples=[{"legitimate": "radio"}])
    ]

    def stream_keys(self, streams: tuple[str, ...]) -> Mapping[str, bytes]:
        """Stream → its key, for those streams of receivers' links that are a wire's."""
        root = root_of_seed(self.seed)
        keys_ = {}
        for stream in streams:
            kind, _, receiver = stream.partition("/")
            if receiver in self.links:
                keys_[stream] = wire_stream_key(root, f"{kind}/{self.links[receiver]}", PUT, self.key)
        return keys_

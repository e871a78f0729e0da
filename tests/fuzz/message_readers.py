"""Readers of the messages of a live run."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from evedrop.errors import EvedropError
from tests.fuzz.reader import Reader, as_msgpack, raw
from tests.live.protocol import golden


def _messages(name: str) -> Callable[[], list[bytes]]:
    return lambda: [golden.parts_of(golden.GOLDEN[name])[2]]


def _message(name: str) -> Callable[[bytes, Path], None]:
    shape, value, _ = golden.parts_of(golden.GOLDEN[name])
    decode = golden.CODECS[name.split(",", maxsplit=1)[0]][1]
    return lambda data, _: _decoded(decode, shape, value, data)


def _decoded(decode: golden.Decode, shape: dict[str, Any], value: dict[str, Any], data: bytes) -> None:
    try:
        decode(shape, value, data)
    except EvedropError:
        raise
    except Exception as error:
        # The test of the golden bytes makes values of what was read, of messages that say what it expects.
        last = traceback.extract_tb(error.__traceback__)[-1]
        if last.filename != golden.__file__:
            raise


def _every_message() -> Iterator[tuple[str, Reader]]:
    for name in golden.MESSAGES:
        title = "message-" + "-".join(name.replace(",", " ").replace("/", " ").split())
        yield title, Reader(_messages(name), _message(name), (raw, as_msgpack, as_msgpack), status=3)


MESSAGES: dict[str, Reader] = dict(_every_message())
"""Of every message with golden bytes in docs/protocol.md."""

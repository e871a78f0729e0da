"""A lane as a picture in the page: a row of pixels, one for each slot, as a PNG of a few hundred bytes."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence

import numpy as np

from evedrop.model.receiver import Codes
from evedrop.report.markup import Node, element
from evedrop.view.palette import Colour

_MOST_PIXELS = 2000


def strip(codes: Codes, colours: Sequence[Colour], label: str, worst: bool = False) -> Node:
    """A lane; codes (c,) are indices into colours, label: what it shows, in words.

    A pixel of a long run stands for several slots: it has their most frequent code, or with `worst` the highest.
    """
    row = _shortened(codes, len(colours), worst)
    header = struct.pack(">IIBBBBB", len(row), 1, 8, 3, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + b"".join(
        _chunk(kind, body)
        for kind, body in (
            (b"IHDR", header),
            (b"PLTE", bytes(value for colour in colours for value in colour)),
            (b"IDAT", zlib.compress(b"\0" + row.tobytes(), 9)),
            (b"IEND", b""),
        )
    )
    source = f"data:image/png;base64,{base64.b64encode(data).decode()}"
    return element("img", src=source, alt=label, class_="strip", width=len(row), height=1)


def _shortened(codes: Codes, kinds: int, worst: bool) -> Codes:
    count = len(codes)
    if count <= _MOST_PIXELS:
        return codes.astype(np.uint8)
    starts = np.linspace(0, count, _MOST_PIXELS + 1).astype(int)[:-1]
    if worst:
        return np.maximum.reduceat(codes, starts).astype(np.uint8)
    counts = [np.add.reduceat((codes == kind).astype(np.int64), starts) for kind in range(kinds)]
    found: Codes = np.argmax(counts, axis=0).astype(np.uint8)
    return found


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

"""A lane as a picture in the page: a row of pixels, one for each slot, as a PNG of a few hundred bytes."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence

from evedrop.model.receiver import Codes
from evedrop.show.report.markup import Node, element
from evedrop.show.view.palette import Colour

PIXELS = 2000
"""The most pixels of a lane. Each of a long run stands for several slots: for their most frequent code, or the highest."""


def strip(row: Codes, colours: Sequence[Colour], label: str) -> Node:
    """A lane; row: the code of each pixel, an index into colours, at most `PIXELS`. label: what it shows, in words."""
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


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

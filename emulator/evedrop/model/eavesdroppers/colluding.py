"""Colluding eavesdroppers: several links and one reader, which hears what any of the links delivers.

The links themselves are pooled: a packet reaches the reader if any of its links delivers it. For the reader that is one
better link, so nothing remains to be done here.
"""

from __future__ import annotations

from evedrop.model.eavesdroppers.delegate import Delegate


class Colluding(Delegate):
    """Reads as the strategy `reads_as` does.

    Source: docs/mathematics.md, further eavesdroppers.
    """

    pools_links = True

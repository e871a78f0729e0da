"""Colluding eavesdroppers: several links, one reader. What any of them heard, all of them have.

Pooling is done where the links are: a packet reaches the reader if any of its links delivers it. To the reader that is one
better link, so there is nothing to do here.
"""

from __future__ import annotations

from evedrop.model.eavesdroppers.delegate import Delegate


class Colluding(Delegate):
    """Reads as the strategy `reads_as` does.

    Source: docs/mathematics.md, further eavesdroppers.
    """

    pools_links = True

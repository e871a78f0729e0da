"""The keys of Zenoh's advanced publishers: KEY/@adv/… for the history, heartbeats and recovery of the messages on KEY.

After `@adv` come the Zenoh id of a session, and numbers of its own, which differ from run to run.

Source: docs/wire.md, what comes late.
"""

from __future__ import annotations

from typing import Final

_MARK = "/@adv"
_HISTORY = f"{_MARK}/"
LOST_HISTORY_SECONDS: Final = 0.5
"""How long the asker of a history waits for a lost question or answer: an advanced subscriber holds back new messages."""


def published_key(key: str) -> str | None:
    """KEY, if a key is `KEY/@adv/…`; None for all other keys."""
    return key.partition(_HISTORY)[0] if _HISTORY in key else None


def numbered_as(key: str) -> str:
    """The key with which messages share their numbers and random streams: `KEY/@adv` for `KEY/@adv/…`, or else their own."""
    published = published_key(key)
    return key if published is None else f"{published}{_MARK}"

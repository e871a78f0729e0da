"""The observer's news to the launcher: a JSON object a line on standard output."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from typing import Any


def set_news_apart() -> None:
    """Let the file descriptor 1 be standard error from now on: Zenoh logs there, in the middle of the news."""
    sys.stdout.flush()
    sys.stdout = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)


def tell(event: str, **news: Any) -> None:
    """A line to the launcher; nobody has to listen."""
    with suppress(BrokenPipeError):
        print(json.dumps({"event": event, **news}, ensure_ascii=False), flush=True)  # noqa: T201 - the launcher reads it

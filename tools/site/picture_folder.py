"""Pictures of the site that are kept from one build to the next, until the program changes."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "build" / "gallery"


@cache
def program_digest() -> bytes:
    """A digest of the program's source."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "emulator").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.digest()

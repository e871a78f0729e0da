"""The type of a part of Zenoh's own configuration."""

from __future__ import annotations

from typing import Any

ZenohConfig = dict[str, Any]
"""A JSON object whose entries Zenoh defines."""

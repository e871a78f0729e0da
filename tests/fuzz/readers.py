"""Every reader of bytes that somebody else made."""

from __future__ import annotations

from tests.fuzz.message_readers import MESSAGES
from tests.fuzz.reader import Reader
from tests.fuzz.results_readers import OF_RESULTS
from tests.fuzz.scenario_readers import OF_SCENARIOS

FILES: dict[str, Reader] = {**OF_SCENARIOS, **OF_RESULTS}
"""Files that commands of a user read."""

READERS: dict[str, Reader] = {**FILES, **MESSAGES}

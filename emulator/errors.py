"""One exception tree; every message ends with the remedy.

EvedropError                    exit status
├── UsageError                  2   the command line or a file it names cannot be used
│   ├── ScenarioError           2   the scenario has mistakes: all of them, listed
│   ├── TraceError              2   a recording cannot be read as one
│   └── DisturbanceError        2   a table of disturbances cannot be read as one: all that is wrong, listed
├── BriefError                  2   a brief cannot be read or does not fit
├── RunError                    3   a process failed or a packet is unaccounted for
│   ├── MalformedMessage        3   a message breaks the protocol: names sender, key and bytes
│   └── Gap                     3   a slot is missing, doubled or out of order
└── Interrupted               130   the user ended the run; results so far are written
"""

from __future__ import annotations

MOST_MISTAKES = 100
"""Of a scenario, in one message: nobody reads more at a time."""


LONGEST_LINE = 900
"""Characters of one mistake of a scenario."""


class EvedropError(Exception):
    """Base of every error this project raises on purpose."""

    exit_status = 3


class UsageError(EvedropError):
    """The command line, or a file it names, cannot be used."""

    exit_status = 2


class ScenarioError(UsageError):
    """A scenario with mistakes: `mistakes` lists every one, a line each, up to `MOST_MISTAKES`."""

    def __init__(self, source: str, mistakes: list[str]) -> None:
        self.source = source
        more = len(mistakes) - MOST_MISTAKES
        short = [line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}…" for line in mistakes[:MOST_MISTAKES]]
        self.mistakes = short if more <= 0 else [*short, f"and {more} more"]
        count = "1 mistake" if len(mistakes) == 1 else f"{len(mistakes)} mistakes"
        super().__init__("\n".join([f"{source}: {count}, nothing was started", *(f"  {line}" for line in mistakes)]))


class TraceError(UsageError):
    """A recording of a link that is none: `entry` says what must change, the `file` or the `column`; `what` says why."""

    def __init__(self, path: str, entry: str, what: str) -> None:
        self.entry = entry
        self.what = what
        super().__init__(f"{path}: {what}")


class DisturbanceError(UsageError):
    """A table of disturbances that is none: `mistakes` lists every one, with its line in the file."""

    def __init__(self, path: str, mistakes: list[str]) -> None:
        self.mistakes = mistakes
        super().__init__("\n".join(f"{path}: {line}" for line in mistakes))


class BriefError(EvedropError):
    """A brief that cannot be read, is readable by others, or belongs to another role."""

    exit_status = 2


class RunError(EvedropError):
    """A process failed, or a packet is unaccounted for."""


class MalformedMessage(RunError):
    """A message that breaks the protocol of docs/protocol.md."""

    def __init__(self, key: str, found: str, expected: str, payload: bytes) -> None:
        shown = payload[:48].hex(" ") + (" …" if len(payload) > 48 else "")
        super().__init__(
            f"malformed message on {key}: {found}; expected {expected}. "
            f"Its {len(payload)} bytes: {shown}. Check that its sender speaks docs/protocol.md"
        )


class Gap(RunError):
    """A slot that is missing, doubled or out of order: the transport lost what the link did not."""

    def __init__(self, key: str, expected: int, found: int) -> None:
        super().__init__(
            f"gap on {key}: slot {found} arrived where slot {expected} was due. No link loses whole messages, "
            "so a process or the transport did; look at the logs of the sender and of the router"
        )


class Interrupted(EvedropError):
    """The user ended the run."""

    exit_status = 130

"""The exceptions of the project, in one tree; every message ends with the remedy.

EvedropError                    exit status
├── UsageError                  2   the command line or a file it names cannot be used
│   ├── ScenarioError           2   the scenario has mistakes: all of them, listed
│   ├── TraceError              2   a recording of a link cannot be read
│   └── DisturbanceError        2   a table of disturbances cannot be read: its mistakes, listed
├── BriefError                  2   a brief cannot be read or does not fit
├── RunError                    3   a process failed or a packet is unaccounted for
│   ├── MalformedMessage        3   a message breaks the protocol: names sender, key and bytes
│   ├── Gap                     3   a slot is missing, doubled or out of order
│   ├── Refusal                 3   another process could not read a message
│   ├── Contradiction           3   a process contradicts itself, or another process
│   ├── ClassFailed             3   a class that is not built in failed: names it, the slots and the trials
│   ├── Silence                 3   a process is on the network and does nothing
│   └── MissingProcesses        3   processes did not appear
└── Interrupted               130   the user ended the run; results so far are written
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from evedrop.counting import counted

MOST_MISTAKES = 100
"""The most mistakes of a scenario in one message: more would not be read."""


LONGEST_LINE = 900
"""The most characters of one mistake of a scenario."""


class EvedropError(Exception):
    """Base class of all errors that this project raises on purpose."""

    exit_status = 3
    resumable: str | None = None
    """The folder of the study that the error ended, if the study can go on from there."""

    @property
    def illustrated(self) -> str:
        """The message as a terminal shows it: with the lines of a file that it is about, where there are any."""
        return str(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """How pickle copies an error: from its message, because its constructor's arguments are not kept."""
        return _copied, (type(self), self.args, self.__dict__)


def _copied(kind: type[EvedropError], args: tuple[Any, ...], state: Mapping[str, Any]) -> EvedropError:
    """The copy of an error, made without its constructor."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


class UsageError(EvedropError):
    """The command line, or a file it names, cannot be used."""

    exit_status = 2


class FolderTaken(UsageError):
    """Another run has begun in a results folder that was empty."""


class ScenarioError(UsageError):
    """A scenario with mistakes: `mistakes` lists them, one line each, up to `MOST_MISTAKES`."""

    def __init__(self, source: str, mistakes: list[str], excerpts: Sequence[str] = ()) -> None:
        """excerpts: for each mistake, the line of the file with carets below what is wrong; empty for none."""
        self.source = source
        self._all = mistakes
        more = len(mistakes) - MOST_MISTAKES
        self._excerpts = [*excerpts[:MOST_MISTAKES], ""] if more > 0 else excerpts
        whole = (line.replace("\n", r"\n") for line in mistakes[:MOST_MISTAKES])  # also with a name of two lines
        short = [line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}…" for line in whole]
        self.mistakes = short if more <= 0 else [*short, f"and {more} more"]
        told = f"{source}: {counted(len(mistakes), 'mistake')}, nothing was started"
        super().__init__("\n".join([told, *(f"  {line}" for line in self.mistakes)]))

    def numbered(self, line_of: Callable[[str], int | None], excerpt: Callable[[str, int], str]) -> ScenarioError:
        """The same with the line of each mistake's entry.

        line_of: dotted path → line, None if the file has no such entry; excerpt: mistake and line → the line as it is shown.
        """
        paths = [mistake.partition(":")[0] for mistake in self._all]
        lines = [line_of(path) for path in paths]
        return ScenarioError(
            self.source,
            [
                mistake if line is None else f"{mistake} (line {line})"
                for mistake, line in zip(self._all, lines, strict=True)
            ],
            ["" if line is None else excerpt(mistake, line) for mistake, line in zip(self._all, lines, strict=True)],
        )

    @property
    def illustrated(self) -> str:
        """The message, with the lines of the file."""
        first, *lines = str(self).split("\n")
        if not any(self._excerpts) or len(lines) != len(self._excerpts):
            return str(self)
        pairs = zip(lines, self._excerpts, strict=True)
        return "\n".join([first, *(part for pair in pairs for part in pair if part)])


class TraceError(UsageError):
    """An unusable recording of a link: `entry` says which entry must change, `file` or `column`; `reason` says why.

    The message itself is for the command line: `typed` is `reason` with options in place of entries, where the two differ.
    """

    def __init__(self, path: str, entry: str, reason: str, typed: str | None = None) -> None:
        self.entry = entry
        self.reason = reason
        super().__init__(f"{path}: {reason if typed is None else typed}")


class DisturbanceError(UsageError):
    """An unusable table of disturbances: `mistakes` lists the mistakes, up to five of a kind, with their lines in the file."""

    def __init__(self, path: str, mistakes: list[str]) -> None:
        self.mistakes = mistakes
        super().__init__("\n".join(f"{path}: {line}" for line in mistakes))


class BriefError(EvedropError):
    """A brief that cannot be read, is readable by others, or belongs to another role."""

    exit_status = 2


class RunError(EvedropError):
    """A process failed, or a packet is unaccounted for."""

    at_fault: tuple[str, ...] = ()
    """The processes at fault, if known."""
    missing: tuple[str, ...] = ()
    """The processes that were not on the network, if it is about them."""


class MalformedMessage(RunError):
    """A message that breaks the protocol of docs/protocol.md; `at_fault` names its sender, the only writer of its key."""

    def __init__(self, key: str, actual: str, expected: str, payload: bytes, sender: str = "") -> None:
        shown = payload[:48].hex(" ") + (" …" if len(payload) > 48 else "")
        super().__init__(
            f"malformed message on {key}: {actual}; expected {expected}. "
            f"Its {len(payload)} bytes: {shown}. Check that {sender or 'its sender'} speaks docs/protocol.md"
        )
        self.key = key
        self.at_fault = (sender,) if sender else ()


class Gap(RunError):
    """A slot that is missing, doubled or out of order: the transport lost what the link did not."""

    def __init__(self, key: str, expected: int, actual: int, sender: str = "") -> None:
        super().__init__(
            f"gap on {key}: slot {actual} arrived where slot {expected} was due. No link loses whole messages, "
            f"so a process or the transport did; look at the logs of {sender or 'the sender'} and of the router"
        )
        self.key = key
        self.at_fault = (sender,) if sender else ()


class Refusal(RunError):
    """Another process could not read a message, and reported this before it ended."""

    def __init__(self, process: str, key: str, sender: str, why: str) -> None:
        """process: that refused the message; key, sender: of the message; why: the process's reason."""
        self.at_fault = (sender,)
        self.key = key
        about = "" if key in why else f"malformed message on {key}: "
        super().__init__(f"{about}{why} (refused by {process})")


class Contradiction(RunError):
    """A process contradicts its own earlier messages, or another process's messages about the same slots."""

    def __init__(self, process: str, contradiction: str, against: str | None = None) -> None:
        """against: the other process; None if the process contradicts itself."""
        self.at_fault = (process,) if against is None else (process, against)
        look = f"logs/{process}.log" if against is None else f"logs/{process}.log and logs/{against}.log"
        super().__init__(f"{process} contradicts {against or 'itself'}: {contradiction}; look at {look}")


class Silence(RunError):
    """Processes that are on the network and do nothing, while all others wait for them."""

    def __init__(self, processes: tuple[str, ...], failure: str) -> None:
        self.at_fault = processes
        super().__init__(f"{' and '.join(processes)}: {failure}")


class ClassFailed(RunError):
    """A class that is not built in raised an error, or gave a wrong result."""


class UnwrittenResults(RunError):
    """The disk refuses the results of a run, for which no process is to blame."""


class NoRouter(RunError):
    """No router answered a process for too long."""


class MissingProcesses(RunError):
    """Processes that did not appear on the network: `missing`."""

    def __init__(self, process: str, missing: tuple[str, ...], when: str) -> None:
        """process: that waited for them; when: the rest of the sentence."""
        self.missing = missing
        super().__init__(f"{process}: {', '.join(missing)} did not appear {when}")


class Interrupted(EvedropError):
    """The user ended the run."""

    exit_status = 130

    def __init__(self, message: str = "interrupted") -> None:
        super().__init__(message)

    @classmethod
    def with_results(cls, folder: object) -> Interrupted:
        """The same, where a folder holds the results so far."""
        return cls(f"interrupted; the results so far are in {folder}")


class NoAnswer(Exception):
    """A class raised an error, gave an invalid answer, or did not answer when asked; the text says which."""


class UnknownName(KeyError):
    """A name that results do not have; the message says which they have."""

    def __init__(self, kind: str, name: object, choices: Iterable[str]) -> None:
        """kind: that of the thing, such as "receiver"."""
        names = [*choices]
        super().__init__(kind, name, names)  # what a copy is made from in another process
        expected = f"expected one of {', '.join(names)}" if names else "these results have none"
        self._message = f"there is no {kind} {name!r}; {expected}"

    def __str__(self) -> str:
        return self._message


class NotRegistered(KeyError):
    """A name that no class has. `why` continues a message after `is "NAME"`; empty if it is not the name of a user's class."""

    def __init__(self, name: str, why: str = "") -> None:
        super().__init__(name)
        self.name = name
        self.why = why

    def __str__(self) -> str:
        return f"{self.name}{self.why or ' is not the name of a class; look at docs/your-own/overview.md'}"

"""Reads from an MCAP recording which messages of a topic are missing, and how long the others took.

Source: docs/links.md, recordings of messages.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn, final

import numpy as np
from numpy.typing import NDArray

from evedrop.counting import counted
from evedrop.errors import TraceError
from evedrop.model.process import Floats
from evedrop.scenario.recordings.message_recording import (
    WRAP,
    MessageArrivals,
    MessageRecording,
    MessageSeries,
    check_parts,
    numbers_of_times,
    series_of,
)
from evedrop.system.files import Unreadable, is_folder, opened, why_of

if TYPE_CHECKING:
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

SUFFIX = ".mcap"
_RECORD = struct.Struct("<BQ")  # its kind, and its length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, time of publication
_CHANNEL_RECORD, _MESSAGE_RECORD = 4, 5
_MOST_SHOWN = 10  # topics that a message lists
_MOST_OFF = 0.01  # of the messages of a periodic sender, which may be a quarter of a period early or late
_SHARED = 0.9  # of the missing numbers, which another topic has: then one counter numbers all topics
_OWN = 0.01  # of the numbers, which two topics may both have by chance if one counter numbers all
_OLD = 1.0  # seconds before the recording began: earlier messages were kept for late subscribers
_LONGEST_DELAY = 3600.0  # seconds; a longer one is a difference of clocks
_RELIABLE = ("reliability: reliable", "reliability: 1\n")


@final
@dataclass
class _Channel:
    """What is kept of the messages of one channel."""

    topic: str
    metadata: str
    numbers: list[int] = field(default_factory=list)
    """Of each message: sequence, log time and time of publication."""


@dataclass(frozen=True)
class _Messages:
    """The messages of one channel, in the order in which they were recorded."""

    topic: str
    metadata: str
    sequences: NDArray[np.int64]
    logged: NDArray[np.int64]
    """Nanoseconds, (m,)."""
    published: NDArray[np.int64]

    @property
    def is_numbered(self) -> bool:
        """Whether the messages have numbers of their own."""
        return bool(self.sequences.min() != self.sequences.max())

    @property
    def has_sending_times(self) -> bool:
        """Whether the times of publication are the senders' and not copies of the recorder's time."""
        return bool((self.published > 0).all() and (self.published != self.logged).any())

    @property
    def sent(self) -> Floats:
        """The best time of sending that there is, in seconds."""
        return (self.published if self.has_sending_times else self.logged) / 1e9

    def of(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> _Messages:
        """Some of the messages."""
        return replace(
            self, sequences=self.sequences[which], logged=self.logged[which], published=self.published[which]
        )


def is_mcap(path: Path) -> bool:
    """Whether a path is an MCAP file by its name, or the folder of a bag of such files."""
    return path.suffix == SUFFIX or (is_folder(path) and any(path.glob(f"*{SUFFIX}")))


def mcap_recording(
    path: Path, topic: str | None = None, period: float | None = None, longest: float | None = None
) -> MessageRecording:
    """What became of the messages of a topic.

    path: a file, or the folder of a bag with several. period: seconds, of a sender without numbers that sends regularly.
    longest: as for `series_of`.

    Raises TraceError if the recording cannot be read, or does not tell which messages are missing.
    """
    return _Contents(path).recording(topic, period, longest)


@final
class _Contents:
    """The contents of a recording, without the messages' data."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._notes: list[str] = []
        self._channels: list[_Messages] = []
        self._began = 0

    def recording(self, topic: str | None, period: float | None, longest: float | None) -> MessageRecording:
        """See `mcap_recording`."""
        self._channels = self._read()
        self._began = min((int(channel.logged[0]) for channel in self._channels), default=0)
        chosen = self._chosen(topic, period)
        name = f"{self._path}, {chosen.topic}"
        if _RELIABLE[0] in chosen.metadata or _RELIABLE[1] in chosen.metadata:
            self._notes.append(
                "its publisher offers reliable delivery: messages that the network lost were sent again, so these are the losses "
                "that remained, and resent messages count as delayed"
            )
        chosen = self._without_old(chosen)
        series = self._numbered(chosen, longest) if period is None else self._periodic(chosen, period, longest)
        check_parts(name, series, "the publisher was started again so often, or several share the topic")
        return MessageRecording(
            name,
            series,
            self._delays(chosen, series),
            notes=tuple(self._notes),
            keys=f"*/{chosen.topic.strip('/')}/**",
        )

    def _read(self) -> list[_Messages]:
        """All channels with messages. Raises TraceError if there are none."""
        try:
            from mcap.stream_reader import StreamReader  # noqa: PLC0415 - an optional extra
        except ImportError as error:
            raise TraceError(
                str(self._path), "file", "is an MCAP recording; expected pip install '.[mcap]' in the checkout first"
            ) from error
        channels: dict[tuple[int, int], _Channel] = {}
        for number, path in enumerate(self._files()):
            try:
                with opened(path) as file:
                    reader = StreamReader(file, emit_chunks=True, record_size_limit=2**30)
                    _keep(self._records(path, reader, file), channels, number)
            except Unreadable as error:
                self._no(f"cannot be read ({why_of(error)}); expected an MCAP recording", error)
        messages = _joined_by_topic(channels.items())
        if not messages:
            self._no("has no messages; expected an MCAP recording of a topic")
        return messages

    def _files(self) -> Sequence[Path]:
        if not is_folder(self._path):
            return [self._path]
        return sorted(self._path.glob(f"*{SUFFIX}"))

    def _records(self, path: Path, reader: StreamReader, file: BinaryIO) -> Iterator[Any]:
        """Channels, and messages as tuples as in `_MESSAGE`, up to the end or up to where the file breaks off."""
        from mcap.records import Channel, Chunk, Message  # noqa: PLC0415 - an optional extra

        read = False
        try:
            for record in reader.records:
                read = True
                if isinstance(record, Chunk):
                    yield from _in_chunk(record)
                elif isinstance(record, Channel):
                    yield record
                elif isinstance(record, Message):
                    yield record.channel_id, record.sequence, record.log_time, record.publish_time
        except Exception as error:  # a damaged file makes the library and its decompressors raise errors of many kinds
            if read and not file.read(1):
                self._notes.append(f"{path.name} breaks off: fitted up to there")
            elif not read:
                self._no("does not begin as an MCAP recording does; expected one, decompressed", error)
            else:
                problem = f"is damaged ({why_of(error)}); expected an MCAP recording, such as mcap recover makes of it"
                self._no(problem, error)

    def _chosen(self, topic: str | None, period: float | None) -> _Messages:
        """The messages of the topic that was named, or of the only one that can be fitted."""
        topics = Counter(channel.topic for channel in self._channels)
        candidates = [channel for channel in self._channels if topic in {None, channel.topic}]
        if not candidates:
            self._no(f'has no topic "{topic}"; it has {self._some(self._channels)}')
        usable = candidates if period is not None else [channel for channel in candidates if channel.is_numbered]
        if not usable:
            self._unnumbered(candidates)
        if len(usable) > 1:
            if topics[usable[0].topic] == len(usable):
                self._no(
                    f'has {len(usable)} channels for the topic "{usable[0].topic}", so several publishers share it; '
                    "expected a recording of one of them"
                )
            self._no(f"has several topics; expected --topic and one of {self._some(usable)}")
        return usable[0]

    def _unnumbered(self, candidates: Sequence[_Messages]) -> NoReturn:
        """Say why nothing can be learned from messages without numbers."""
        first = candidates[0]
        usual = float(np.median(np.diff(np.sort(first.sent)))) if len(first.sent) > 1 else 0.0
        hint = f" (the median of {first.topic} is {usual:.4g} s)" if len(candidates) == 1 else ""
        self._no(
            f"numbers no message of {self._some(candidates)}: every sequence is {first.sequences[0]}, as ros2 bag record writes "
            "it, so what is missing cannot be seen. If the publisher sends regularly, give its period in seconds as "
            f"--period{hint}; else record a wire's journal, or with a recorder that keeps publication_sequence_number"
        )

    def _without_old(self, messages: _Messages) -> _Messages:
        """Without messages that were sent long before the recording began, and kept for subscribers that come late."""
        if not messages.has_sending_times:
            return messages
        old = np.cumprod(messages.published < self._began - _OLD * 1e9).astype(np.bool_)
        if not old.any() or old.all():  # all: the clocks differ
            return messages
        self._notes.append(
            f"left out: {counted(int(old.sum()), 'message')} from before the recording, kept for late subscribers"
        )
        return messages.of(~old)

    def _numbered(self, messages: _Messages, longest: float | None) -> MessageSeries:
        """What became of messages with numbers."""
        self._check_counter(messages)
        sent = messages.published / 1e9 if messages.has_sending_times else None
        series = self._series(MessageArrivals(messages.sequences, messages.logged / 1e9, sent), longest, WRAP)
        if series.outcomes.all():
            self._no(
                f"lacks none of {len(series.outcomes)} numbers of {messages.topic}: either nothing was lost, or the recorder "
                "itself counted what it received, which looks the same"
            )
        if sent is None and series.repeated > 0.2 * len(messages.sequences):
            self._no(
                f"has {series.repeated} of {len(messages.sequences)} numbers of {messages.topic} twice, and no times of "
                "sending that could tell repeated messages from two publishers that count alike"
            )
        return series

    def _check_counter(self, messages: _Messages) -> None:
        """Raise TraceError if one counter numbers the messages of all topics, so a gap is not a loss."""
        own = set(messages.sequences.tolist())
        others = {number for other in self._channels if other is not messages for number in other.sequences.tolist()}
        span = range(min(own), max(own) + 1)
        missing = len(span) - len(own)
        elsewhere = sum(span.start <= number < span.stop for number in others - own)
        if missing and elsewhere > _SHARED * missing and len(own & others) < _OWN * len(own):
            self._no(
                f"numbers the messages of all topics with one counter: {elsewhere} of the {missing} numbers that "
                f"{messages.topic} lacks are on other topics. The recorder counted what it received, which shows no loss"
            )

    def _periodic(self, messages: _Messages, period: float, longest: float | None) -> MessageSeries:
        """The fates of messages that are sent regularly."""
        sent = np.sort(messages.sent)
        numbers, off = numbers_of_times(sent, period)
        if off > _MOST_OFF:
            self._no(
                f"has {100 * off:.3g} % of {messages.topic} more than a quarter of {period:g} s away from where a sender "
                f"with that period would send: their median distance is {float(np.median(np.diff(sent))):.4g} s. Without a "
                "steady period a message that was lost cannot be told from one that was never sent"
            )
        self._notes.append(
            f"numbered by their times, {period:g} s apart ({100 * off:.2g} % are more than a quarter of that off): "
            "a message that the publisher left out counts as lost"
        )
        return self._series(MessageArrivals(numbers, sent, sent), longest, None)  # which keeps all, in any order

    def _series(self, arrivals: MessageArrivals, longest: float | None, wrap: int | None) -> MessageSeries:
        try:
            return series_of(arrivals, longest, wrap)
        except ValueError as error:
            self._no(str(error), error)

    def _delays(self, messages: _Messages, series: MessageSeries) -> Floats:
        """Seconds from sending to recording, of each message that arrived; empty if they are unknown."""
        if not messages.has_sending_times:
            self._notes.append(
                "no delays: the recorder wrote its own time as the time of publication, as ros2 bag record did before Jazzy"
            )
            return np.empty(0)
        delays: Floats = (messages.logged - messages.published)[series.first_arrivals] / 1e9
        wrong = int((delays < 0).sum())
        if wrong or delays.max() > _LONGEST_DELAY:
            problem = f"{wrong} of {len(delays)} are negative" if wrong else f"one is {delays.max():.4g} s"
            self._notes.append(
                f"no delays: {problem}, so sender and recorder did not use one clock (or one used simulated time)"
            )
            return np.empty(0)
        self._notes.append("delays are from time of publication to log time: right if one clock made both")
        return delays

    def _some(self, channels: Sequence[_Messages]) -> str:
        """Topics with their messages."""
        shown = [
            f"{channel.topic} ({counted(len(channel.sequences), 'message')})" for channel in channels[:_MOST_SHOWN]
        ]
        more = [] if len(channels) <= _MOST_SHOWN else [f"{len(channels) - _MOST_SHOWN} more"]
        return ", ".join(shown + more)

    def _no(self, problem: str, cause: Exception | None = None) -> NoReturn:
        raise TraceError(str(self._path), "file", problem) from cause


def _in_chunk(chunk: Chunk) -> Iterator[Any]:
    """The channels and messages of a chunk. The library would copy the contents of every message."""
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - an optional extra
    from mcap.records import Channel  # noqa: PLC0415 - the same
    from mcap.stream_reader import get_chunk_data_stream  # noqa: PLC0415 - the same

    stream, size = get_chunk_data_stream(chunk)
    content = stream.read(size)
    at = 0
    while at < size:
        kind, length = _RECORD.unpack_from(content, at)
        at += _RECORD.size
        if kind == _MESSAGE_RECORD:
            yield _MESSAGE.unpack_from(content, at)
        elif kind == _CHANNEL_RECORD:
            yield Channel.read(ReadDataStream(BytesIO(content[at : at + length])))
        at += length


def _keep(records: Iterator[Any], channels: dict[tuple[int, int], _Channel], file: int) -> None:
    """Keep the numbers and times of all messages, by file and channel."""
    for record in records:
        if isinstance(record, tuple):
            with suppress(KeyError):  # a message without a channel is a mistake of the recorder's
                channels[file, record[0]].numbers.extend(record[1:])
        else:
            metadata = "\n".join(record.metadata.values())
            channels.setdefault((file, record.id), _Channel(record.topic, f"{metadata}\n"))


def _joined_by_topic(channels: Iterable[tuple[tuple[int, int], _Channel]]) -> list[_Messages]:
    """The messages of each channel in the order of recording; a channel continues in the next file of a split bag."""
    by_topic: dict[tuple[str, int], list[_Channel]] = {}
    met: Counter[tuple[int, str]] = Counter()
    for (file, _), channel in channels:
        if channel.numbers:
            met[file, channel.topic] += 1
            by_topic.setdefault((channel.topic, met[file, channel.topic]), []).append(channel)
    joined = []
    for (topic, _), parts in by_topic.items():
        numbers = np.array([number for part in parts for number in part.numbers], np.uint64).astype(np.int64)
        messages = _Messages(topic, parts[0].metadata, *numbers.reshape(-1, 3).T)
        joined.append(messages.of(np.argsort(messages.logged, kind="stable")))
    return joined

"""The words of a wire's summary: its tables, and the sentences below them.

Source: docs/wire/results.md, the summary.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from evedrop.counting import counted
from evedrop.model.metrics.text import ShownNumber
from evedrop.results.wire_summary import WireSummary
from evedrop.score.summary import failed
from evedrop.show.report.closing import expectations_outcome
from evedrop.show.report.text_table import TextTable

WITHOUT_MODEL = {"overflow", "cut", "unlinked", "too_large", "looped", "too_many_keys"}
"""The reasons for which messages are lost before a link's models decide on them."""
NOTHING_HEARD = (
    "no message was heard: do the programs connect to the wire's endpoints, in Zenoh's mode client "
    "(ROS 2: with rmw_zenoh)?"
)
"""What to look at after a wire through which nothing went."""
_MARKS = {True: "yes", False: "NO", None: "–"}


def wire_title(summary: WireSummary) -> str:
    """How much a wire did, in a line."""
    return f"wire · seed {summary.seed} · {counted(summary.heard, 'message')} · {summary.seconds:,.1f} s"


def wire_table(summary: WireSummary) -> TextTable:
    """The table of the links."""
    heads = ["heard", "delivered", "lost", "dropped", "rate", "model", "within", "delay", "gap"]
    table = TextTable.headed(
        ["link"],
        heads,
        title=wire_title(summary),
        least=["gap", "model", "delay", "dropped", "lost", "heard", "delivered"],
    )
    for name, link in summary.links.items():
        median = link.delays.get("0.5")
        lost, dropped = sum(link.lost_by.values()), sum(link.dropped_by.values())
        table.add(
            name,
            *(ShownNumber(f"{count:,}", count) for count in (link.heard, link.delivered, lost, dropped)),
            *(ShownNumber("–" if rate is None else f"{rate:.4f}", rate) for rate in (link.rate, link.expected_rate)),
            _MARKS[link.within_bounds],
            "–" if median is None else ShownNumber(f"{1000 * median:.3g}", 1000 * median) + " ms",
            ShownNumber(f"{link.gap_messages:,}", link.gap_messages),
        )
    return table


def reasons_table(summary: WireSummary) -> TextTable:
    """Why messages did not arrive: a row for each link and reason."""
    table = TextTable.headed(["link"], ["messages"], ["reason"])
    for name, link in summary.links.items():
        for by, fate in ((link.lost_by, "lost"), (link.dropped_by, "dropped by the wire itself, or Zenoh")):
            for reason, count in by.items():
                table.add(name, f"{count:,}", f"{fate}: {reason.replace('_', ' ')}")
    return table


def wire_outcome(summary: WireSummary) -> tuple[str, bool | None]:
    """The outcome of a wire in a sentence, and whether it is good; None if there is nothing to judge."""
    sentence, good = expectations_outcome(summary.expectations, "wire")
    if summary.unaccounted:
        return f"unaccounted for: {counted(summary.unaccounted, 'message')}; {sentence}", False
    if summary.bypasses:
        return f"no verdict, because programs could speak past the wire; {sentence}", False
    if summary.journal.incomplete_since is not None:
        return f"the journal is incomplete; {sentence}", False
    if _unfinished(summary):
        return f"{_unfinished(summary)}; {sentence}", False if good is False else None
    return sentence[0].upper() + sentence[1:], good


def wire_sentences(summary: WireSummary) -> Iterator[str]:
    """Notes to the table: why messages did not arrive, and which expectations were met."""
    for name, link in summary.links.items():
        lost = _counted(link.lost_by)
        dropped = _counted(link.dropped_by)
        undecided = [reason for reason in (*link.lost_by, *link.dropped_by) if reason in WITHOUT_MODEL]
        if lost:
            yield f"{name} lost {lost}"
        if dropped:
            yield f"{name}: the wire itself, or Zenoh, dropped {dropped}"
        if undecided and link.rate is not None:
            reasons = " and ".join(reason.replace("_", " ") for reason in undecided)
            yield f"{name}: rate, model and within leave out the messages by {reasons}, on which its models did not decide"
    if not summary.heard:
        yield NOTHING_HEARD
    yield from unlinked_sentence(summary)
    yield from (judged.sentence for judged in summary.expectations if judged.held)


def unlinked_sentence(summary: WireSummary) -> Iterator[str]:
    """How many messages no link took, if there were some."""
    if summary.unlinked:
        yield f"no link of the file takes {counted(summary.unlinked, 'message')}; add a link, or let programs not publish them"


def wire_failures(summary: WireSummary) -> Iterator[str]:
    """What went wrong: faults, as below, and expectations that failed."""
    yield from wire_faults(summary)
    yield from (judged.sentence for judged in failed(summary.expectations))


def expectation_failures(summary: WireSummary, subjects: Sequence[str]) -> Iterator[str]:
    """The expectations that failed, each with what its link lost by which reasons. subjects: the link of each expectation."""
    for judged, name in zip(summary.expectations, subjects, strict=True):
        if judged.held is not True:
            link = summary.links[name]
            lost = _counted({**link.lost_by, **link.dropped_by}) or "none"
            yield f"{judged.sentence}; {name} lost {lost}, of {link.heard:,} heard"


def wire_faults(summary: WireSummary) -> Iterator[str]:
    """A wire that has not ended, ways past it, links outside their bounds, unaccounted messages, and an incomplete journal."""
    if _unfinished(summary):
        yield f"{_unfinished(summary)}: these are the metrics that its journal gives so far"
    yield from (f"no verdict: {bypass.event}" for bypass in summary.bypasses)
    for name, link in summary.links.items():
        if link.within_bounds is False and link.bounds is not None:
            low, high = link.bounds
            yield (
                f"{name} is outside the 99 % bounds of its model: it let {link.rate:.4f} of the messages through, where "
                f"{low:.4f} to {high:.4f} were expected"
            )
    if summary.unaccounted:
        yield f"unaccounted for: {counted(summary.unaccounted, 'message')}; this is a fault of Evedrop"
    if summary.journal.missing:
        yield f"the journal lacks {counted(summary.journal.missing, 'message')}, because its folder could not be written"
    elif summary.journal.incomplete_since is not None:
        yield (
            "the folder of the journal could not be written for some time: the journal has all messages, but perhaps not all "
            "changes and events"
        )


def _unfinished(summary: WireSummary) -> str:
    """The sentence about a wire that has not ended; empty if it has ended."""
    return {"running": "the wire still runs", "killed": "the wire was killed"}.get(summary.state, "")


def _counted(reasons: Mapping[str, int]) -> str:
    return ", ".join(f"{count:,} by {reason.replace('_', ' ')}" for reason, count in reasons.items())

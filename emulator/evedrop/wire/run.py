"""`evedrop wire`: opens a wire, carries out its events, shows it while it runs, and ends it in order.

It is shown in a window, on a page for browsers, or only in a file. Neither Rerun nor the viewer is loaded before a view is asked
for.

Source: docs/wire/results.md, the view.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from evedrop.counting import counted
from evedrop.errors import Interrupted, RunError
from evedrop.live.network.control_file import remove_control
from evedrop.results.folder import make_private, new_folder, replace_private
from evedrop.results.wire_summary import WIRE_FILE, WIRE_SUMMARY_FILE
from evedrop.scenario.receivers import PUT
from evedrop.show.report.wire import wire_failures
from evedrop.show.view.viewer import Viewer, choose
from evedrop.system.environment import check_zenoh_runtime
from evedrop.system.output import warn
from evedrop.system.waiting import SteadyClock
from evedrop.system.world import world
from evedrop.wire.file import resolved_wire
from evedrop.wire.history import Numbered
from evedrop.wire.journal import WireJournal
from evedrop.wire.journal_place import JOURNAL_FOLDER
from evedrop.wire.on_disk import closing_lines
from evedrop.wire.plan import WirePlan
from evedrop.wire.relay import WireRelay, open_sides
from evedrop.wire.scorekeeper import WireScorekeeper
from evedrop.wire.steering import WireConductor, WireControl
from evedrop.wire.watchdog import ANSWER_SECONDS, WORK_SECONDS, Duty, Watchdog, end_at_once

if TYPE_CHECKING:
    from evedrop.wire.recording import WireView


def run_wire(
    plan: WirePlan,
    out: Path,
    *,
    seconds: float | None = None,
    say: Callable[[str], None] = print,
    complain: Callable[[str], None] | None = None,
    view: str = "off",
) -> int:
    """Run a wire until a signal, or for some seconds; returns the exit status.

    out: its results folder, empty or that of an earlier start; say: for a line about each side and each event, and for the
    summary; complain: for what went wrong, by default as `say`; view: as `live_view` takes it.

    Raises UsageError if the folder, a side or `ZENOH_RUNTIME` cannot be used, and RunError if the folder was removed or messages
    of a side ceased to cross while the wire ran, or if the machine lacks threads.
    """
    check_zenoh_runtime()
    _shown(view)
    if (out / JOURNAL_FOLDER).is_dir():
        make_private(out)
    else:
        new_folder(out)
    events: list[str] = []

    def leave(why: str, status: int) -> NoReturn:
        end_at_once(f"{why}; {_on_disk(out)}", status, lambda: remove_control(out))

    with (
        Watchdog(lambda problem: leave(f"the wire no longer answers: {problem}", RunError.exit_status)) as watchdog,
        world().process.stop_or_leave_on_signals(lambda: leave("interrupted again", Interrupted.exit_status)) as stop,
    ):
        # The journal first: it refuses a folder that another wire uses, whose recording must stay. It begins after all that may
        # refuse this start: an earlier one then stays the latest.
        with closing(WireJournal(out, plan)) as journal, ExitStack() as opened:
            opening = Duty("while the sides were opened", ANSWER_SECONDS)
            with watchdog.doing(opening):
                sides = opened.enter_context(open_sides(plan))
            with live_view(plan, out, view, say, journal.place.clock) as shown, journal, opened.pop_all() as stack:
                scorekeeper = WireScorekeeper(plan, journal)
                if shown is not None:
                    shown.follow(journal)

                def happened(line: str) -> None:
                    events.append(line)
                    journal.note(line.partition(": ")[2])
                    say(line)

                _begin_results(out, plan)
                for line in _earlier(journal, plan):
                    say(line)
                relay = WireRelay(plan, journal, sides, warn, happened)
                # Before anything crosses: it applies what is in force at first.
                conductor = WireConductor(plan, relay, happened)
                with watchdog.doing(opening):
                    stack.enter_context(relay)
                for name, endpoints in relay.endpoints.items():
                    say(f"{name} {' '.join(endpoints)}")
                stack.enter_context(conductor)
                stack.enter_context(WireControl(out, relay, conductor, scorekeeper, journal, events))
                _watch(watchdog, relay, journal)
                stop.wait(seconds)
                watchdog.hurry()
                with watchdog.doing(Duty("while the wire was ended", waits=True)):
                    stack.close()
                with watchdog.doing(
                    Duty("in the journal, while its last files were written", end_seconds=WORK_SECONDS)
                ):
                    journal.close()
        status = scorekeeper.finish(out) if out.is_dir() else RunError.exit_status
    summary = scorekeeper.summary()
    for line in closing_lines(summary):
        say(line)
    for line in wire_failures(summary):
        (say if complain is None else complain)(line)
    if journal.place.removed is not None:
        raise RunError(_removed(journal.place.removed, out))
    say(f"results: {out}")
    if relay.failures:
        raise RunError("; ".join(dict.fromkeys(relay.failures)))
    return status


def _earlier(journal: WireJournal, plan: WirePlan) -> Iterator[str]:
    """Lines about the earlier starts in the wire's folder."""
    if journal.recovered:
        yield (
            f"an earlier start was killed or had a full disk: {counted(journal.recovered, 'message')} of it could be recovered, "
            "and the numbers go on"
        )
    if journal.history.start > 1:
        links = {link.name for link in plan.links}
        counts = {numbered: n for numbered, n in journal.counts.items() if numbered[0] in links}
        yield continuation(journal.history.start, counts)


def continuation(start: int, counts: Mapping[Numbered, int]) -> str:
    """The sentence about a start in the folder of an earlier one. counts: the number of each stream's next message, from 0."""
    if not counts:
        return f"start {start} continues start {start - 1}, which numbered no message of these links"
    (link, key, kind), number = max(counts.items(), key=lambda item: item[1])
    others = f", and likewise for {len(counts) - 1:,} more" if len(counts) > 1 else ""
    noun = "message" if kind == PUT else kind
    return (
        f"start {start} continues start {start - 1}: {noun} {number + 1:,} of {key} on the link {link} is next{others}; for the "
        "fates of a first start, give another folder"
    )


def _watch(watchdog: Watchdog, relay: WireRelay, journal: WireJournal) -> None:
    """Let a watchdog watch all threads of the wire, and ask its sides and its journal."""
    watchdog.watch(*relay.duties)
    for name, side in relay.sides.items():
        watchdog.ask(f"at the side {name}", side.answer)
    watchdog.ask("in the journal", journal.flush, WORK_SECONDS)


def _on_disk(out: Path) -> str:
    """The part of a sentence that says how to use the results of a wire that ended at once."""
    return (
        f"the wire has ended with what is on disk: `evedrop report {out}` shows it, and the next start with this folder goes on "
        "from there"
    )


def _removed(folder: Path, out: Path) -> str:
    """The sentence about a wire without a journal. folder: the one that was removed."""
    left = f"{out} has only the summary" if (out / WIRE_SUMMARY_FILE).is_file() else "only the table above is left"
    return (
        f"{folder} was removed or moved while the wire ran, so its records are not there, and {left}; start the "
        "wire again, and leave its folder in place while it runs"
    )


def _begin_results(out: Path, plan: WirePlan) -> None:
    """Write wire.toml, the complete file of the wire, and remove the summary of an earlier start."""
    try:
        world().disk.remove(out / WIRE_SUMMARY_FILE, missing_ok=True)
    except OSError as error:
        warn(f"the summary of an earlier start cannot be removed ({error}); the wire goes on")
    try:
        replace_private(out / WIRE_FILE, resolved_wire(plan))
    except OSError as error:
        warn(f"wire.toml cannot be written ({error}); the wire goes on")


def _shown(mode: str) -> str:
    """How a wire with a mode of `live_view` is shown: as `choose` says, or "off". Raises UsageError."""
    return "off" if mode.endswith(".rrd") else choose(mode)


@contextmanager
def live_view(
    plan: WirePlan, out: Path, mode: str, say: Callable[[str], None], clock: SteadyClock
) -> Iterator[WireView | None]:
    """A view of a wire that starts now, for the time of a `with` block; None for "off".

    mode: as `evedrop run --view`, or the name of a file that ends in .rrd: the recording is written there, and nothing is shown.
    out: the wire's folder. say: for the line with the address of the page. clock: that of the wire's journal.

    Raises UsageError for any other mode, and if a viewer cannot be started.
    """
    to_file, shown = mode.endswith(".rrd"), _shown(mode)
    if shown == "off" and not to_file:
        yield None
        return
    from evedrop.wire.recording import WireView  # noqa: PLC0415 - loads Rerun

    path = Path(mode) if to_file else out.absolute() / "recording.rrd"
    viewer = Viewer.start(shown, out / "logs", path)
    try:
        if viewer is not None and viewer.address is not None:
            say(f"the wire is shown to anybody who has this address:\n{viewer.address}")
        if viewer is not None and viewer.warning is not None:
            warn(viewer.warning)
        view = WireView(path, plan, out.resolve().name, clock.time(), clock=clock.time)
        try:
            yield view
        finally:
            view.close()
            if view.failure is not None:
                warn(view.failure)
    finally:
        if viewer is not None:
            viewer.complete()
            viewer.stop()

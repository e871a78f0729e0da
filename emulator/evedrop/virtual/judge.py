"""What must hold after a run in the simulated world, whatever happened to it.

The same trials in memory say which rows a run may write: it ends with all of them, or with those of the slots that it has done.

Source: docs/maintainers/simulated-world.md.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from evedrop.errors import Interrupted, RunError, UsageError
from evedrop.live.launch.briefs import LAUNCHED_PATIENCE
from evedrop.live.launch.other_hosts import TOLERATED
from evedrop.live.network.session import READY_SECONDS
from evedrop.live.protocol.keys import writer_of
from evedrop.names import RECORDER, RELAY, ROUTER, SENSOR
from evedrop.results.crash_proof_tables import last_round
from evedrop.results.reading import METRICS_AS_OF, Results
from evedrop.scenario.loading import load
from evedrop.scenario.plugins import named_in
from evedrop.scenario.progress_events import ConnectionOutage, RunProgress, Started
from evedrop.scenario.tables import Scenario
from evedrop.score.scorekeeper import verification_of
from evedrop.virtual.broken_messages import CONTRADICTIONS, BreakMessage
from evedrop.virtual.cases import SimulatedCase
from evedrop.virtual.disturbance import EVERYBODY, KILLED, ROUTERS, Disturbance, processes_of
from evedrop.virtual.faults import (
    BreakWrite,
    ConfuseKeys,
    CutConnection,
    DelayThread,
    DiskDisturbance,
    FillDisk,
    FlapConnection,
    FreezeConnection,
    HangProcess,
    HangUpProcess,
    InterruptProcess,
    KillProcess,
    RefuseWrite,
    ShortenMessage,
    StopAndKillProcess,
    StopProcess,
    TerminateProcess,
)
from evedrop.virtual.host_faults import FreezeSsh, LosePower
from evedrop.virtual.host_parts import PROGRAM, SESSION, host_of, part_of
from evedrop.virtual.metrics import slots_of_metrics, unlike_prefix, wrong_course
from evedrop.virtual.outsiders import LetStrangerIn, OperatorCommand
from evedrop.virtual.processes import FORK_SERVERS, LAUNCHER
from evedrop.virtual.reference import RunReference, summary_until, tables_of
from evedrop.virtual.results import lost_rows, wrong_outages, wrong_summary, wrong_tables
from evedrop.virtual.run import SimulatedRun
from evedrop.virtual.steered import broken_holds, wrong_scenario
from evedrop.virtual.traffic import is_late, wrong_messages

_HEEDED_SECONDS = 1.0
"""After a signal to the launcher, a run that has slots to come does not complete."""
_USUAL_SECONDS, _QUIET_SECONDS = 5.0, 1.5
"""That a run takes besides those of its slots, and that a run takes to which nothing happens."""
_FAULT_SECONDS, _BRIEF_SECONDS = 15.0, 6.0
"""That each fault may cost besides those that it lasts, and one of a second or less; none if no message is lost."""
_SUSPENDED_SECONDS = 3.0
"""That the end of a run takes if a receiver is suspended."""
_TELLS_SECONDS = 1.0
"""Within which a run tells of its progress."""
_AT_ONCE_SECONDS = 3.0
"""Within which a run, and all its processes, end because one of them has."""
_NOTICED_SECONDS = 0.1
"""Within which a connection that is cut is noticed."""
_ANSWERED_SECONDS, _ANSWERED_SLOTS = 3.0, 5
"""That the answer to an operator takes, and in how many slots a run is held, and does a few steps."""
_UNSAVED_SECONDS = 4.0
"""Within which rows are on the disk: of three seconds between two rounds, and of the time between two messages."""
_LEASE_SECONDS, _GIVES_UP_SECONDS = 4.0, 1.5
"""Until a connection that is frozen counts as lost, and that the end of a process may take which gives up."""
_PATIENCES = 2.0
"""How many times the longest outage a run may wait before it gives up."""
_HOSTS_SECONDS = 180.0
"""For which a run also waits for other hosts, and processes there for others."""
_RECONNECTS_SECONDS = 0.5
"""For a process that can connect again to do so."""
_HUBS = frozenset({*ROUTERS, EVERYBODY, LAUNCHER, *FORK_SERVERS})
"""Whose faults hit all others."""
_SILENT = "stopped responding"
"""What a run that fails says of a process that fell silent for a reason it does not know."""
_GOES_ON = ("control.json", "control.json.new", "unfinished")
"""What the folder of a run that goes on has, and that of a run that has ended has not."""


def _hung_at_start(run: SimulatedRun, struck: Mapping[Disturbance, float]) -> set[str]:
    """The processes that hang for good while they start: none of their threads notices that the launcher was killed."""
    began = min((at for at, event in run.told if isinstance(event, Started)), default=math.inf)
    return {
        fault.target
        for fault, at in struck.items()
        if isinstance(fault, HangProcess) and fault.seconds is None and at < began
    }


def misses(
    case: SimulatedCase,
    run: SimulatedRun,
    struck: Mapping[Disturbance, float],
    reference: RunReference,
    temporaries: Mapping[str, Path],
) -> list[str]:
    """The broken promises; struck: the faults that hit something, each with its moment; reference: the same trials in memory.

    temporaries: host → its folder of temporary files; that of the launcher has no name.
    """
    if run.stuck is not None:
        return [f"stuck: {run.stuck}"]
    killed = min((at for fault, at in struck.items() if fault.ends_at_once(LAUNCHER)), default=math.inf)
    cut = {host_of(name): at for name, (at, _) in run.ends.items() if part_of(name) == SESSION}
    unheard = {  # suspended when nobody was left to let them go on
        fault.target
        for fault, at in struck.items()
        if isinstance(fault, StopProcess) and fault.seconds is None
        if at >= min(killed, cut.get(host_of(fault.target), math.inf))
    }
    unheard |= _hung_at_start(run, struck) if killed < math.inf else set()
    for_good = [fault for fault in struck if fault.seconds is None]
    stopped = {(part_of(fault.target), host_of(fault.target)) for fault in for_good if isinstance(fault, StopProcess)}
    frozen = {host_of(fault.target) for fault in for_good if isinstance(fault, FreezeSsh)}
    # A suspended program resumes nobody. Its launcher resumes it, or the connection's end, if nothing keeps these from it.
    mute = {(SESSION, host) for host in frozen} | stopped
    untold = {host for part, host in stopped if part == PROGRAM and {(SESSION, host), (LAUNCHER, "")} & mute}
    deaf = {host_of(name) for name in unheard} - {""} | untold
    broken = [f"{name} is left" for name in run.left if name not in unheard and host_of(name) not in deaf]
    broken += [f"{thread}: {type(error).__name__}: {error}" for thread, error in run.errors]
    broken += _of_status(case, run, struck, reference.status)
    broken += _of_time(case, run, struck)
    broken += _of_ends(case, run, struck)
    # Where the disk refuses to remove something, it stays.
    removes = not any(fault.ends_at_once(LAUNCHER) or isinstance(fault, BreakWrite) for fault in struck)
    if removes and not run.suspended:
        broken += [f"{path.name} is left" for path in sorted(temporaries[""].iterdir())]
    dark = {host_of(fault.target) for fault in struck if isinstance(fault, LosePower)}
    for host in temporaries.keys() - {""} - dark - deaf:
        broken += [f"{path.name} is left on {host}" for path in sorted(temporaries[host].iterdir())]
    broken += _of_logs(run)
    broken += _of_rounds(case, run, struck)
    broken += _of_operators(case, run, struck)
    misled = any(isinstance(fault, BreakMessage) and fault.target == SENSOR for fault in struck)  # by a wrong number
    if not misled:
        broken += wrong_messages(case, run.put, disturbed=bool(struck) or case.program is not None)
    if not any(fault.destroys for fault in struck):
        broken += _of_files(run, struck)
        broken += _of_results(case, run, struck, reference)
    return broken


def _of_status(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float], good: int) -> Iterator[str]:
    """Whether the exit status, and what is said, tell what happened; good: the status of a run that completes."""
    status = run.status
    program = _wrong_program(case)
    complaint = next((line for line in run.said.splitlines() if line.strip() and "warning" not in line), "")
    fatal = _fatal(case, struck)
    if run.suspended:
        return
    refused = None if case.hosts is None else case.hosts.refused(case.scenario)
    if refused is not None and (status == UsageError.exit_status or not fatal):
        if status != UsageError.exit_status or (refused not in run.said and not fatal):
            yield f"status {status}, although the run cannot begin ({refused}): {complaint}"
    elif program is not None and not fatal and not (status == good and _may_complete(case)):
        if status != RunError.exit_status or program not in run.said:
            yield f"status {status}, although a program is wrong ({program}): {complaint}"
    elif status == good:
        yield from _of_ignored_signals(case, run, struck, fatal)
        yield from _of_removed(run, struck)
    elif not fatal:
        yield f"status {status}, although nothing of this may end a run: {complaint}"
    elif not any(status in fault.statuses for fault in fatal):
        yield f"status {status}, by which none of this ends a run: {complaint}"
    elif status == RunError.exit_status:
        yield from _of_blame(case, run, struck, complaint)


def _of_blame(
    case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float], complaint: str
) -> Iterator[str]:
    """Whether a run that failed names what has made it fail; complaint: the first line of what it said."""
    fatal = _fatal(case, struck)
    first = min(struck[fault] for fault in fatal)  # what comes later, or lasts until then, hits a run that fails
    counted = [
        fault
        for fault in struck
        if fault in fatal or struck[fault] + (fault.seconds or 0.0) >= first or any(map(_is_worse_for_others, fatal))
    ]
    blamed = [word for fault in counted for word in fault.blamed]
    if _wrong_program(case) is not None:
        blamed.append(SENSOR)
    if case.hosts is not None:
        blamed += [name for fault in counted for name in case.hosts.processes_on(host_of(fault.target))]
    said = complaint if all(fault.named_first for fault in fatal) else run.said
    if all(isinstance(fault, DiskDisturbance) for fault in fatal) and _SILENT in complaint:
        yield f"the disk fails, and a process is blamed: {complaint}"
    for fault in fatal if len(struck) == 1 else ():
        if isinstance(fault, ShortenMessage) and f"{fault.target} broke the protocol" in complaint:
            yield f"{fault.target} is blamed for a message that it got: {complaint}"
        processes = {*processes_of(case.scenario)}
        if fault.target in processes and fault.cuts_off and ("did not report" in complaint or _SILENT in complaint):
            for name in sorted(processes.intersection(complaint.replace(",", " ").split()) - {*fault.blamed}):
                yield f"{name} is blamed for {fault}: {complaint}"
    if not any(word in said for word in blamed):
        yield f"the failure names none of {', '.join(blamed)}: {complaint or '(nothing was said)'}"


def _wrong_program(case: SimulatedCase) -> str | None:
    """A text that the run prints because a program of states is wrong; None if none is."""
    return None if case.program is None else case.program.refused


def _may_complete(case: SimulatedCase) -> bool:
    """Whether the run may complete although its program of states is wrong."""
    return case.program is not None and case.program.tolerated


def _fatal(case: SimulatedCase, struck: Mapping[Disturbance, float]) -> list[Disturbance]:
    """The faults that may end the run: those that do so alone, and those that follow each other and last too long together."""
    longest = case.scenario.longest_outage
    fatal = [fault for fault in struck if not fault.survived(longest)]
    lasting = [fault for fault in struck if fault not in fatal and fault.seconds is not None and fault.harmless is None]
    for first in lasting:
        joined, end = [first], struck[first] + (first.seconds or 0.0)
        for fault in sorted(lasting, key=struck.__getitem__):
            if (
                struck[first] <= struck[fault] <= end + _RECONNECTS_SECONDS
                and fault != first
                and _meet(case, first, fault)
            ):
                joined.append(fault)
                end = max(end, struck[fault] + (fault.seconds or 0.0))
        most = TOLERATED * longest if any(isinstance(fault, FreezeSsh) for fault in joined) else longest
        if len(joined) > 1 and end - struck[first] >= most - _RECONNECTS_SECONDS:
            fatal += [fault for fault in joined if fault not in fatal]
    return fatal


def _meet(case: SimulatedCase, one: Disturbance, other: Disturbance) -> bool:
    """Whether both faults may cut off or suspend the same process."""
    first, second = _hit(case, one), _hit(case, other)
    return bool(first & second) or not _HUBS.isdisjoint(first | second)


def _hit(case: SimulatedCase, fault: Disturbance) -> set[str]:
    """What a fault hits: its target, or a host and the processes there."""
    host = host_of(fault.target)
    return {host, *case.hosts.processes_on(host)} if host and case.hosts is not None else {fault.target}


def _is_worse_for_others(fault: Disturbance) -> bool:
    """Whether because of it a run may not survive another fault.

    A recorder that nothing reaches does not see that others are connected again, and without a launcher, or a fork server, no
    router is started again.
    """
    return fault.target in (*FORK_SERVERS, LAUNCHER) or (fault.cuts_off and fault.target in (RECORDER, EVERYBODY))


def _of_ignored_signals(
    case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float], fatal: Collection[Disturbance]
) -> Iterator[str]:
    """A launcher that is told to end while slots are to come ends the run, rather than complete it, once it is not suspended."""
    for fault in fatal:
        at = struck[fault]
        if Interrupted.exit_status in fault.statuses and fault.target == LAUNCHER:
            stops = [
                since + (stop.seconds or math.inf)
                for stop, since in struck.items()
                if isinstance(stop, StopProcess) and stop.target == LAUNCHER and since <= at + _HEEDED_SECONDS
            ]
            late = max([at, *stops]) + _HEEDED_SECONDS
            if any(moment > late and done < case.scenario.slots for moment, done in _progress(run)):
                yield f"the run went on to its end, {_HEEDED_SECONDS:.0f} s and more after {fault}"


def _of_removed(run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """A run that goes on without its folder cannot end well."""
    for fault, at in struck.items():
        if fault.destroys and any(message.key == "uplink" and message.at > at + _HEEDED_SECONDS for message in run.put):
            yield f"the run ends with status {run.status}, although its results were removed at {at:.2f} s"


def _of_time(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """Whether the run ended as soon as it could: a wake-up that is lost, and a wait that is too long, cost nothing but time."""
    scenario = case.scenario
    most = scenario.slots * scenario.pace + (_USUAL_SECONDS if struck or case.hosts is not None else _QUIET_SECONDS)
    if any(away.stop >= scenario.slots for outages in scenario.timeline.outages.values() for away in outages):
        most += _SUSPENDED_SECONDS
    if case.program is not None:
        most += case.program.seconds(scenario)
    for fault in struck:
        brief = fault.seconds is not None and fault.seconds <= 1.0
        if not brief:
            most += _FAULT_SECONDS
        elif fault.loses:
            most += _BRIEF_SECONDS
        most += fault.seconds or 0.0
        if fault.target == EVERYBODY or scenario.timeline.holds:  # what was lost may have to be asked for twice
            most += _FAULT_SECONDS
    fatal = _fatal(case, struck)
    if fatal:
        most += _PATIENCES * scenario.longest_outage + LAUNCHED_PATIENCE
    most += max((fault.awaited_seconds for fault in struck), default=0.0)
    took = run.seconds if case.hosts is None else run.ended  # programs on other hosts may wait for a launcher
    if case.hosts is not None and fatal:
        most += _HOSTS_SECONDS
    if took > most and not run.suspended:
        yield f"the run took {took:.1f} s, and not {most:.1f} s at most"
    yield from _of_hold(case, run, struck)
    yield from _of_process_end(case, run, struck)


def _of_process_end(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """Whether a process that ends has ended the run at once, and all others, unless all slots were done."""
    ends = KillProcess | InterruptProcess | TerminateProcess | HangUpProcess
    is_over = any(message.said == "end" for message in run.put)  # then it may be waited for in vain
    if len(struck) > 1 or case.hosts is not None or case.program is not None or is_over:
        return
    for fault, at in struck.items():
        took = max(run.ended, run.seconds) - at
        if isinstance(fault, ends) and not fault.survived(case.scenario.longest_outage) and took > _AT_ONCE_SECONDS:
            yield f"the run goes on for {took:.1f} s after {fault}"


def _of_hold(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """Whether a run that is held in vain, because a process hangs other than the sensor, has given up in time."""
    fault, held = next(iter(struck), None), None
    if not isinstance(fault, HangProcess) or len(struck) > 1 or fault.target == SENSOR or case.scenario.shards > 1:
        return
    for message in run.put:
        if (
            message.key == "uplink"
            and message.said.startswith("hold ")
            and message.said != f"hold {case.scenario.slots}"
        ):
            held = message.at if held is None else held
        elif message.key == f"control/{SENSOR}" and message.said.startswith("go"):
            held = None
    patience = max(READY_SECONDS, case.scenario.longest_outage)
    if held is not None and run.ended > held + patience + _GIVES_UP_SECONDS:
        yield f"the run is held for {run.ended - held:.1f} s, and goes on to wait"


def _of_ends(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """Whether processes end by themselves, rather than because their launcher ends them.

    They do if the run completes, but for a receiver that is away to the end, and the routers, which wait for it; and for a
    router that is started again when all others have left. And they do if all of them are cut off for good once every shard
    has begun: a process that is not connected yet waits for its router for longer.
    """
    scenario, faults = case.scenario, list(struck)
    if case.hosts is not None:
        return
    away = {name: outages for name, outages in scenario.timeline.outages.items() if outages}
    to_the_end = any(outage.stop >= scenario.slots for outages in away.values() for outage in outages)
    brief = all(fault.survived(scenario.longest_outage) and (fault.seconds or 0.0) <= 1.0 for fault in faults)
    if run.status == 0 and brief and not to_the_end:
        struck_routers = {fault.target for fault in faults} & {*ROUTERS}
        for name in sorted({*processes_of(scenario)} - struck_routers):
            if (status := run.ends.get(name, (0.0, 0))[1]) != 0:
                yield f"the run completes, and {name} ends with status {status}"
    for_good = [
        fault for fault in faults if isinstance(fault, CutConnection | FreezeConnection) and fault.seconds is None
    ]
    if len(faults) != 1 or not for_good or faults[0].target != EVERYBODY or _wrong_program(case) is not None:
        return
    first = [message.at for message in run.put if message.key == "uplink" and 0 in message.slots]
    if sum(at < struck[faults[0]] for at in first) >= max(1, scenario.shards):
        lease = 0.0 if isinstance(faults[0], CutConnection) else _LEASE_SECONDS
        last = struck[faults[0]] + scenario.longest_outage + lease + _GIVES_UP_SECONDS
        for name in {*processes_of(scenario)} - {*ROUTERS, RECORDER, *away}:  # who is away waits for its launcher
            if name in run.ends and run.ends[name][0] > last:
                yield f"{name} does not end, though it has had no connection for {run.ends[name][0] - struck[faults[0]]:.1f} s"


def _of_rounds(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """Whether all that was lost with one connection, or with a router, was sent again in one round."""
    scenario, fault = case.scenario, next(iter(struck), None)
    brief = isinstance(fault, CutConnection) and fault.target != EVERYBODY and 0.0 < (fault.seconds or 0.0) <= 1.0
    if not brief and not (isinstance(fault, KillProcess) and fault.target in ROUTERS):
        return
    if len(struck) > 1 or scenario.shards > 1 or case.hosts is not None or case.program is not None:
        return
    if is_late(scenario) or any(
        scenario.timeline.outages.values()
    ):  # a receiver that comes back has a round of its own
        return
    rounds = sum(message.key == f"control/{ROUTER}" and message.said.startswith("again") for message in run.put)
    if rounds > 1:
        yield f"messages are asked for {rounds} times after {fault}"


def _of_operators(case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float]) -> Iterator[str]:
    """Whether operators get their answers soon, if nothing else happens to the run."""
    if all(isinstance(fault, OperatorCommand) for fault in struck):
        most = _ANSWERED_SECONDS + _ANSWERED_SLOTS * case.scenario.pace
        most += 0.0 if case.program is None else case.program.seconds(case.scenario)  # a step waits for its states
        for command in run.typed:
            if (seconds := command.answered - command.begun) > most:
                yield f"{command.words} is answered after {seconds:.1f} s, and not after {most:.1f} s at most"
    if case.scenario.shards == 1:
        yield from broken_holds(run.typed, run.put)


def _progress(run: SimulatedRun) -> Iterator[tuple[float, int]]:
    """When the run told of its progress, and how many slots were done."""
    for at, event in run.told:
        if isinstance(event, RunProgress):
            yield at, event.done


def _of_logs(run: SimulatedRun) -> Iterator[str]:
    if "Traceback" in run.said:
        yield f"the launcher: {run.said.strip().splitlines()[-1]}"
    for path in sorted(run.folder.glob("**/*.log")):
        text = path.read_text("utf-8", "replace")
        if "Traceback" in text:
            yield f"{path.name}: {text.strip().splitlines()[-1]}"


def _of_files(run: SimulatedRun, struck: Iterable[Disturbance]) -> Iterator[str]:
    """Files that others may read, and those of a run that goes on."""
    cleans_up = run.status != KILLED and not run.suspended and not any(fault.lacking for fault in struck)
    for path in sorted(run.folder.glob("**/*")):
        if path.stat().st_mode & 0o077:
            yield f"others may use {path.relative_to(run.folder)}, whose mode is {path.stat().st_mode & 0o777:o}"
        if cleans_up and path.name in _GOES_ON:
            yield f"{path.relative_to(run.folder)} is left of the run"


def _of_results(
    case: SimulatedCase, run: SimulatedRun, struck: Mapping[Disturbance, float], reference: RunReference
) -> Iterator[str]:
    """Whether the tables can be read, and have the right rows, and no others, and the summary is of them."""
    done = run.status == reference.status
    lacking = any(fault.lacking for fault in struck)
    falsified = not done and _falsified(run, struck)
    references = reference.of_folders(run.folder)
    if done and not references:
        yield "there are no results"
    for folder, expected in references.items():
        whole = expected is reference
        yield from lost_rows(folder)
        try:
            results = Results.read(folder)
            tables = dict(tables_of(results))
        except UsageError as error:
            has_rows = last_round(folder).slots > 0 and not any(named_in(case.scenario.as_tables()))
            if done or has_rows or (whole and not lacking and any(slots for _, slots in _progress(run))):
                yield f"the results cannot be read: {error}"
            continue
        if whole:
            yield from _of_folder(case, run, folder, done)
        if falsified:  # rows may have a number that was noticed later, when its block was complete
            continue
        summary = results.summary
        yield from wrong_tables(tables, summary, expected, done)
        if whole:
            yield from _of_unsaved(run, struck, summary, expected)
        # A launcher may lack memory or threads when all results are written.
        starved = any(fault.lacking and not isinstance(fault, DiskDisturbance) for fault in struck)
        ended_at_once = starved or run.status in (None, KILLED, Interrupted.exit_status)
        if whole and not done and not ended_at_once and summary["ended"] == "complete":
            yield f"status {run.status}, and the summary says complete"
        if lacking and not done:
            continue
        yield from wrong_summary(summary, expected, done)
        verification = verification_of(expected.scenario)
        yield from wrong_course(summary, verification, run.seconds, _confused(case, struck))
        yield from _of_words(run, struck, summary, whole and not done)
        if not done and expected.shards == 1:
            yield from _of_metrics(case, folder, summary)
        # Rows are on the disk before the first process is told that the run is over.
        is_over = reference.shards == 1 and any(message.said == "end" for message in run.put)
        if is_over and summary["slots"] < reference.scenario.slots:
            yield f"all slots were done, and the summary has {summary['slots']}"
        # A recorder that is killed has no time to save what it told.
        killed = run.ends.get(RECORDER, (0.0, 0))[1] == KILLED or any(fault.ends_at_once(RECORDER) for fault in struck)
        if not killed:
            yield from _of_course(case, run, struck, summary, expected, whole)


def _of_folder(case: SimulatedCase, run: SimulatedRun, folder: Path, done: bool) -> Iterator[str]:
    """Whether the folder of a whole run has its logs if it ended well, and the right scenario."""
    if done:
        yield from _lost_logs(case, folder)
    if case.program is None and (folder / "scenario.toml").exists():
        yield from wrong_scenario(folder, case.scenario, run.typed)


def _of_metrics(case: SimulatedCase, folder: Path, summary: Mapping[str, Any]) -> Iterator[str]:
    """Whether the metrics of a run that was cut short are those of the same slots in memory, with the changes of operators."""
    slots = int(summary["slots"])
    if case.program is not None or slots != slots_of_metrics(summary):  # they are of fewer slots
        return
    scenario = load(folder)
    if slots < scenario.slots and not any(named_in(scenario.as_tables())):
        until = {**summary_until(scenario, slots)}
        given, tables = len(case.scenario.event), scenario.model_dump(mode="json", exclude_none=True)
        tables["event"] = [event for i, event in enumerate(tables["event"]) if i < given or event["at"] < slots]
        if len(tables["event"]) < len(scenario.event):
            # An operator changed a link when the last slot was done: theory had not heard of it in any slot.
            until["peers"] = summary_until(Scenario(tables), slots)["peers"]
        yield from unlike_prefix(summary, until, all_recorded=scenario.record_trials == scenario.trials)


def _of_words(
    run: SimulatedRun, struck: Iterable[Disturbance], summary: Mapping[str, Any], failed: bool
) -> Iterator[str]:
    """Whether the summary says why a run ended early; failed: whether it is of a whole run that did."""
    killed = run.ends.get(RECORDER, (0.0, 0))[1] == KILLED or any(fault.ends_at_once(RECORDER) for fault in struck)
    if killed or not failed:
        return
    first = next(iter(str(summary["ended"]).splitlines()), "")
    why, _, _ = first.partition(METRICS_AS_OF)
    if run.status == Interrupted.exit_status and why != "interrupted":
        yield f"the run was interrupted, and the summary says: {first}"
    if run.status == RunError.exit_status and why not in run.said:
        yield f"the run says {run.said.splitlines()[:1]}, and its summary: {first}"


def _confused(case: SimulatedCase, faults: Iterable[Disturbance]) -> float:
    """How many messages may have arrived as those of another key; any number if others than the run wrote some."""
    names, count = len(processes_of(case.scenario)), 0.0
    for fault in faults:
        if isinstance(fault, ConfuseKeys):
            count += case.scenario.shards * (names if fault.target == EVERYBODY else 1)
        elif isinstance(fault, BreakMessage | LetStrangerIn | ShortenMessage):
            return math.inf
    return count


def _lost_logs(case: SimulatedCase, folder: Path) -> Iterator[str]:
    """The logs that a run which ended well has not left in its folder. A full disk may leave them in that of their shard."""
    names = [f"{name}.log" for name in processes_of(case.scenario)]
    whole = [(path, path) for path in (Path("logs", name) for name in names)]
    shards = [
        (Path("logs", f"shard-{number}", name), Path("shards", str(number), "logs", name))
        for number in range(1, 1 + case.scenario.shards)
        for name in names
    ]
    for path, unmoved in shards if case.scenario.shards > 1 else whole:
        if not ((folder / path).exists() or (folder / unmoved).exists()):
            yield f"there is no {path}"


def _falsified(run: SimulatedRun, struck: Iterable[Disturbance]) -> bool:
    """Whether a run that has failed may have rows with a wrong number: it says so, unless something else ended it before."""
    broken = [fault for fault in struck if isinstance(fault, BreakMessage | ShortenMessage)]
    wrong = any(isinstance(fault, BreakMessage) and fault.target == RECORDER for fault in broken)
    unreadable = len(broken) == 1 and "broke the protocol" in run.said  # then no number was wrong
    return (wrong and not unreadable) or any(text in run.said for text in CONTRADICTIONS)


def _of_course(
    case: SimulatedCase,
    run: SimulatedRun,
    struck: Mapping[Disturbance, float],
    summary: Mapping[str, Any],
    reference: RunReference,
    whole: bool,
) -> Iterator[str]:
    """Whether the summary has what the run went through; whole: whether it is of all shards."""
    told = max((done for _, done in _progress(run)), default=0)
    if summary["slots"] < told and whole:
        yield f"{told} slots were done, and the summary has {summary['slots']}"
    if not (struck or told) and case.program is None and case.scenario.pace * case.scenario.slots > _TELLS_SECONDS:
        yield "the run tells no progress"
    yield from _of_cuts(run, struck, summary, reference)
    yield from _of_lasting(struck, summary, reference)
    yield from _of_misled(run, struck, summary, reference)
    if _wrong_program(case) is not None and not struck:  # the sensor waits until what it has sent is done
        sent = max((message.slots.stop for message in run.put if message.key == "uplink" and message.slots), default=0)
        if summary["slots"] < sent:
            yield f"the program has given states of {sent} slots, and the summary has {summary['slots']}"
    outages = [event for _, event in run.told if isinstance(event, ConnectionOutage)] if whole else []
    yield from wrong_outages(
        summary, reference, frozenset((event.process, event.slot) for event in outages), run.seconds
    )
    for entry in summary["outages"]:
        failing = _wrong_program(case) is not None and entry["process"] == SENSOR
        if not failing and not any(_explains(fault, entry["process"]) for fault in struck):
            yield f"an outage of {entry['process']} at slot {entry['slot']}, and no fault caused one"


def _of_cuts(
    run: SimulatedRun, struck: Mapping[Disturbance, float], summary: Mapping[str, Any], reference: RunReference
) -> Iterator[str]:
    """Whether a process that was cut off while the run went on is said to have been; so is it with a router, or the recorder.

    Not if something else happens, too, but that a thread is late: who is cut off already cannot be cut off.
    """
    scenario = reference.scenario
    cuts = [(fault, at) for fault, at in struck.items() if isinstance(fault, CutConnection | FlapConnection)]
    delays = [fault.seconds or 0.0 for fault in struck if isinstance(fault, DelayThread)]
    if len(cuts) != 1 or len(struck) > 1 + len(delays) or run.status != reference.status or scenario.shards > 1:
        return
    [(fault, at)] = cuts
    flaps = 0.0 if isinstance(fault, CutConnection) else fault.seconds or 0.0
    begun = any(message.said == "start" and message.at < at for message in run.put)
    goes_on = any(
        message.key == f"progress/{RECORDER}"
        and message.at > at + flaps + _NOTICED_SECONDS + sum(delays)
        and scenario.slots not in message.slots
        for message in run.put
    )
    steady = not scenario.timeline.outages.get(fault.target)
    if (
        begun
        and goes_on
        and steady
        and not {entry["process"] for entry in summary["outages"]} & {fault.target, *ROUTERS, RECORDER}
    ):
        yield f"the summary lists no outage of {fault.target}, which was cut off"
    others = {entry["process"] for entry in summary["outages"]} - {fault.target}
    if fault.target == RECORDER and others and len(struck) == 1:
        yield f"the recorder was cut off, which sees nobody then, and the summary lists outages of {', '.join(sorted(others))}"


def _of_lasting(
    struck: Mapping[Disturbance, float], summary: Mapping[str, Any], reference: RunReference
) -> Iterator[str]:
    """Whether an outage lasts as long as what has cut the process off, and has no end if the run failed before.

    Not if the run may have been held then, when nobody is missed.
    """
    fault = next(iter(struck), None)
    if not isinstance(fault, CutConnection | FreezeConnection) or len(struck) > 1 or reference.scenario.timeline.holds:
        return
    outages = [entry for entry in summary["outages"] if entry["process"] == fault.target]
    if summary["ended"] == "complete" and fault.seconds is not None:
        over = [entry["seconds"] for entry in outages if entry["until"] < reference.scenario.slots]
        longest = max(over, default=math.inf)  # at its end, a run does not wait for who is not needed any more
        if longest < fault.seconds - _NOTICED_SECONDS:
            yield f"the outage of {fault.target} lasts {longest:.2f} s after {fault}"
    elif fault.seconds is None and outages and outages[-1]["until"] is not None:
        yield f"{fault.target} is cut off for good, and the summary has its outage end at slot {outages[-1]['until']}"


def _of_unsaved(
    run: SimulatedRun, struck: Mapping[Disturbance, float], summary: Mapping[str, Any], reference: RunReference
) -> Iterator[str]:
    """Whether a recorder that was killed had saved all rows and metrics but those of the last seconds."""
    fault = next(iter(struck), None)
    stops = KillProcess | StopAndKillProcess | FillDisk | RefuseWrite
    if isinstance(fault, stops) and len(struck) == 1 and reference.shards == 1:
        saved = struck[fault] - _UNSAVED_SECONDS
        early = max((done for at, done in _progress(run) if at < saved), default=0)
        for what, slots in (("summary", summary["slots"]), ("last metrics", slots_of_metrics(summary) or 0)):
            if slots < early:
                yield f"{early} slots were done {_UNSAVED_SECONDS:.1f} s before {fault}, and there are {slots} in the {what}"


def _of_misled(
    run: SimulatedRun, struck: Mapping[Disturbance, float], summary: Mapping[str, Any], reference: RunReference
) -> Iterator[str]:
    """Whether the summary counts the messages that processes have dropped, since they came as those of another key.

    Not if a process ends while the run goes on, with what it has counted, nor if the recorder gets its report as a command.
    """
    scenario = reference.scenario
    away = any(scenario.timeline.outages.values())
    if run.status != reference.status or away or not all(isinstance(fault, ConfuseKeys) for fault in struck):
        return
    over = next((message.at for message in run.put if message.said == "end"), math.inf)
    counts = Counter(name for at, name, _ in run.misled if at < over)
    silent = {
        RELAY,
        *(writer_of(f"evedrop/run/{key}") for at, name, key in run.misled if at >= over and name == RECORDER),
    }
    for name, count in sorted(counts.items()):
        if name not in silent and (dropped := summary.get("misdelivered", {}).get(name, 0)) < count:
            yield f"{name} has got {count} messages of other keys, and the summary has {dropped}"


def _explains(fault: Disturbance, process: str) -> bool:
    """Whether a fault can have cut a process off; a process that ends may be missed first, whichever it is.

    With a fork server that is suspended for too long, all its processes end.

    Routers, and the recorder, stand for all that were connected to them.
    """
    hubs = (*ROUTERS, RECORDER)
    if isinstance(fault, OperatorCommand | DelayThread | DiskDisturbance):  # they cut off nobody
        return False
    return (
        not fault.cuts_off
        or bool(host_of(fault.target))
        or fault.target in (process, EVERYBODY, *hubs, *FORK_SERVERS)
        or process in hubs
    )

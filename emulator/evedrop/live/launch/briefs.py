"""Makes the briefs of a scenario's processes: the knowledge and the keys of each process.

In a closed loop, that includes the knowledge of each process about plant, inputs and disturbances.

Source: docs/protocol.md, the brief.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evedrop.errors import NoAnswer, UsageError
from evedrop.live.launch.ports import RouterEndpoints, Routers, identities_of
from evedrop.live.protocol.brief import (
    AnyBrief,
    Brief,
    ControllerPart,
    EavesdropperPart,
    EstimatorLoopPart,
    Flow,
    LegitimatePart,
    Model,
    Part,
    ProgramPart,
    RecorderPart,
    RelayPart,
    RouterPart,
    SensorLoopPart,
    SensorPart,
    Wiring,
    encoded,
)
from evedrop.live.protocol.keys import MOST_PARTS, Sizes
from evedrop.model.eavesdroppers import REMOTE_CALLS, STRATEGIES
from evedrop.model.slot.link import COUNTED_BURSTS
from evedrop.names import ACKNOWLEDGEMENTS, CONTROLLER, LEGITIMATE, OPERATOR, RECORDER, RELAY, ROUTER, SENSOR
from evedrop.results.folder import new_folder
from evedrop.scenario.closed_loop import monitor_of
from evedrop.scenario.input_files import disturbances_of, states_of
from evedrop.scenario.plugins import named_in
from evedrop.scenario.process import ProcessTable
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.score.links import ack_channel_of, chart_of
from evedrop.system.world import world

_WINDOW_BYTES = 64 * 2**20
_REPORT_SECONDS = 0.04
_MOST_SLOTS = 64  # whose packets one message carries
_MESSAGE_BYTES = 1 << 20  # of the numbers of one message
LAUNCHED_PATIENCE = 30  # seconds
MOST_SLOTS_AHEAD = 4096


def flow_of(scenario: Scenario, ahead: int = MOST_SLOTS_AHEAD) -> Flow:
    """The flow control: a window of at most `ahead` slots and 64 MiB, and four reports per window; with a pace, one every 40 ms.

    A program that gives the states may be slow: at its own pace there is a report for each slot.
    """
    receivers = len(scenario.receivers)
    slot_bytes = 8 * len(scenario.process.A) * scenario.trials * (2 * receivers + 2)
    window = max(2, min(ahead, _WINDOW_BYTES // slot_bytes))
    batch = max(1, window // 4)
    if scenario.pace:
        batch = max(1, min(batch, round(_REPORT_SECONDS / scenario.pace)))
    elif scenario.process.source == "zenoh":
        batch = 1  # the program's pace is not known, and its messages should be on disk when it falls silent
    message = _slots_of_message(scenario, batch)
    kinds = sizes_of(scenario, batch, message).of_kinds
    largest_report = max(kinds["telemetry"], kinds["journal"])
    return Flow(window, batch, scenario.longest_outage, max(kinds.values()), largest_report, message)


def _slots_of_message(scenario: Scenario, batch: int) -> int:
    """How many slots' packets a message may carry: bounded by its numbers, and by its late packets, each of which is a map."""
    numbers = len(scenario.process.A) * scenario.trials
    # In each slot, the packets of every slot of the window may arrive, and their copies.
    late = 2 * (_longest_window(scenario) + 1)
    return max(1, min(_MOST_SLOTS, batch, _MESSAGE_BYTES // (8 * numbers), (MOST_PARTS - 2) // late))


def _longest_window(scenario: Scenario) -> int:
    return max(scenario.window(name) for name in scenario.receivers)


def sizes_of(scenario: Scenario, batch: int, message: int) -> Sizes:
    """The dimensions that determine the sizes of messages; batch: slots of a report; message: slots whose packets one carries."""
    plant, table = scenario.driven, scenario.controller
    scheme = scenario.make_scheme()
    return Sizes(
        len(scenario.process.A),
        scenario.trials,
        scenario.record_trials,
        batch,
        _longest_window(scenario),
        len(scenario.receivers),
        len(scheme.header),
        0 if plant is None or table is None else plant.inputs,
        1 if table is None else table.period,
        message,
    )


def history_of(scenario: Scenario) -> int:
    """How many slots before the first that is not done a restarted router must receive again.

    Packets may be under way for the longest window of the receivers. If the scheme may be silent, the router must also see
    the bursts of losses that are not over, which are counted up to a maximal length: a slot without a packet ends them. And on
    some acknowledgements, the packets decide that the jammer has missed in a row: if the scheme may be silent, any number of
    slots may be between them.
    """
    window = _longest_window(scenario)
    scheme, channel = scenario.make_scheme(), ack_channel_of(scenario)
    memory = 0 if channel is None else min(channel.memory, scenario.slots)
    if not scheme.may_be_silent:
        return max(window, memory)
    return scenario.slots if memory else max(window, COUNTED_BURSTS)


@dataclass(frozen=True)
class RecorderTask:
    """The recorder's task, in addition to the scenario: the results folder, and whether to record the run for the view."""

    results: Path
    recording: bool
    shard: bool = False
    """Whether the run is a shard of a larger one: its score will be merged, and it cannot be steered."""
    paused: bool = False
    """Whether the run is held before slot 0, until the operator lets it continue."""


def briefs_of(
    scenario: Scenario,
    endpoints: RouterEndpoints,
    task: RecorderTask,
    ends_with_stdin: bool = True,
    patience: int = LAUNCHED_PATIENCE,
    ahead: int = MOST_SLOTS_AHEAD,
) -> dict[str, AnyBrief]:
    """Process name → brief, with a new run name, new passwords and, if the router takes them, new certificates.

    ahead: as for `flow_of`.

    Raises UsageError if the number of endpoints differs from the scenario's number of routers.
    """
    run = f"r{world().token(4).hex()}"
    endpoints.check(scenario.relayed)
    keys = StreamKeys.from_scenario(scenario)
    steered = () if scenario.controller is None else (CONTROLLER,)
    users = {
        name: world().token(16).hex() for name in (ROUTER, SENSOR, *scenario.receivers, *steered, RECORDER, OPERATOR)
    }
    routers = Routers.for_users(users, endpoints)
    identities = identities_of(run, endpoints, tuple(users))
    flow = flow_of(scenario, ahead)
    limits = sizes_of(scenario, flow.batch, flow.message).of_kinds
    scheme, public = scenario.make_scheme(), scenario.process
    model = Model(
        public.A,
        public.Q,
        public.initial_covariance,
        scenario.encoding.mu_d,
        len(scheme.header),
        public.singular_noise,
        scenario.encoding.state_probabilities,
    )
    disturbances = None if scenario.driven is None else encoded(disturbances_of(scenario))

    def brief(process: str, owned: Mapping[str, bytes], part: Part) -> AnyBrief:
        return Brief(
            run=run,
            process=process,
            role=part.role,
            router=str(endpoints.router.listen if process == ROUTER else routers.endpoint(process)),
            user=process,
            password=routers.password(process),
            slots=scenario.slots,
            trials=scenario.trials,
            first_trial=scenario.first_trial,
            recorded=scenario.record_trials,
            flow=flow,
            model=model,
            keys={name: key.hex() for name, key in owned.items()},
            part=part,
            ends_with_stdin=ends_with_stdin,
            patience=patience,
            identity=identities.get(process),
        )

    router = _router_part(scenario, routers, limits)
    made = [brief(ROUTER, _router_keys(keys, router), router)]
    if endpoints.relay is not None and routers.zid is not None:
        listen = str(endpoints.relay.listen)
        relay = RelayPart(routers.at_relay, scenario.receivers, listen, routers.zid, _wiring(scenario), limits)
        made.append(brief(RELAY, {}, relay))
    made.append(brief(SENSOR, _sensor_keys(scenario, keys), _sensor_part(scenario, task, disturbances)))
    made.append(brief(LEGITIMATE, keys.secret(scheme.estimator_streams), _legitimate_part(scenario)))
    recorder = RecorderPart(
        scenario=scenario.model_dump(mode="json"),
        results=str(task.results),
        recording=task.recording,
        operator=users[OPERATOR],
        shard=task.shard,
        paused=task.paused,
        operator_identity=identities.get(OPERATOR),
        classes=_answers(scenario),
    )
    made.append(brief(RECORDER, {}, recorder))
    if (controller := _controller_part(scenario, disturbances)) is not None:
        made.append(brief(CONTROLLER, {}, controller))
    for name, listener in scenario.eavesdroppers.items():
        owned = keys.eavesdropper(name, listener.strategy, listener.parameters)
        made.append(brief(name, owned, _eavesdropper_part(scenario, name)))
    return {made_brief.process: made_brief for made_brief in made}


def _router_keys(keys: StreamKeys, part: RouterPart) -> dict[str, bytes]:
    """Stream → key, for the streams of all links."""
    acknowledgements = {} if part.acknowledgements is None else {f"link/{ACKNOWLEDGEMENTS}": keys.acknowledgements}
    return {**keys.links(part.links), **acknowledgements}


def _router_part(scenario: Scenario, routers: Routers, limits: Mapping[str, int]) -> RouterPart:
    """The router's part; limits: the largest message of each kind, in bytes."""
    return RouterPart(
        links={name: scenario.schedule(name) for name in scenario.receivers},
        pace=scenario.pace,
        users=routers.at_router,
        leaks=scenario.leaks,
        acknowledgements=ack_channel_of(scenario),
        controller=_wiring(scenario),
        zid=routers.zid,
        limits=limits,
        modules=scenario.modules,  # even if no link names a class: an operator can set another link model
    )


def _sensor_keys(scenario: Scenario, keys: StreamKeys) -> dict[str, bytes]:
    """Stream → key, for the sensor's own streams and those of the secret."""
    measurement = {"measurement": keys.measurement} if scenario.measures else {}
    monitored = monitor_of(scenario) is not None
    monitors = {"watermark": keys.watermark, "spoofing": keys.spoofing} if monitored else {}
    secret = keys.secret(scenario.make_scheme().secret_streams)
    return {"process": keys.process, **measurement, **monitors, **secret}


def _sensor_part(scenario: Scenario, task: RecorderTask, disturbances: str | None) -> SensorPart:
    """The sensor's part; disturbances: encoded, None without a plant."""
    table, process = scenario.controller, scenario.process
    states = None if process.source == "zenoh" else states_of(scenario)
    holds = {slot for slot in scenario.timeline.holds if slot < scenario.slots}
    return SensorPart(
        scheme=scenario.encoding.spec,
        pace=scenario.pace,
        receivers=scenario.receivers,
        holds=sorted(holds | ({0} if task.paused else set())),
        history=history_of(scenario),
        leaks=scenario.leaks,
        chart=chart_of(scenario),
        plant=scenario.driven,
        disturbances=disturbances,
        controller=None if table is None else SensorLoopPart(table.period, table.acts_on),
        modules=_modules(scenario, scheme=scenario.encoding.spec),
        monitor=monitor_of(scenario),
        states=None if states is None else encoded(states),
        program=_program_of(process),
    )


def _legitimate_part(scenario: Scenario) -> LegitimatePart:
    """The legitimate estimator's part."""
    return LegitimatePart(
        scheme=scenario.encoding.spec,
        window=scenario.window(LEGITIMATE),
        outages=_outages(scenario, LEGITIMATE),
        controller=_estimator_loop(scenario),
        modules=_modules(scenario, scheme=scenario.encoding.spec),
    )


def _eavesdropper_part(scenario: Scenario, name: str) -> EavesdropperPart:
    """The part of the eavesdropper with this name."""
    listener, noise = scenario.eavesdroppers[name], scenario.make_scheme().noise_distribution
    return EavesdropperPart(
        strategy=listener.strategy,
        parameters=listener.parameters,
        window=scenario.window(name),
        outages=_outages(scenario, name),
        noise_covariance=None if noise is None else noise.given,
        modules=_modules(scenario, strategy=listener.strategy, parameters=listener.parameters),
    )


def _controller_part(scenario: Scenario, disturbances: str | None) -> ControllerPart | None:
    """The controller's part: its strategy, assignment and disturbances; None without a controller."""
    assignment, table = scenario.assignment, scenario.controller
    if assignment is None or table is None or disturbances is None:
        return None
    return ControllerPart(table.strategy, assignment, table.acts_on, disturbances)


def _modules(scenario: Scenario, **named: Any) -> str | None:
    """The folder of own classes for a process whose part names one."""
    return scenario.modules if any(named_in(named)) else None


def _wiring(scenario: Scenario) -> Wiring | None:
    """The controller's connections; None without a controller."""
    table = scenario.controller
    return None if table is None else Wiring(table.acts_on, scenario.legitimate.knows_input)


def _program_of(process: ProcessTable) -> ProgramPart | None:
    """The program that publishes the states; None if none does."""
    program = process.zenoh
    if process.source != "zenoh" or program is None:
        return None
    return ProgramPart(
        program.key, process.states or (), process.around, program.connect, program.listen, program.offsets
    )


def _answers(scenario: Scenario) -> dict[str, Any]:
    """The answers of eavesdroppers' classes that are not built in to all questions that the recorder will ask."""
    tables = scenario.eavesdroppers
    names = {class_ for table in tables.values() for class_ in (table.strategy, table.reads_as) if class_ is not None}
    foreign = {name for name in names if STRATEGIES.foreign(name)}
    if foreign:
        from evedrop.scenario.theory import expectations_of  # noqa: PLC0415 - slow to import, and seldom needed

        for name, expectation in expectations_of(scenario).items():
            if name in tables and foreign & {tables[name].strategy, tables[name].reads_as}:
                try:
                    expectation.traces(scenario.slots)
                    _ = expectation.limit, expectation.infinite_variance
                except NoAnswer as error:
                    raise UsageError(f"eavesdroppers.{name}: its class cannot give its theory ({error})") from error
    return REMOTE_CALLS.of(foreign)


def _outages(scenario: Scenario, receiver: str) -> list[tuple[int, int, bool]]:
    """A receiver's outages: first slot, first slot after, and whether it keeps its state."""
    return [(outage.start, outage.stop, outage.keeps_state) for outage in scenario.timeline.outages[receiver]]


def write_briefs(
    scenario: Scenario, endpoints: RouterEndpoints, results: Path, folder: Path, patience: int, *, paused: bool = False
) -> list[Path]:
    """Write the briefs into a folder, for processes that are started by hand, on any hosts.

    results: the recorder's folder, on its host, relative to its working directory. patience: how many seconds processes
    wait for each other. paused: as in `RecorderTask`. Raises UsageError if the folder is not empty or cannot be
    written, and for a scenario in shards or one that needs a launcher.
    """
    if scenario.shards > 1:
        raise UsageError(
            f"shards = {scenario.shards}: briefs belong to one run; give --set shards=1, or write the briefs of each shard "
            "separately, with its own --first-trial and --trials"
        )
    expect_no_launcher_needed(scenario)
    made = briefs_of(
        scenario, endpoints, RecorderTask(results, True, paused=paused), ends_with_stdin=False, patience=patience
    )
    try:
        new_folder(folder)
        return [brief.write(folder) for brief in made.values()]
    except OSError as error:
        raise UsageError(f"{folder} cannot be written ({error.strerror}); give another --out") from error


def expect_no_launcher_needed(scenario: Scenario) -> None:
    """Raise UsageError if only a launcher can carry out an event of the scenario."""
    for act in scenario.timeline.acts:
        if act.effect.action is not None:
            raise UsageError(
                f"slot {act.at}: {act.text}: nobody can do this to a process that is started by hand or in a container; use "
                "`evedrop run`, with --hosts FILE for several hosts"
            )


def _estimator_loop(scenario: Scenario) -> EstimatorLoopPart | None:
    """When the legitimate estimator sends its estimate, and the plant if it knows the inputs; None if neither."""
    table, told = scenario.controller, scenario.legitimate.knows_input
    if table is None or (table.acts_on == "truth" and not told):
        return None
    return EstimatorLoopPart(table.period, table.acts_on, scenario.driven if told else None)

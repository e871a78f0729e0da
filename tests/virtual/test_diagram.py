"""What happened is shown as a diagram that an engineer can read."""

from __future__ import annotations

import re
import signal
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from evedrop.cli.simulated import program
from evedrop.virtual import notes
from evedrop.virtual.campaign import play_case
from evedrop.virtual.cases import case_from
from evedrop.virtual.diagram import diagram
from evedrop.virtual.scheduler import Occurrence
from evedrop.virtual.steps import steps_of
from tests.virtual.simulated_view import write_recording
from tests.virtual.test_campaign_regressions import REGRESSIONS

HAPPENED = [
    Occurrence(0.0, "world", notes.STARTS, ("launcher",)),
    Occurrence(0.0, "launcher", notes.STARTS, ("router",)),
    Occurrence(0.1, "launcher", notes.STARTS, ("sensor",)),
    Occurrence(0.1, "launcher", notes.STARTS, ("legitimate",)),
    Occurrence(0.1, "launcher", notes.STARTS, ("recorder",)),
    Occurrence(0.2, "sensor", notes.CONNECTS, ("sensor", "router")),
    Occurrence(0.3, "recorder", notes.PUT, ("control/sensor", 40, "start")),
    Occurrence(0.31, "sensor", notes.GETS, ("sensor", "control/sensor", 7)),
    Occurrence(0.4, "sensor", notes.PUT, ("uplink", 100, "0")),
    Occurrence(0.41, "router", notes.GETS, ("router", "uplink", 9)),
    Occurrence(0.42, "router", notes.PUT, ("downlink/legitimate", 100, "0")),
    Occurrence(0.43, "world", notes.SIGNAL, ("router", signal.SIGSTOP)),
    Occurrence(0.43, "world", notes.SUSPENDED, ("router",)),
    Occurrence(0.43, "world", notes.FAULT, ("stop router for 1 s",)),
    Occurrence(0.45, "sensor", notes.PUT, ("uplink", 100, "1")),
    Occurrence(0.5, "legitimate", notes.GETS, ("legitimate", "downlink/legitimate", 11)),
    Occurrence(1.43, "world", notes.GOES_ON, ("router",)),
    Occurrence(1.44, "router", notes.GETS, ("router", "uplink", 15)),
    Occurrence(1.45, "router", notes.PUT, ("downlink/legitimate", 100, "1")),
    Occurrence(1.46, "world", notes.LOST, ("legitimate", "downlink/legitimate", 19, "cut")),
    Occurrence(1.46, "legitimate", notes.DISCONNECTS, ("legitimate", "router", "cut")),
    Occurrence(1.5, "controller", notes.PUT, ("input", 100, "1")),
    Occurrence(1.5, "sensor", notes.GETS, ("sensor", "input", 22)),
    Occurrence(1.5, "legitimate", notes.GETS, ("legitimate", "input", 22)),
    Occurrence(1.6, "world", notes.ENDS, ("controller", -9)),
    Occurrence(1.6, "legitimate", notes.PUT, ("telemetry/legitimate", 100, "0-27")),
]
"""Something of everything."""
SHOWN = """
          launcher       router         sensor         legitimate     controller     recorder
   0.0000 ● starts
   0.0000 ├─starts──────▶●
   0.1000 ├─starts─────────────────────▶●
   0.1000 ├─starts────────────────────────────────────▶●
   0.1000 ├─starts──────────────────────────────────────────────────────────────────▶●
   0.2000 │              │              ● connects to router                         │
   0.3000 │              │              │◀─command start─────────────────────────────┤
   0.4000 │              │◀─slot 0──────┤              │                             │
   0.4200 │              ├╌delivery 0╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌│                             │
   0.4300 │              ● SIGSTOP      │              │                             │
   0.4300 │              ● is suspended │              │                             │
   0.4300 ━━ stop router for 1 s ━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━━
   0.4500 │              ┊╌╌slot 1╌╌╌╌╌╌┤              │                             │
   0.5000 │              ├╌delivery 0╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌▶│                             │
   1.4300 │              ● goes on      │              │                             │
   1.4400 │              │◀╌slot 1╌╌╌╌╌╌┤              │                             │
   1.4500 │              ├─delivery 1 lost cut────────✗│                             │
   1.4600 │              │              │              ● disconnects from router cut │
   1.5000 │              │              │◀─input 1──────◀─────────────┤              │
   1.6000 │              │              │              │              ■ ends -9      │
   1.6000 │              │              │              ├─report 0-27────────────────?│
          launcher       router         sensor         legitimate     controller     recorder
"""


def test_everything_that_can_happen_is_shown() -> None:
    """Messages that arrive at once, later, at two processes, or never; lives, connections and faults."""
    assert diagram(steps_of(HAPPENED)) == SHOWN.strip("\n")


def test_messages_that_cross_have_a_line_each() -> None:
    """They arrive at once, whatever else is under way."""
    keys = ["control/sensor", "control/legitimate", "uplink"]
    sent = [Occurrence(0.0, "recorder", notes.PUT, (key, 40, "end")) for key in keys]
    got = [Occurrence(0.01, "sensor", notes.GETS, ("sensor", key, i)) for i, key in enumerate(keys, 1)]
    steps = steps_of([*sent, *got])
    assert [step.text for step in steps] == ["command end", "command end", "slot end"]
    assert not any(step.late for step in steps)


def slots(count: int) -> list[Occurrence]:
    """As many slots, with their deliveries."""
    each = (("sensor", "uplink"), ("router", "downlink/legitimate"))
    return [Occurrence(k / 100, process, notes.PUT, (key, 100, str(k))) for k in range(count) for process, key in each]


def test_what_repeats_is_folded_and_counted() -> None:
    """All slots but those at the beginning and at the end."""
    lines = diagram(steps_of(slots(300))).splitlines()
    assert len(lines) < 40
    (fold,) = (line for line in lines if "⋮" in line)
    more = int(fold.split()[1])
    assert more + len(lines) - 3 == 600  # two headers and the fold
    assert fold.endswith(f"{more // 2} slot, {more // 2} delivery")


def test_around_a_fault_nothing_is_folded() -> None:
    """That is where one looks."""
    happened = slots(300)
    happened.insert(301, Occurrence(1.5, "world", notes.FAULT, ("cut legitimate",)))
    lines = diagram(steps_of(happened)).splitlines()
    fault = next(i for i, line in enumerate(lines) if "cut legitimate" in line)
    assert not any("⋮" in line for line in lines[fault - 12 : fault + 13])
    assert sum("⋮" in line for line in lines) == 2


def test_a_diagram_is_no_longer_than_one_reads() -> None:
    """Whatever happened: the end is always there."""
    happened = [
        occurrence
        for i in range(200)
        for occurrence in (
            Occurrence(i, "world", notes.FAULT, (f"kill eve{i}",)),
            Occurrence(i, "world", notes.ENDS, (f"eve{i % 3}", -9)),
            Occurrence(i, "launcher", notes.STARTS, (f"eve{i % 3}",)),
        )
    ]
    lines = diagram(steps_of(happened)).splitlines()
    assert len(lines) <= 120
    assert "starts" in lines[-2]


def test_the_first_step_of_each_kind_is_shown() -> None:
    """Also in the middle of a long run."""
    happened = slots(300)
    happened.insert(301, Occurrence(1.5, "recorder", notes.PUT, ("control/sensor", 40, "hold")))
    assert "command hold" in diagram(steps_of(happened))


def test_a_router_that_is_killed_is_seen_to_be_started_again() -> None:
    """In a real run."""
    case = case_from(next(str(one["case"]) for one in REGRESSIONS if "router is killed" in one["why"]))
    played = play_case(case, program, keep=True)
    assert len(played.struck) == 1
    text = diagram(steps_of(played.run.happened))
    lines = text.splitlines()
    assert lines[0].split() == ["launcher", "router", "sensor", "legitimate", "eve", "recorder"]
    assert lines[-1] == lines[0]
    assert len(lines) <= 120
    assert max(map(len, lines)) <= 100
    column = lines[0].index("router")
    (fault,) = (i for i, line in enumerate(lines) if "━━ kill router after 80 events" in line)
    (end,) = (i for i, line in enumerate(lines) if line[column : column + 9] == "■ ends -9")
    begins = [i for i, line in enumerate(lines) if line[column : column + 1] == "●" and "starts" in line[:column]]
    assert fault < end <= fault + 2
    assert len(begins) == 2
    assert begins[0] < end < begins[1]
    assert all(line[column] == " " for line in lines[end + 1 : begins[1]] if "⋮" not in line and "━━" not in line)
    times = [float(found[0]) for line in lines if (found := re.match(r" *\d+\.\d{4}", line))]
    assert times == sorted(times)
    assert lines[-2].split()[1:] == ["■", "ends", "0"]


def test_what_a_case_does_not_note_is_not_shown() -> None:
    """An empty run has no columns."""
    assert diagram(steps_of([])).strip() == ""


def test_a_run_is_recorded_step_by_step(tmp_path: Path) -> None:
    """States of processes, messages, faults, and all steps as text, at their virtual time."""
    rrd, steps = tmp_path / "run.rrd", steps_of(HAPPENED)
    write_recording(steps, rrd)
    rows: list[tuple[str, dict[str, Any]]] = []
    for chunk in RrdReader(rrd).stream().filter(is_static=False):
        columns = chunk.to_record_batch().drop_columns(["log_time"]).to_pydict()
        for i in range(len(columns["step"])):
            rows.append((str(chunk.entity_path), {name: values[i] for name, values in columns.items()}))
    texts = [row["TextLog:text"][0] for path, row in sorted(rows, key=lambda one: one[1]["step"]) if path == "/log"]
    assert len(texts) == len(steps)
    assert texts[1] == "launcher → router: starts"
    states = [
        (row["step"], row["StateChange:state"][0]) for path, row in rows if path.startswith("/processes/001_router")
    ]
    assert [state for _, state in sorted(states)] == ["runs", "is suspended", "runs"]
    (fault,) = (row for path, row in rows if path == "/diagram/faults")
    assert fault["LineStrips2D:labels"] == ["stop router for 1 s"]
    assert fault["elapsed"].total_seconds() == 0.43
    inputs = [row for path, row in rows if path == "/diagram/messages" and row["Arrows2D:labels"] == ["input 1"]]
    assert len(inputs[0]["Arrows2D:vectors"]) == 2

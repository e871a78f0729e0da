"""Messages and briefs whose entries have the right types and contradict one another, or the run."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from evedrop.errors import MalformedMessage
from evedrop.live.protocol.keys import RunKeys, low_pass, reader_of, writer_of
from evedrop.model.links.loss_model import REASONS
from evedrop.model.slot.link import LinkSchedule
from tests.live.protocol.made_briefs import BRIEFS, refusal
from tests.live.protocol.readers import EXAMPLES, READERS, TRIALS, fields_of


def u4(*counts: int) -> bytes:
    """Counts as a message has them."""
    return np.array(counts, "<u4").tobytes()


def late_packets(fields: dict[str, Any]) -> None:
    """More than two of every slot that a packet may come from."""
    fields["late"] = [{"at": 4, "k": 4, "gamma": b"\0", "header": b""}] * 100


def more_used(fields: dict[str, Any]) -> None:
    """More late packets used than arrived."""
    fields["late_used"] = np.full((2, TRIALS), 2, "<u2").tobytes()


def two_fates(fields: dict[str, Any]) -> None:
    """A packet that was delivered and lost."""
    fields["links"]["legitimate"]["lost"] = u4(3, *[0] * (len(REASONS) - 1), *[0] * len(REASONS))


def many_delays(fields: dict[str, Any]) -> None:
    """More packets by their delay than were offered."""
    fields["links"]["eve"]["delays"] = u4(6, 1, 0, 0)


def no_delay(fields: dict[str, Any]) -> None:
    """A packet that is under way, and has no delay."""
    fields["links"]["eve"]["delivered"] = bytes([7, 6])


def too_late(fields: dict[str, Any]) -> None:
    """A delay beyond the window of a packet that was not lost."""
    fields["links"]["eve"]["delivered"] = bytes([7, 6])
    fields["links"]["eve"]["delays"] = u4(5, 0, 0, 1)


def negative_seconds(fields: dict[str, Any]) -> None:
    """A decision that took less than no time."""
    fields["seconds"] = np.array([-1.0]).tobytes()


def half_a_decision(fields: dict[str, Any]) -> None:
    """Not all slots in which it holds."""
    fields["c"] = 3


CONTRADICTIONS = {
    "delivery": (late_packets, "more than 6 entries in late of slot 4; expected at most two for each slot from 2 to 4"),
    "report": (more_used, "more in late_used than in late; expected at most as many late packets used as arrived"),
    "journal": (two_fates, "fates of legitimate's packets of slot 4; expected 3 fates"),
    "journal of many delays": (
        many_delays,
        "eve's packets for [6, 1, 0] in their slots, within the window and after it",
    ),
    "journal without a delay": (no_delay, "eve's packets for [6, 0, 0] in their slots, within the window and after it"),
    "journal with a long delay": (too_late, "after it; expected those of [5, 1, 0]"),
    "decisions": (negative_seconds, "seconds of -1; expected numbers of at least 0"),
    "decisions of some slots": (half_a_decision, "slots to 7; expected all slots of each decision, which holds for 4"),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_a_message_that_contradicts_itself_is_refused(case: str) -> None:
    """With what was found and what was expected."""
    change, message = CONTRADICTIONS[case]
    name = case.partition(" ")[0]
    key, read = READERS[name]
    read(EXAMPLES[name])
    fields = fields_of(name)
    change(fields)
    with pytest.raises(MalformedMessage) as raised:
        read(msgpack.packb(fields))
    assert raised.value.key == key
    assert message in str(raised.value)


def test_every_key_has_one_writer_and_a_reader() -> None:
    """Acknowledgements go from the legitimate estimator to the router, and from there to the sensor."""
    keys = RunKeys("r1")
    ends = {key: (writer_of(key), reader_of(key)) for key in (keys.acknowledged, keys.acknowledgements, keys.uplink)}
    assert ends == {
        keys.acknowledged: ("legitimate", "router"),
        keys.acknowledgements: ("router", "sensor"),
        keys.uplink: ("sensor", "router"),
    }


def test_a_router_drops_what_is_larger_than_its_kind() -> None:
    """Puts and deletes of a kind, whatever follows in the key; and an operator's questions and their answers."""
    rules = low_pass("r1", {"uplink": 70, "telemetry": 900})
    assert [(rule["id"], rule["messages"]) for rule in rules] == [
        ("uplink", ["put", "delete"]),
        ("telemetry", ["put", "delete"]),
        ("question", ["query"]),
        ("answer", ["reply"]),
    ]
    assert rules[0]["key_exprs"] == ["evedrop/r1/uplink", "evedrop/r1/uplink/**"]
    assert (rules[0]["size_limit"], rules[1]["size_limit"]) == (70, 900)
    assert all(rule["flows"] == ["ingress"] for rule in rules)


def set_in(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """A change of the entry at a dotted path."""

    def change(brief: dict[str, Any]) -> None:
        *tables, name = path.split(".")
        table = brief
        for inner in tables:
            table = table[inner]
        table[name] = value

    return change


def without_parameter(brief: dict[str, Any]) -> None:
    """The scheme needs it."""
    del brief["part"]["scheme"]["state_probability"]


def other_scheme(brief: dict[str, Any]) -> None:
    """The scheme does not know it."""
    brief["part"]["scheme"]["colour"] = 3


def other_controller(brief: dict[str, Any]) -> None:
    """There is none of that name."""
    brief["part"]["strategy"] = "pid"


def no_horizon(brief: dict[str, Any]) -> None:
    """True counts as 1 where nobody looks."""
    brief["part"]["strategy"] = "mpc"
    brief["part"]["assignment"]["parameters"] = {"horizon": True, "soft": 1.0}


def no_recording(brief: dict[str, Any]) -> None:
    """The same."""
    brief["part"]["monitor"] |= {"attack": "replay", "attack_data": {"recorded": True}}


def fewer_states(brief: dict[str, Any]) -> None:
    """The plant and the model are not of the same system."""
    noise = brief["part"]["plant"]["noise"]
    brief["part"]["plant"]["noise"] = [row[:-1] for row in noise[:-1]]


def no_matrix(brief: dict[str, Any]) -> None:
    """Its rows do not have the same length."""
    brief["model"]["A"] = [[1.0], [0.0, 1.0]]


def no_process(brief: dict[str, Any]) -> None:
    """Its noise is not a covariance."""
    brief["model"]["Q"][0][0] = -1.0


def free_input(brief: dict[str, Any]) -> None:
    """The controller weighs neither an input nor its change."""
    weights = brief["part"]["assignment"]
    weights["input_weights"] = weights["rate_weights"] = [0.0] * len(weights["input_weights"])


def many_disturbances(brief: dict[str, Any]) -> None:
    """One more in each slot than the plant has."""
    plant = brief["part"]["plant"]
    plant["disturbance_matrix"] = [[*row, 1.0] for row in plant["disturbance_matrix"]]


def one_state(brief: dict[str, Any]) -> None:
    """The noise and the model are not of the same system."""
    brief["part"]["noise_covariance"] = [[1.0]]


def no_covariance(brief: dict[str, Any]) -> None:
    """The noise has a direction with a negative variance."""
    brief["part"]["noise_covariance"] = [[1.0, 2.0], [2.0, 1.0]]


UNUSABLE: dict[str, list[tuple[Callable[[dict[str, Any]], None], str]]] = {
    "noise-before/bayesian": [
        (set_in("first", 1), "first is 1, where no outage of bayesian ends"),
        (one_state, "part.noise_covariance cannot be used (ValueError: it does not have 2 states"),
        (no_covariance, "part.noise_covariance cannot be used (ValueError: not positive definite)"),
    ],
    "eavesdroppers/sensor": [
        (without_parameter, "part.scheme.state_probability is missing"),
        (set_in("part.scheme.state_probability", None), "part.scheme.state_probability is None; expected a number"),
    ],
    "acknowledged/router": [
        (set_in("part.acknowledgements.spans", [[-1, 3]]), "-1 is not a slot, expected a number from 0 to"),
        *(
            (set_in(f"part.acknowledgements.{name}", -1), f"{name} is -1.0, expected a number from 0 to 1")
            for name in ("quality", "flip", "overheard")
        ),
        (set_in("part.acknowledgements.attack", "smile"), "part.acknowledgements.attack is smile"),
        (set_in("part.links.legitimate.window", 10**9), "its window is above 100000000 slots"),
        (set_in("part.links.legitimate.settings", {}), "its settings have no loss"),
        (set_in("part.links.legitimate.settings.loss.quality", "x"), 'quality is "x"'),
        (set_in("part.links.legitimate.settings.delay", {"model": "constant", "value": -1.0}), "value is -1.0"),
        *(
            (set_in(f"part.links.legitimate.settings.{name}", "x"), f'{name} is "x"; expected a')
            for name in ("reorder", "duplicate", "corrupt", "rate", "queue")
        ),
        (set_in("part.links.legitimate.settings.reorder", 2**63), "expected a number from 0 to 1"),
        (set_in("part.links.legitimate.settings.rate", 1.0), "it has a rate, and no queue"),
        (set_in("part.links.legitimate.settings.colour", 1.0), "a link has no setting colour"),
        (set_in("part.links.legitimate.settings.loss", {"model": "pooled", "links": []}), "its loss pools no links"),
        (set_in("part.links.legitimate.settings.delay", {"model": "constant", "colour": 1}), "'colour'"),
        (
            set_in(
                "part.links.legitimate.changes", [{"at": 1, "settings": {"loss": {"model": "bernoulli", "colour": 1}}}]
            ),
            "part.links.legitimate cannot be used",
        ),
        (
            set_in(
                "part.links.legitimate.changes",
                [{"at": 1, "settings": {"loss": {"model": "bernoulli", "quality": True}}}],
            ),
            "quality is true; expected a number from 0 to 1",
        ),
        (set_in("part.links.legitimate.outages", [[1, 2, 77]]), "Invalid enum value 77"),
        (set_in("part.links.legitimate.changes", [{"at": -1}]), "-1 is not a slot"),
        (
            set_in("part.links.legitimate.changes", [{"at": 1, "colour": "red"}]),
            "Object contains unknown field `colour` - at `$.part.links.legitimate.changes[0]`",
        ),
        (set_in("part.limits.colour", 3), "`colour` of part.limits is missing, or no kind of key"),
    ],
    "acknowledged/sensor": [
        (set_in("part.chart", {"acknowledged": 0, "missing": 1, "threshold": 2**63}), "is not a slot"),
        (set_in("part.scheme", {}), "part.scheme.scheme is missing, or no name"),
        (other_scheme, "part.scheme.colour is not a parameter of the scheme"),
    ],
    "microgrid/controller": [
        (set_in("part.assignment.period", 0), "period is 0, expected 1 to 1000000"),
        (set_in("part.assignment.rate_limits", []), "rate_limits has the shape (0,), expected "),
        (set_in("part.assignment.process.Q", [[1.0]]), "its process is not that of the model"),
        (other_controller, "part.strategy is pid, expected one of "),
        (no_horizon, "part.assignment.parameters.horizon is True; expected a whole number from 1 to 1000"),
        (free_input, "part: the input_weights leave an input without weight; expected input_weights, or rate_weights"),
    ],
    "replay-attack/sensor": [
        (
            set_in("part.monitor.parameters.threshold", -1.0),
            "part.monitor.parameters.threshold is -1.0; expected a number",
        ),
        (no_recording, "recorded is True, expected a number of slots from 1 to 1000000"),
    ],
    "microgrid/sensor": [
        (fewer_states, "noise has the shape "),
        (set_in("part.plant.start", [["inf"]]), "Expected `float`, got `str` - at `$[0][0]` - at `$.part.plant.start`"),
        (
            set_in("part.plant.input_lower", ["nan"]),
            "Invalid enum value 'nan' - at `$[0]` - at `$.part.plant.input_lower`",
        ),
        (set_in("part.plant.noise", [[True]]), "Expected `float`, got `bool`"),
        (set_in("part.plant.colour", "red"), "Object contains unknown field `colour` - at `$.part.plant`"),
        (set_in("part.disturbances", None), "part.disturbances is missing"),
        (no_matrix, "A, Q or initial_covariance is not a matrix - at `$.model`"),
        (no_process, "it is not a process: Q has the eigenvalue -1"),
        (many_disturbances, "part.disturbances cannot be used (ValueError: it has "),
    ],
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_brief_whose_parts_do_not_fit_together_is_refused(name: str, tmp_path: Path) -> None:
    """With the entry."""
    for change, message in UNUSABLE[name]:
        brief = copy.deepcopy(BRIEFS[name])
        assert refusal(brief, tmp_path) is None
        change(brief)
        refused = refusal(brief, tmp_path)
        assert refused is not None
        assert message in refused, json.dumps(refused)


def test_links_share_causes_with_a_probability() -> None:
    """A brief that says otherwise is refused with it."""
    schedule = LinkSchedule({"loss": {"model": "bernoulli", "quality": 0.5}}, correlation=("eve", 7.0))
    with pytest.raises(ValueError, match="its correlation is 7, expected a number from 0 to 1"):
        schedule.expect_possible()


def test_an_estimator_that_knows_the_inputs_has_the_plant_of_its_model(tmp_path: Path) -> None:
    """Without the disturbances, which only sensor and controller know."""
    brief = copy.deepcopy(BRIEFS["microgrid/legitimate"])
    plant: dict[str, Any] = copy.deepcopy(BRIEFS["microgrid/sensor"]["part"]["plant"])
    brief["part"]["controller"] = {"period": 1, "acts_on": "estimate", "plant": plant}
    assert refusal(brief, tmp_path) is None
    plant["noise"] = [[*row, 0.0] for row in plant["noise"]]
    refused = refusal(brief, tmp_path)
    assert refused is not None
    assert "noise has the shape " in refused
    assert "part.controller.plant" in refused
    plant |= {"start": [0.0], "noise": [[1.0]], "state_lower": [-1.0], "state_upper": [1.0]}
    plant |= {"input_matrix": plant["input_matrix"][:1], "disturbance_matrix": plant["disturbance_matrix"][:1]}
    assert "part.controller.plant cannot be used (ValueError: it does not have " in str(refusal(brief, tmp_path))

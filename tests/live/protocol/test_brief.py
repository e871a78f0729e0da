"""Briefs: written for one process alone, refused when they are anything else."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from evedrop.errors import BriefError, UsageError
from evedrop.live.launch.briefs import RecorderTask, briefs_of
from evedrop.live.launch.ports import endpoints_at
from evedrop.live.protocol.brief import (
    EavesdropperPart,
    RecorderPart,
    RouterPart,
    SensorPart,
    has_part,
    read_brief,
    with_files_in,
)
from evedrop.live.protocol.json_tables import plain
from evedrop.model.checks import as_toml
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.scenario.stream_keys import StreamKeys
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.live.protocol.made_briefs import BRIEF, BRIEFS, briefed, made, refusal

PLAIN: dict[str, Any] = json.loads(BRIEF.text)


def test_reads_back_what_was_written(tmp_path: Path) -> None:
    """A brief is the same after it was written and read; only its owner may read the file, whatever the umask."""
    before = os.umask(0)
    try:
        path = BRIEF.write(tmp_path)
    finally:
        os.umask(before)
    assert path.name == "eve.json"
    assert path.stat().st_mode & 0o777 == 0o600
    assert read_brief(path, "eavesdropper") == BRIEF
    assert BRIEF.stream_keys == {"schedule": bytes.fromhex("ab" * 32)}
    assert list(BRIEF.batch.trial_range) == [5, 6, 7]
    assert np.array_equal(BRIEF.model.process.A, [[1.0, 0.1], [0.0, 1.0]])


def test_a_brief_has_the_part_of_its_role() -> None:
    """And of no other."""
    assert has_part(BRIEF, EavesdropperPart)
    assert not has_part(BRIEF, SensorPart)


@pytest.mark.parametrize("role", ["router", "relay"])
def test_a_router_has_a_limit_for_every_kind_of_message(role: str, tmp_path: Path) -> None:
    """And so has a relay."""
    brief = json.loads(json.dumps(BRIEFS["replay-attack/router"]))
    if role == "relay":
        users, limits = brief["part"]["users"], brief["part"]["limits"]
        brief["part"] = {
            "users": users,
            "receivers": [],
            "listen": "x",
            "zid": "1",
            "controller": None,
            "limits": limits,
        }
        brief["role"] = "relay"
    assert refusal(brief, tmp_path) is None
    del brief["part"]["limits"]["ack"]
    assert "`ack` of part.limits is missing, or no kind of key - at `$.part`" in str(refusal(brief, tmp_path))


def test_a_table_that_nobody_can_change_is_written_as_any_other() -> None:
    """As parameters may be."""
    assert json.dumps(MappingProxyType({"use": 0.5}), default=plain) == '{"use": 0.5}'


def test_the_entries_of_a_brief_are_those_of_its_file() -> None:
    """A launcher sends them to another host, where they are written to a file."""
    brief = BRIEF
    assert brief.entries == json.loads(brief.text)
    assert brief.entries["process"] == brief.process


def test_a_process_has_its_own_files_in_a_folder(tmp_path: Path) -> None:
    """Its last word; and the state that it keeps, if it is a receiver that goes away."""
    assert with_files_in(BRIEF, tmp_path) == replace(BRIEF, last_word=str(tmp_path / "eve.last-word"))
    away = replace(BRIEF, part=replace(BRIEF.part, outages=[(3, 5, True)]))
    assert with_files_in(away, tmp_path).part == replace(away.part, state_file=str(tmp_path / "eve.state"))
    router = made(briefed())["router"]
    assert with_files_in(router, tmp_path).part == router.part


def test_a_brief_that_is_too_large_is_refused_unread(tmp_path: Path) -> None:
    """A sparse file of more than a gigabyte."""
    path = BRIEF.write(tmp_path)
    os.truncate(path, 2**30 + 1)
    with pytest.raises(BriefError, match=r"is not a brief of this version \(it has more than 1073741824 bytes\)"):
        read_brief(path)


def test_a_brief_that_its_process_would_refuse_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For each event that sets an entry of a link, the router's brief has another copy of the link's recorded delays."""
    monkeypatch.setattr("evedrop.live.protocol.brief._MOST_BYTES", 100_000)
    recorded = {"quality": 0.9, "delay": {"model": "trace", "values": [0.25] * 1000}}
    event = [{"at": slot, "link": "legitimate", "set": {"quality": 0.5}} for slot in range(1, 41)]
    legitimate = {"window": 4, "link": recorded}
    read_brief(made(briefed(legitimate=legitimate, event=event[:2]))["router"].write(tmp_path), "router")
    with pytest.raises(
        UsageError,
        match=r"^the brief of router has \d{6} bytes, and a process reads at most 100000: each event .* fewer events",
    ):
        made(briefed(legitimate=legitimate, event=event))["router"].write(tmp_path / "nowhere")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644, 0o610])
def test_refuses_what_others_can_read(mode: int, tmp_path: Path) -> None:
    """A brief that group or others can read holds no secret any more."""
    path = BRIEF.write(tmp_path)
    path.chmod(mode)
    with pytest.raises(BriefError, match="readable by others; a brief holds keys: chmod 600"):
        read_brief(path)


def test_refuses_another_role(tmp_path: Path) -> None:
    """A program takes no brief of another role, and says which command does."""
    with pytest.raises(
        BriefError, match="brief of a eavesdropper; expected one of a sensor: start `evedrop eavesdropper`"
    ):
        read_brief(BRIEF.write(tmp_path), "sensor")


def without(name: str) -> dict[str, Any]:
    """The brief without an entry."""
    return {entry: value for entry, value in PLAIN.items() if entry != name}


@pytest.mark.parametrize(
    "value",
    [
        [],
        "text",
        {},
        {**PLAIN, "secret": "00"},
        {**PLAIN, "role": "spy"},
        {**PLAIN, "flow": {"window": 8}},
        {**PLAIN, "flow": {"window": 8, "batch": 2, "more": 1}},
        {**PLAIN, "model": []},
        *({**PLAIN, entry: chunk} for entry in ("run", "process") for chunk in ("", "/nowhere", "a//b", "a*", "a#")),
        without("slots"),
        without("model"),
        without("role"),
    ],
)
def test_refuses_what_is_no_brief(value: object, tmp_path: Path) -> None:
    """Missing and unknown entries, unknown roles and other JSON are one line with the remedy, status 2."""
    path = tmp_path / "brief.json"
    path.write_text(json.dumps(value))
    path.chmod(0o600)
    with pytest.raises(
        BriefError, match=r"is not a brief of this version .*; write it again with `evedrop brief`"
    ) as caught:
        read_brief(path)
    assert caught.value.exit_status == 2


@pytest.mark.parametrize("number", ["Infinity", "NaN", "1e400"])
def test_refuses_numbers_that_cannot_be_written_again(number: str, tmp_path: Path) -> None:
    """In tables that may hold anything, too, such as those of the recorder's scenario."""
    brief = json.loads(made(briefed())["recorder"].text)
    brief["part"]["scenario"]["nemesis"] = "here"
    path = tmp_path / "brief.json"
    path.write_text(json.dumps(brief).replace('"here"', number))
    path.chmod(0o600)
    with pytest.raises(BriefError, match=r"is not a brief of this version \((JSON is malformed|Number out of range)"):
        read_brief(path)


def test_refuses_what_is_not_there(tmp_path: Path) -> None:
    """A missing file and one that is not JSON have different messages."""
    with pytest.raises(BriefError, match="No such file or directory"):
        read_brief(tmp_path / "none.json")
    path = tmp_path / "broken.json"
    path.write_text("{")
    path.chmod(0o600)
    with pytest.raises(BriefError, match="is not a brief of this version"):
        read_brief(path)


def test_who_is_given_which_keys() -> None:
    """Each process has the keys of the streams it owns by definition, and no others."""
    keys = {name: set(brief.keys) for name, brief in made(briefed()).items()}
    assert keys == {
        "router": {
            f"{kind}/{name}"
            for kind in ("link", "delay", "fate")
            for name in ("legitimate", "naive", "smart", "doubtful")
        },
        "sensor": {"process", "schedule", "noise"},
        "legitimate": {"schedule", "noise"},
        "naive": set(),
        "smart": {"schedule"},
        "doubtful": {"schedule", "coin"},
        "recorder": set(),
    }


def test_without_secret_nobody_has_its_keys() -> None:
    """The plain scheme has no secret: sensor and estimator are given none."""
    briefs = made(briefed(encoding={"scheme": "plain"}, eavesdroppers={}))
    assert set(briefs["sensor"].keys) == {"process"}
    assert set(briefs["legitimate"].keys) == set()


def test_keys_agree_between_those_who_share_them() -> None:
    """All processes with a stream have the same key; different streams have different keys."""
    briefs = made(briefed())
    for stream in ("schedule", "noise"):
        assert len({brief.keys[stream] for brief in briefs.values() if stream in brief.keys}) == 1
    everything = {(name, key) for brief in briefs.values() for name, key in brief.keys.items()}
    assert len({key for _, key in everything}) == len(everything)


def test_a_secret_file_replaces_the_seed_where_it_must(tmp_path: Path) -> None:
    """With a secret of its own a scenario has other schedule and noise keys, and everything else as before."""
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(40)))
    plain, own = made(briefed()), made(briefed(secret_file=str(secret)))
    for name, brief in plain.items():
        for stream, key in brief.keys.items():
            assert (own[name].keys[stream] == key) == (stream not in {"schedule", "noise"})
    keys = [StreamKeys.from_scenario(scenario) for scenario in (briefed(secret_file=str(secret)), briefed())]
    assert keys[0].seed_root == keys[1].seed_root


def test_passwords_and_run_are_made_afresh() -> None:
    """Two runs of one scenario share no password, each process has its own, and the router alone knows all."""
    first, second = made(briefed()), made(briefed())
    passwords = [brief.password for briefs in (first, second) for brief in briefs.values()]
    assert len(set(passwords)) == len(passwords) == 14
    assert min(map(len, passwords)) >= 32
    assert first["router"].run != second["router"].run
    users = {n: b.password for n, b in first.items()}
    router, recorder = first["router"].part, first["recorder"].part
    assert isinstance(router, RouterPart)
    assert isinstance(recorder, RecorderPart)
    assert router.users == {**users, "operator": recorder.operator}
    assert recorder.operator not in passwords


def test_an_added_eavesdropper_changes_nobody_elses_keys() -> None:
    """Keys of streams depend on their own names only."""
    fewer = briefed()
    more = briefed(
        eavesdroppers={**fewer.model_dump()["eavesdroppers"], "extra": fewer.model_dump()["eavesdroppers"]["smart"]}
    )
    before, after = made(fewer), made(more)
    for name, brief in before.items():
        assert brief.keys.items() <= after[name].keys.items()


def test_model_is_the_only_thing_all_share() -> None:
    """Every brief holds the public model; no eavesdropper's brief holds anything of the scenario beyond its own part."""
    briefs = made(briefed())
    assert len({json.dumps(asdict(brief.model)) for brief in briefs.values()}) == 1
    assert json.loads(briefs["doubtful"].text)["part"] == {
        "strategy": "suspicious",
        "parameters": {"use_state": 0.9, "use_innovation": 0.1},
        "window": 0,
        "outages": [],
    }


def test_no_secret_is_in_what_python_shows_of_a_brief() -> None:
    """Neither keys, passwords, private keys nor the seed: they would be in a traceback, and so in a log."""
    made_for = endpoints_at("tls/0.0.0.0:7447", "tls/router.lan:7447")
    for brief in briefs_of(briefed(seed=987_654_321), made_for, RecorderTask(Path("nowhere"), False)).values():
        shown, entries = repr(brief), json.loads(brief.text)
        secrets = [brief.password, *brief.keys.values(), *entries["part"].get("users", {}).values()]
        secrets += [entries["part"].get("operator"), entries["identity"]["key"], "PRIVATE KEY", "987654321"]
        assert [secret for secret in secrets if secret and secret in shown] == []


@pytest.mark.parametrize("role", ["legitimate", "smart"])
@pytest.mark.parametrize(
    ("outage", "message"),
    [
        ([[], 3, True], "Expected `int`, got `array` - at `$.part.outages[0][0]`"),
        ([2, 3, 1], "Expected `bool`, got `int` - at `$.part.outages[0][2]`"),
        ([2, 3], "Expected `array` of length 3, got 2 - at `$.part.outages[0]`"),
        ([2, 3, True, 4], "Expected `array` of length 3, got 4 - at `$.part.outages[0]`"),
    ],
)
def test_a_malformed_outage_is_refused(role: str, outage: list[Any], message: str, tmp_path: Path) -> None:
    """It is refused before the receiver joins the run."""
    brief = json.loads(made(briefed())[role].text)
    brief["part"]["outages"] = [outage]
    assert message in str(refusal(brief, tmp_path))


@pytest.mark.parametrize(
    ("strategy", "parameter", "value"),
    [
        ("learning-particle", "particles", 0),
        ("replay-informed", "learns_at", [[1.0]]),
        ("replay-informed", "learns_at", -1),
        ("colluding", "particles", "x"),
        ("suspicious", "use_state", "x"),
    ],
)
def test_a_parameter_that_the_strategy_finds_wrong_is_refused(
    strategy: str, parameter: str, value: Any, tmp_path: Path
) -> None:
    """In the words in which it refuses it in a scenario."""
    brief = json.loads(made(briefed())["doubtful"].text)
    parameters = {**STRATEGIES["learning-particle"].parameters, **STRATEGIES[strategy].parameters}
    if "reads_as" in parameters:
        parameters["reads_as"] = "learning-particle"
    brief["part"] |= {"strategy": strategy, "parameters": {**parameters, parameter: value}}
    assert f"part.parameters.{parameter} is {as_toml(value)}; expected" in str(refusal(brief, tmp_path))


@pytest.mark.parametrize("wrong", [[0.5] * 3, [1.5], [-0.1]])
def test_probabilities_that_are_not_one_for_each_slot_are_refused(wrong: list[float], tmp_path: Path) -> None:
    """A list of μ_d(k) has one number from 0 to 1 for each slot."""
    brief = json.loads(made(briefed())["smart"].text)
    brief["model"]["state_probabilities"] = wrong if len(wrong) > 1 else wrong * brief["slots"]
    assert "model.state_probabilities" in str(refusal(brief, tmp_path))
    brief["model"]["state_probabilities"] = [0.5] * brief["slots"]
    assert refusal(brief, tmp_path) is None


def test_a_process_whose_packets_show_its_noise_is_refused_by_who_reads_leaks(tmp_path: Path) -> None:
    """A and Q are both singular, so the posterior of a packet's type does not exist. The brief is refused without a traceback."""
    brief = json.loads(made(briefed())["smart"].text)
    assert refusal(brief, tmp_path) is None
    brief["part"] |= {"strategy": "bayesian", "parameters": {}}
    brief["model"] |= {"A": [[1.0, 0.0], [0.0, 0.0]], "Q": [[1.0, 0.0], [0.0, 0.0]], "singular_noise": True}
    assert "model cannot be used (ValueError: A is singular to double precision, and so is Q" in str(
        refusal(brief, tmp_path)
    )


@pytest.mark.parametrize("role", ["router", "sensor", "legitimate", "smart", "recorder"])
def test_unknown_entries_of_a_part_are_refused(role: str, tmp_path: Path) -> None:
    """As those of the brief itself."""
    brief = json.loads(made(briefed())[role].text)
    brief["part"]["seed"] = 3
    assert "(Object contains unknown field `seed` - at `$.part`)" in str(refusal(brief, tmp_path))


OPTIONAL = {
    "first",
    "patience",
    "identity",
    "modules",
    "header",
    "singular_noise",
    "longest_outage",
    "largest_message",
    "largest_report",
    "message",
    "measurement",
    "noise_covariance",
    "output_matrix",
    "measurement_noise",
    "monitor",
    "flip",
    "overheard",
}
"""Entries that a brief may leave out, or whose meaning another one gives."""
WITHIN = (
    "part.scenario",
    "part.assignment.parameters",
    "part.parameters",
    "part.scheme",
    "part.noise_covariance",
    "part.monitor.parameters",
    "part.monitor.attack_data",
    "model.A",
    "model.Q",
)
"""Tables with entries of the scenario, which their readers check, and matrices."""


def entries(table: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any], str]]:
    """Dotted path, table and name of every entry that is there by name."""
    if isinstance(table, dict):
        for name, inner in table.items():
            yield f"{path}{name}", table, name
            if f"{path}{name}" not in WITHIN:
                yield from entries(inner, f"{path}{name}.")


USUAL = [
    *(f"replay-attack/{process}" for process in ("router", "sensor", "legitimate", "controller")),
    *(f"acknowledged/{process}" for process in ("router", "sensor")),
    *(f"colluding/{process}" for process in ("router", "legitimate", "equal")),
    *(f"twin-track/{process}" for process in ("late", "recorder")),
    "eavesdroppers/suspicious",
    "noise-before/deaf",
]
"""Briefs that have between them every entry that a brief of each role has, and one of a strategy with parameters."""


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("replay-attack/controller", "part.assignment.parameters"),
        ("replay-attack/sensor", "part.monitor.parameters"),
        ("replay-attack/sensor", "part.monitor.attack_data"),
        ("eavesdroppers/suspicious", "part.parameters"),
        ("colluding/equal", "part.parameters"),
        ("eavesdroppers/suspicious", "part"),
    ],
)
def test_an_entry_that_is_not_known_is_refused(name: str, path: str, tmp_path: Path) -> None:
    """Another version may mean something by it; also where a class reads the table."""
    brief = json.loads(json.dumps(BRIEFS[name]))
    table = brief
    for part in path.split("."):
        table = table[part]
    table["newer"] = 1
    assert re.search(
        rf"{re.escape(path)}\.newer is not|unknown field `newer` - at `\$\.{path}`", str(refusal(brief, tmp_path))
    )


def test_a_detector_without_an_attack_can_be_used(tmp_path: Path) -> None:
    """And has no data of one."""
    brief = json.loads(json.dumps(BRIEFS["replay-attack/sensor"]))
    brief["part"]["monitor"] |= {"attack": None, "attack_data": {}}
    assert refusal(brief, tmp_path) is None


@pytest.mark.parametrize("name", mostly_long(BRIEFS, USUAL))
def test_every_brief_lacks_nothing_unnoticed(name: str, tmp_path: Path) -> None:
    """Each of its entries and keys, left out or of another type, is refused and named; the whole brief can be used."""
    brief = BRIEFS[name]
    assert refusal(brief, tmp_path) is None
    for path, table, entry in list(entries(brief)):
        before = table.pop(entry)
        without = refusal(brief, tmp_path)
        shared = path.split(".")[0] in ("keys",) or path.startswith(("part.users.", "part.leaks.", "part.links."))
        if entry not in OPTIONAL and not shared:
            assert without is not None, path
            parent, _, name = path.rpartition(".")
            assert path in without or (f"`{name}`" in without and parent in without), (
                path,
                without,
            )
        strange: tuple[Any, ...] = ([["x"]], {"x": {"y": []}}, "\x00", -1.5)
        for other in strange:
            table[entry] = other
            refused = refusal(brief, tmp_path)  # whatever it is, nothing but a BriefError
            if not isinstance(other, type(before)) and before is not None and path not in ("part.modules",):
                assert refused is not None or isinstance(before, float), (path, other)
        table[entry] = before


@pytest.mark.parametrize("name", [brief for brief in BRIEFS if BRIEFS[brief]["keys"]])
def test_a_brief_without_its_key_is_refused(name: str, tmp_path: Path) -> None:
    """The key is named, not what it would have been; a KeyError comes from nowhere."""
    brief = json.loads(json.dumps(BRIEFS[name]))
    for stream, key in list(brief["keys"].items()):
        del brief["keys"][stream]
        reason = refusal(brief, tmp_path)
        assert reason is not None, stream
        assert f"keys.{stream} is missing" in reason
        assert key not in reason
        brief["keys"][stream] = key


def test_a_process_without_its_key_ends_with_status_2(evedrop: Evedrop) -> None:
    """Typed as a user does it: one line, before it waits for anybody."""
    for process, stream in (("sensor", "process"), ("smart", "schedule"), ("router", "link/legitimate")):
        brief = made(briefed())[process]
        path = replace(brief, keys={name: key for name, key in brief.keys.items() if name != stream}).write(
            evedrop.folder
        )
        done = evedrop(brief.role, str(path))
        assert done.status == 2
        assert done.err.count("\n") == 1
        assert f"keys.{stream} is missing, and {process} cannot work without it; write it again" in done.err


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_a_brief_that_is_no_file_is_refused(kind: str, tmp_path: Path) -> None:
    """It is refused at once, without waiting for a writer."""
    path = tmp_path / "sensor.json"
    if kind == "pipe":
        os.mkfifo(path, 0o600)
    elif kind == "folder":
        path.mkdir(0o700)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(BriefError, match=r"it is a (pipe or a device|folder)"):
        read_brief(path)


def test_a_monitor_that_does_not_fit_its_plant_is_refused(tmp_path: Path) -> None:
    """Its matrices must have the dimensions of inputs and measurements, and there must be a filter."""
    brief = json.loads(json.dumps(BRIEFS["replay-attack/sensor"]))
    brief["part"]["monitor"]["shift"] = [[1.0, 2.0]]
    assert "part.monitor cannot be used (ValueError: its matrices are" in str(refusal(brief, tmp_path))
    brief["part"]["plant"] = None
    assert "part.monitor cannot be used (ValueError: there is no filter" in str(refusal(brief, tmp_path))

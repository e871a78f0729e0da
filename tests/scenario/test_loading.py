"""The scenario file: what is refused, how it is said, and what is taken."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from evedrop.errors import ScenarioError, UsageError
from evedrop.results.resolved_scenario import write_resolved
from evedrop.scenario.estimates import warnings_of
from evedrop.scenario.loading import load, parse, value_of
from evedrop.scenario.tables import Scenario
from evedrop.scenarios import shipped, write_new
from tests.builders import GOOD, mistakes_in_good, places_of
from tests.golden.pages import Golden


@pytest.mark.parametrize(
    ("key", "value", "place"),
    [
        ("titel", "x", "titel"),
        ("title", "", "title"),
        ("slots", "many", "slots"),
        ("slots", 2.5, "slots"),
        ("slots", True, "slots"),
        ("slots", 0, "slots"),
        ("slots", 2**40, "slots"),
        ("seed", -1, "seed"),
        ("trials", 0, "trials"),
        ("record_trials", 2, "record_trials"),
        ("shards", 2, "shards"),
        ("pace", -0.1, "pace"),
        ("pace", float("nan"), "pace"),
        ("process.A", 3, "process.A"),
        ("process.A", [[1.0, 2.0]], "process.A"),
        ("process.A", [[1.0], [1.0, 2.0]], "process.A"),
        ("process.A", [], "process.A"),
        ("process.A.0.1", float("inf"), "process.A.0.1"),
        ("process.A.0.1", 10**400, "process.A.0.1"),
        ("process.A.0.1", "x", "process.A.0.1"),
        ("process.Q", [[1e-3]], "process.Q"),
        ("process.Q.0.1", 1e-4, "process.Q"),
        ("process.Q.1.1", -1.0, "process.Q"),
        ("process.Q", [[1.0, 1.0 - 1e-14], [1.0 - 1e-14, 1.0]], "process.Q"),
        ("process.initial_covariance.1.1", 0.0, "process.initial_covariance"),
        (
            "encoding.scheme",
            "inovation",
            "encoding.scheme",
        ),
        ("encoding.scheme", "rot13", "encoding.scheme"),
        ("eavesdroppers.smart.strategy", "suspicous", "eavesdroppers.smart.strategy"),
        ("legitimate.link", {"loss": {"model": "gilbert-eliott"}}, "legitimate.link.loss.model"),
        ("legitimate.link", {"loss": {"model": 7}}, "legitimate.link.loss.model"),
        ("encoding.scheme", "plain", "encoding.state_probability"),
        ("encoding.sceme", "plain", "encoding.sceme"),
        ("encoding.state_probability", "x", "encoding.state_probability"),
        ("encoding.state_probability", 1.5, "encoding.state_probability"),
        ("legitimate.link.quality", -0.5, "legitimate.link.quality"),
        ("legitimate.link.quality", "0.5", "legitimate.link.quality"),
        ("legitimate.link", 0.5, "legitimate.link"),
        ("eavesdroppers.smart.strategy", "clever", "eavesdroppers.smart.strategy"),
        ("eavesdroppers.smart.links", [{"quality": 0.5}, {"quality": 0.6}], "eavesdroppers.smart.links"),
        ("eavesdroppers.smart.reads_as", "genie", "eavesdroppers.smart.reads_as"),
        ("eavesdroppers.smart.learns_at", 3, "eavesdroppers.smart.learns_at"),
        ("eavesdroppers.smart.use_state", 0.5, "eavesdroppers.smart.use_state"),
        ("eavesdroppers.smart.strategy", "suspicious", "eavesdroppers.smart.use_innovation"),
        ("eavesdroppers.Eve", GOOD["eavesdroppers"]["smart"], "eavesdroppers.Eve"),
        ("eavesdroppers.router", GOOD["eavesdroppers"]["smart"], "eavesdroppers.router"),
        (
            "eavesdroppers",
            {f"e{i}": GOOD["eavesdroppers"]["smart"] for i in range(65)},
            "eavesdroppers",
        ),
        ("expect", [{"metric": "smart.mean_eror", "below": 1.0}], "expect.0.metric"),
        ("expect", [{"metric": "smart.used_fraction"}], "expect.0.below"),
        ("expect", [{"metric": "smart.used_fraction", "below": float("nan")}], "expect.0.below"),
        ("secret_file", "no-such-file", "secret_file"),
        ("secret_file", "/dev/null", "secret_file"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_path_found_and_expected(key: str, value: Any, place: str, golden: Golden) -> None:
    """One wrong entry gives one line: its path, what was found, what was expected, an example or a hint."""
    mistakes = mistakes_in_good({key: value})
    assert place in places_of(mistakes)
    assert "\n" not in "".join(mistakes)
    golden("check", mistakes)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("state_probability", "encoding.state_probability"),
        ("A", "process.A"),
        ("quality", "legitimate.link.quality or acknowledgements.link.quality"),
        ("slot", "slots"),
    ],
)
def test_an_entry_of_an_inner_table_is_suggested_with_its_dotted_key(name: str, meant: str) -> None:
    """As after `--set state_probability=0.5`."""
    assert f"{name}: is not an entry of this table; did you mean {meant}?" in mistakes_in_good({name: 0.5})


@pytest.mark.parametrize("entry", ["title", "slots", "process", "process.Q", "encoding.scheme", "legitimate.link"])
def test_a_missing_entry_is_named(entry: str) -> None:
    """A missing entry is named by its path."""
    assert any(line.startswith(f"{entry}: is missing; expected ") for line in mistakes_in_good({}, entry))


def test_an_uncontrollable_pair_is_named() -> None:
    """A process with noise that never reaches a direction of the state is refused."""
    mistakes = mistakes_in_good({"process.A": [[1.0, 0.0], [0.0, 1.0]], "process.Q": [[1.0, 0.0], [0.0, 0.0]]})
    assert any("not controllable: the noise reaches 1 of 2 directions" in line for line in mistakes)


WRONG_ENTRIES = {
    "slots": "many",
    "titel": "x",
    "encoding.scheme": "plain",
    "encoding.extra": 1,
    "legitimate.link.quality": 2.0,
    "eavesdroppers.smart.link": 3,
    "expect": [{"metric": "nobody.used_fraction"}, {"below": 1.0}],
    "record_trials": 9,
}
WRONG_TOGETHER = {
    "process.Q.0.1": 1e-4,
    "eavesdroppers.smart.use_state": 0.5,
    "legitimate.link.reorder": 0.5,
    "expect": [{"metric": "nobody.used_fraction"}],
    "record_trials": 9,
}
WRONG_ACROSS = {
    "legitimate.knows_input": True,
    "expect": [{"metric": "nobody.used_fraction", "below": 1.0}],
    "record_trials": 9,
}


@pytest.mark.parametrize(
    ("changes", "without", "paths"),
    [
        (
            WRONG_ENTRIES,
            "process.initial_covariance",
            "slots titel process.initial_covariance encoding.extra encoding.state_probability legitimate.link.quality "
            "eavesdroppers.smart.link expect.0.below expect.1.metric",
        ),
        (WRONG_TOGETHER, "", "process.Q eavesdroppers.smart.use_state legitimate.link.reorder expect.0.below"),
        (WRONG_ACROSS, "", "legitimate.knows_input expect.0.metric record_trials"),
    ],
    ids=["entries", "tables", "across tables"],
)
def test_all_mistakes_are_named_at_once(changes: dict[str, Any], without: str, paths: str) -> None:
    """No wrong table hides another; what only shows when tables are compared waits until all of them are valid."""
    mistakes = mistakes_in_good(changes, without)
    assert sorted(line.partition(": ")[0] for line in mistakes) == sorted(paths.split())


def test_an_expectation_on_what_theory_does_not_know_is_refused() -> None:
    """Behind a queue the theoretical trace is unknown, so expectations of it are refused; those of other metrics are not."""
    queue = {"eavesdroppers.smart.link": {"quality": 0.9, "rate": 0.5}}
    expect = [
        {"metric": f"smart.{metric}", "below": 1.0} for metric in ("received_fraction", "theoretical_trace_covariance")
    ]
    (line,) = mistakes_in_good({**queue, "expect": expect})
    assert line.startswith('expect.1.metric: is "smart.theoretical_trace_covariance", but no theory covers')
    (line,) = mistakes_in_good({"eavesdroppers.smart.strategy": "bayesian", "expect": expect})
    assert line.endswith("but no closed form is known for the strategy bayesian of smart; expected another metric")


def test_more_slots_than_the_horizon_are_refused() -> None:
    """The bound and three ways out are named, and the bound is exact."""
    (mistake,) = mistakes_in_good({"process.A": [[1.4, 0.3], [0.5, 1.0]], "slots": 4000})
    assert "slots: is 4000; this process (spectral radius" in mistake
    assert mistake.count(";") >= 3
    bound = int(mistake.split("slots = ")[1].split()[0])
    inside = {"process.A": [[1.4, 0.3], [0.5, 1.0]], "slots": bound}
    assert parse(tomli_w.dumps(GOOD), "scenario", inside).slots == bound
    assert mistakes_in_good({**inside, "slots": bound + 1})


@pytest.mark.parametrize(("key", "value"), [("legitimate.link.quality", 0.2), ("encoding.state_probability", 0.1)])
def test_an_unbounded_estimator_is_a_warning(key: str, value: float) -> None:
    """A link or μ_d below the stability bound is said with bound and value, and taken."""
    (warning,) = warnings_of(load("numerical", {key: value}))
    assert "grows without bound" in warning
    assert f"{value:g}" in warning
    assert warnings_of(load("numerical")) == []


@pytest.mark.parametrize(
    ("encoding", "growth", "attack"),
    [
        ({"scheme": "quantised-schedule", "threshold": 3, "bits": 1, "standard_deviations": 4}, 1.3, None),
        ({"scheme": "scheduled", "threshold": 3}, 1.6, "forge"),
    ],
)
def test_an_estimator_that_its_scheme_leaves_unbounded_is_a_warning(
    encoding: dict[str, Any], growth: float, attack: str | None
) -> None:
    """Though its link is good enough for the states themselves."""
    listener = {"strategy": "reference", "link": {"quality": 0.5}}
    process = {"A": [[growth]], "Q": [[1.0]], "initial_covariance": [[1.0]]}
    acknowledgements = {"link": {"quality": 0.9}, **({} if attack is None else {"attack": attack})}
    changes = {"process": process, "acknowledgements": acknowledgements, "eavesdroppers": {"listener": listener}}
    changes |= {"expect": [], "slots": 40, "legitimate.link.quality": 0.8}
    (warning,) = warnings_of(load("acknowledged", {**changes, "encoding": encoding}))
    assert "grows without bound: with link quality 0.8" in warning
    assert f"the scheme {encoding['scheme']} brings it the state too rarely or too roughly" in warning
    assert (
        warnings_of(load("acknowledged", {**changes, "encoding": encoding, "process": process | {"A": [[0.9]]}})) == []
    )


def test_large_results_are_a_warning() -> None:
    """A run that will write more than a gigabyte says so first."""
    scenario = load("eavesdroppers", {"trials": 100_000, "record_trials": 100_000})
    assert any("GB" in warning for warning in warnings_of(scenario))


def test_the_last_trial_has_a_number_that_a_shard_may_begin_with() -> None:
    """A shard is a run whose first trial is one of these."""
    last = 2**48
    assert load("vehicle", {"trials": 4, "shards": 4, "first_trial": last - 3}).first_trial == last - 3
    with pytest.raises(
        ScenarioError, match=f"first_trial: is {last - 2}, and the last trial {last + 1}; expected at most"
    ):
        load("vehicle", {"trials": 4, "shards": 4, "first_trial": last - 2})


@pytest.mark.parametrize(
    ("dotted", "message"),
    [
        ("a..b", "empty part"),
        ("", "empty part"),
        ("title.x", "x is not in a table or list"),
        ("process.A.7.0", "7 is not an entry of a list of 2; give 0 to 2"),
        ("process.A.x", "x is not an entry of a list of 2"),
    ],
)
def test_a_dotted_key_that_leads_nowhere_is_refused(dotted: str, message: str) -> None:
    """--set says which part of a key is wrong."""
    with pytest.raises(UsageError, match=message):
        parse(tomli_w.dumps(GOOD), "scenario", {dotted: 1})


def test_any_entry_can_be_set() -> None:
    """Entries of tables, of new eavesdroppers, of matrices and of lists, the next entry of a list included."""
    changes = {
        "slots": 7,
        "process.A.0.1": 0.25,
        "eavesdroppers.extra.strategy": "suspicious",
        "eavesdroppers.extra.use_state": 0.5,
        "eavesdroppers.extra.use_innovation": 0.25,
        "eavesdroppers.extra.link.quality": 0.5,
        "expect.0.metric": "extra.used_fraction",
        "expect.0.below": 0.5,
        "expect.1.metric": "legitimate.received_fraction",
        "expect.1.above": 0.25,
    }
    scenario = parse(tomli_w.dumps(GOOD), "scenario", changes)
    assert scenario.process.A[0] == [1.0, 0.25]
    assert scenario.receivers == ("legitimate", "smart", "extra")
    assert scenario.eavesdroppers["extra"].parameters == {"use_state": 0.5, "use_innovation": 0.25}
    assert [expect.text for expect in scenario.expect] == [
        "extra.used_fraction below 0.5",
        "legitimate.received_fraction above 0.25",
    ]


def test_a_quality_replaces_a_loss_only_in_a_link() -> None:
    """At first and where an event changes it; eavesdroppers may have these names."""
    eve = GOOD["eavesdroppers"]["smart"]
    tables = {**GOOD, "eavesdroppers": {"loss": eve, "quality": eve}}
    tables["event"] = [{"at": 5, "link": "loss", "set": {"quality": 0.5}}]
    loss = {"model": "pattern", "outcomes": "10"}
    changes = {"eavesdroppers.quality.link.loss": loss, "event.0.set.loss": loss, "eavesdroppers.loss.window": 2}
    scenario = parse(tomli_w.dumps(tables), "scenario", changes)
    assert scenario.receivers == ("legitimate", "loss", "quality")
    assert scenario.eavesdroppers["quality"].pool.loss == loss
    assert scenario.timeline.changes["loss"][0].settings == {"loss": loss}


@given(st.one_of(st.integers(), st.booleans(), st.floats(allow_nan=False), st.lists(st.integers()), st.text("abc d")))
def test_values_on_the_command_line_are_toml_or_text(value: Any) -> None:
    """A value that is TOML is read as such, everything else as a string."""
    text = value if isinstance(value, str) else tomli_w.dumps({"v": value}).removeprefix("v = ").strip()
    assert value_of(text) == value


@pytest.mark.parametrize("name", sorted(shipped()))
def test_the_resolved_scenario_is_the_same_scenario(name: str, tmp_path: Path) -> None:
    """The scenario in a results folder reads back as the one that was run, with the versions next to it."""
    scenario = load(name, {"slots": 600} if name.startswith("microgrid") else None)
    write_resolved(tmp_path, scenario)
    text = (tmp_path / "scenario.toml").read_text(encoding="utf-8")
    again = parse(text, "resolved", folder=tmp_path)
    assert again.model_dump() == scenario.model_dump()
    assert set(tomllib.loads(text)["made_with"]) >= {"python", "evedrop", "numpy"}


def test_a_new_scenario_is_commented_and_has_no_mistake(tmp_path: Path) -> None:
    """`evedrop new` writes a scenario with every entry explained, and never over a file."""
    file = tmp_path / "mine.toml"
    write_new(file)
    load(file)
    text = file.read_text()
    for entry in set(Scenario.model_fields) - {"made_with"}:
        assert entry in text, entry
    with pytest.raises(UsageError, match="exists already"):
        write_new(file)
    with pytest.raises(UsageError, match="cannot be written"):
        write_new(tmp_path / "no" / "folder.toml")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("eavesdroper", "did you mean eavesdroppers"),
        ("nothing.toml", "`evedrop list`"),
        (".", "without a scenario.toml"),
    ],
)
def test_a_scenario_that_is_not_there_is_named(tmp_path: Path, source: str, message: str) -> None:
    """A wrong name, a wrong file and a wrong folder each say what to give."""
    with pytest.raises(UsageError, match=message):
        load(tmp_path if source == "." else source)


def test_what_is_no_toml_is_said_with_its_place(tmp_path: Path) -> None:
    """A slip of the pen is told with line and column, and bytes that are not text are reported as such."""
    file = tmp_path / "slip.toml"
    file.write_text("title = 'x'\nslots = = 3\n")
    with pytest.raises(ScenarioError, match="line 2"):
        load(file)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="UTF-8"):
        load(file)


def test_a_change_within_another_one_leaves_that_as_it_was_given() -> None:
    """A study makes the same changes for many scenarios."""
    link: dict[str, Any] = {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.5}}
    load("vehicle", {"legitimate.link": link, "legitimate.link.loss.p": 0.2})
    assert link == {"loss": {"model": "gilbert-elliott", "p": 0.1, "r": 0.5}}

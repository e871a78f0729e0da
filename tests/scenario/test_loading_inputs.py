"""Files, values and names that no run can use: each is refused by name, soon, and before much of it is read."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evedrop.errors import EvedropError, UsageError
from evedrop.model.process import MOST_STATES, Process
from evedrop.model.theory.horizon import horizon
from evedrop.results.folder import claimed, default_folder
from evedrop.scenario.loading import load, parse
from evedrop.system.files import Unreadable
from tests.builders import BASE, mistakes_of
from tests.conftest import Evedrop
from tests.scenario.test_input_files import measured

POOLED = """
[eavesdroppers.pool]
strategy = "colluding"
reads_as = "smart"
links = [{ quality = 0.5 }, { quality = 0.4 }]
"""


def event(changes: str, link: str = "legitimate", at: int = 3) -> str:
    """An event that changes a link."""
    return f'[[event]]\nat = {at}\nlink = "{link}"\nset = {changes}\n'


def test_all_mistyped_models_of_events_are_told_at_once() -> None:
    """Each with path, what was found, what was expected and an example; none ends in a traceback."""
    text = BASE + "".join(
        [
            event('{ loss = { model = "bernouli", quality = 0.3 } }'),
            event('{ delay = { model = "konstant", value = 0.3 } }'),
            event("{ loss = { quality = 0.3 } }"),
            event('{ loss = 3, delay = "x" }'),
            event('{ loss = { model = "pooled", links = [{}] } }'),
            event('{ loss = { model = "mine:Own" } }'),
        ]
    )
    told = "\n".join(mistakes_of(parse, text, "scenario.toml"))
    for message in (
        'event.0.set.loss.model: is "bernouli"; expected bernoulli, distance, gilbert-elliott, markov, pattern or trace; did you',
        'event.1.set.delay.model: is "konstant"; expected constant, normal, pareto or trace; did you mean constant?',
        'event.2.set.loss.model: is missing; expected model = "bernoulli", or another',
        'event.3.set.loss: is 3; expected a table, such as { model = "gilbert-elliott", p = 0.05, r = 0.5 }',
        'event.3.set.delay: is "x"; expected a table, such as { model = "constant", value = 2.0 }',
        'event.4.set.loss.model: is "pooled"; expected bernoulli',
        'event.5.set.loss.model: is "mine:Own", and the module mine cannot be imported',
    ):
        assert message in told


def test_a_change_replaces_the_other_form_of_a_links_losses() -> None:
    """A quality a loss model, a loss model a quality, and a part of a loss model a quality; not both in one file."""
    changed = load("bursts", {"legitimate.link.quality": 0.8})
    assert changed.legitimate.link.loss_spec == {"model": "bernoulli", "quality": 0.8}
    model = {"model": "gilbert-elliott", "p": 0.1, "r": 0.5}
    assert load("vehicle", {"legitimate.link.loss": model}).legitimate.link.loss_spec == model
    parts = {f"legitimate.link.loss.{name}": value for name, value in model.items()}
    assert load("vehicle", parts).legitimate.link.loss_spec == model


def test_an_event_on_pooled_links_is_looked_at_too() -> None:
    """It puts one link in place of them all, which needs a quality or a loss model; both are checked."""
    text = BASE + POOLED + event("{ corrupt = 0.1 }", "pool") + event('{ loss = { model = "nope" } }', "pool", 5)
    mistakes = mistakes_of(parse, text, "scenario.toml")
    assert (
        mistakes[0].partition(" (line")[0]
        == "event.0.set: pool has several links; expected a quality or a loss, for the one link that replaces them"
    )
    assert mistakes[1].startswith('event.1.set.loss.model: is "nope"; expected bernoulli')
    assert parse(BASE + POOLED + event("{ quality = 0.1 }", "pool"), "scenario.toml").slots == 50


def square(n: int, value: str) -> str:
    """A matrix of n rows with one value along its diagonal, as TOML."""
    return str([[float(value) if i == j else 0.0 for j in range(n)] for i in range(n)])


def large(n: int, link: str = "{ quality = 0.9 }", more: str = "", slots: int = 100) -> str:
    """A scenario of n states."""
    return (
        f'title = "large"\nslots = {slots}\n[process]\nA = {square(n, "1.0")}\nQ = {square(n, "1e-3")}\n'
        f'initial_covariance = {square(n, "1.0")}\n[encoding]\nscheme = "innovation"\nstate_probability = 0.5\n'
        f"[legitimate]\nlink = {link}\n{more}"
    )


@pytest.mark.parametrize("n", [MOST_STATES + 1, 700])
def test_more_states_than_can_be_worked_out_are_refused_at_once(n: int, tmp_path: Path) -> None:
    """With the limit and the reason, in seconds, and in little memory."""
    (tmp_path / "large.toml").write_text(large(n))
    err, peak, seconds = measured(tmp_path, "check", "large.toml")
    values = (
        "has about 1469997 values; expected at most 1000000: put disturbances and recordings into files of their own"
    )
    assert (
        values if n == 700 else f"process.A: has {n} rows; expected at most 64 states: theory and check take"
    ) in err
    assert peak < 300
    assert seconds < 20


@pytest.mark.parametrize(
    ("text", "warning"),
    [
        (large(MOST_STATES), ""),
        (large(MOST_STATES, slots=100_000_000), "GB of results"),
        (large(24, '{ loss = { model = "gilbert-elliott", p = 0.1, r = 0.5 } }'), ""),
        (
            large(2, more="[acknowledgements]\nlink = { quality = 0.9 }\n").replace(
                '"innovation"\nstate_probability = 0.5', '"scheduled"\nthreshold = 1000000'
            ),
            "",
        ),
    ],
    ids=["states", "slots", "operator", "threshold"],
)
def test_the_largest_that_is_accepted_is_checked_soon(text: str, warning: str, evedrop: Evedrop) -> None:
    """Theory that would need gigabytes or minutes is not computed."""
    (evedrop.folder / "large.toml").write_text(text)
    started = time.process_time()
    done = evedrop("check", "large.toml")
    assert (done.status, done.err) == (0, "")
    assert warning in done.out
    assert time.process_time() - started < 20


@pytest.mark.parametrize(("n", "radius"), [(1, 1.0001), (2, 1.00002), (3, 1.01)])
def test_the_horizon_is_the_same_slot_by_slot_and_in_halves(n: int, radius: float) -> None:
    """Few slots are looked at each, or all: the last one that float64 can follow is the same."""
    A = np.random.default_rng(n).normal(size=(n, n))
    process = Process(A * radius / np.abs(np.linalg.eigvals(A)).max(), 1e-3 * np.eye(n), np.eye(n))
    halves = []
    for each in (2**12, 2**26):
        halves.append(horizon(process, 10_000_000, each))
    assert halves[0] is not None
    assert halves[0] == pytest.approx(halves[1], rel=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (".".join("a" * 10_000) + " = 1\n" + BASE, "line 1 has a key of 32 or more parts"),
        ("a = " + "[" * 100_000 + "\n", "not TOML"),
        (f"a = {'[' * 20}{']' * 20}\n" + BASE, "is more than 16 tables deep"),
        (f"seed = 0x{'f' * 2000}\n" + BASE, "seed: is a whole number of 8000 bits; expected at most 4096"),
        (f"seed = {'9' * 5000}\n" + BASE, "not TOML"),
        (BASE.replace("Refused", "\\u001b[31mred"), "title: is \"\\u001b[31mred\" with the character U+001B in it"),
        (BASE.replace("Refused", "\\u0085"), "with the character U+0085 in it"),
        ('"a\\u001bb" = 1\n' + BASE, "a?b: is a name with a control character, or of more than 200 characters"),
        (BASE.replace("Refused", "x" * 1000), "title: has more than 200 characters; expected at most that many"),
        (BASE.replace("slots = 50", "slots = 1000000000000000000"), "slots: is 1000000000000000000; expected a number at most"),
        ("trials = 1000000000000\n" + BASE, "trials: is 1000000000000; expected a number at most 1000000"),
        ("trials = true\n" + BASE, "trials: is true; expected a whole number"),
        (BASE + "[plant]\ninputs = [[1]]\n", "plant.inputs.0: is [1]; expected a string"),
        (BASE + f"[plant]\ninputs = {['u'] * 50_000}\n", "plant.inputs: has 50000 names; expected at most 64"),
        ("".join(f"[eavesdroppers.e{i}]\n" for i in range(2000)) + BASE, "has 2,000 entries; expected at most 64"),
    ],
    ids=lambda case: "" if len(case) > 60 else case,
)  # fmt: skip
def test_what_no_entry_can_be_is_refused(text: str, message: str) -> None:
    """Numbers, names, texts and tables beyond all bounds; each in a line of some length."""
    mistakes = mistakes_of(parse, text, "scenario.toml")
    assert any(message in mistake for mistake in mistakes), mistakes
    assert all(len(mistake) < 1000 for mistake in mistakes)
    assert len(mistakes) < 200


@pytest.mark.parametrize(
    "change",
    [
        "a" * 500 + "=1",
        ".".join("a" * 5000) + "=1",
        "title=\x1b[31m",
        "slots=0x" + "f" * 5000,
        "a..b=1",
        "process.A.-1=3",
    ],
)
def test_changes_are_held_against_the_same_bounds(change: str, evedrop: Evedrop) -> None:
    """Values of --set are refused as those of a file are."""
    done = evedrop("check", "eavesdroppers", "--set", change)
    assert done.status == 2
    assert "Traceback" not in done.err
    assert len(done.err) < 2000
    assert "\x1b" not in done.err


@pytest.mark.parametrize("option", ["--seed", "--slots", "--trials", "--first-trial", "--record-trials"])
@pytest.mark.parametrize("value", ["-1", "1" + "0" * 80, "nan", "1e3", ""])
def test_options_out_of_range_are_refused(option: str, value: str, evedrop: Evedrop) -> None:
    """With status 2, in some words, and without a results folder."""
    done = evedrop("montecarlo", "eavesdroppers", f"{option}={value}")
    assert done.status == 2
    assert "Traceback" not in done.err
    assert not (evedrop.folder / "runs").exists()


@pytest.mark.thorough
def test_names_that_are_not_utf_8_are_refused(evedrop: Evedrop) -> None:
    """As a results folder, as a scenario and as the current folder: no result and no message could repeat them."""
    odd = os.fsdecode(b"out-\xff")
    for arguments in (("montecarlo", "eavesdroppers", "--out", odd), ("check", odd), ("diff", odd, odd)):
        done = evedrop(*arguments)
        assert done.status == 2
        assert "out-\\xff: it is not named in UTF-8, as results and messages are; use another name" in done.err
    assert not (evedrop.folder / odd).exists()
    (evedrop.folder / odd).mkdir()
    done = evedrop.process("check", "eavesdroppers", cwd=evedrop.folder / odd)
    assert done.status == 2
    assert "the current folder is not named in UTF-8" in done.err


def test_two_runs_of_one_second_have_a_folder_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one gets a number; neither finds the other's folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda _: "20250101-000000")
    folders = [claimed(default_folder("vehicle")) for _ in range(3)]
    assert [str(folder) for folder in folders] == [f"runs/vehicle-20250101-000000{end}" for end in ("", "-2", "-3")]
    assert all(folder.is_dir() and folder.stat().st_mode & 0o777 == 0o700 for folder in folders)


def test_a_command_that_fails_leaves_no_empty_folder(evedrop: Evedrop) -> None:
    """The folder that is made for its results is removed again, where nothing came to be in it."""
    done = evedrop("montecarlo", "eavesdroppers", "--slots=20", "--trials=2", "--workers=0")
    assert done.status == 2
    assert not (evedrop.folder / "runs").exists()
    (evedrop.folder / "here").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        claimed(evedrop.folder / "here" / "run")


def test_every_refusal_is_of_the_tree() -> None:
    """An unreadable file raises none of our errors by itself: the caller says what the file is."""
    assert not issubclass(Unreadable, EvedropError)
    checks: list[Callable[[], object]] = [lambda: load("\x00"), lambda: load("a" * 5000), lambda: load("/dev/null/x")]
    for check in checks:
        with pytest.raises(UsageError):
            check()

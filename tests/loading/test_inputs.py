"""Files, values and names that no run can use: each is refused by name, soon, and before much of it is read."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evedrop.errors import EvedropError, ScenarioError, UsageError
from evedrop.files import Limit, Unreadable, contents, lines_of
from evedrop.loading import load, parse
from evedrop.model.process import MOST_STATES, Process
from evedrop.model.theory.horizon import horizon
from evedrop.results.folder import claimed, default_folder
from tests.conftest import Evedrop

BASE = """
title = "Refused"
slots = 50
[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]
[encoding]
scheme = "innovation"
state_probability = 0.5
[legitimate]
link = { quality = 0.9 }
"""
POOLED = """
[eavesdroppers.pool]
strategy = "colluding"
reads_as = "smart"
links = [{ quality = 0.5 }, { quality = 0.4 }]
"""
PLANT = """
[plant]
disturbances = ["P_load"]
disturbance_matrix = [[1.0], [0.0]]
disturbance_file = "{file}"
"""
MEGABYTES = 2**20


def mistakes(text: str, folder: Path = Path()) -> list[str]:
    """What is said of a scenario."""
    with pytest.raises(ScenarioError) as caught:
        parse(text, "scenario.toml", folder=folder)
    assert caught.value.exit_status == 2
    return caught.value.mistakes


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
    found = "\n".join(mistakes(text))
    for said in (
        'event.0.set.loss.model: is "bernouli"; expected bernoulli, distance, gilbert-elliott, markov, pattern or trace; did you',
        'event.1.set.delay.model: is "konstant"; expected constant, normal, pareto or trace; did you mean constant?',
        'event.2.set.loss.model: is missing; expected model = "bernoulli", or another',
        'event.3.set.loss: is 3; expected a table, such as { model = "gilbert-elliott", p = 0.05, r = 0.5 }',
        'event.3.set.delay: is "x"; expected a table, such as { model = "constant", value = 2.0 }',
        'event.4.set.loss.model: is "pooled"; expected bernoulli',
        'event.5.set.loss.model: is "mine:Own", and the module mine cannot be imported',
    ):
        assert said in found


def test_an_event_on_pooled_links_is_looked_at_too() -> None:
    """It puts one link in place of them all, which needs a quality or a loss model; both are checked."""
    text = BASE + POOLED + event("{ corrupt = 0.1 }", "pool") + event('{ loss = { model = "nope" } }', "pool", 5)
    found = mistakes(text)
    assert (
        found[0]
        == "event.0.set: pool has several links; expected a quality or a loss, for the one link that replaces them"
    )
    assert found[1].startswith('event.1.set.loss.model: is "nope"; expected bernoulli')
    assert parse(BASE + POOLED + event("{ quality = 0.1 }", "pool"), "scenario.toml").slots == 50


def test_a_results_folder_whose_scenario_is_not_text_is_refused(evedrop: Evedrop) -> None:
    """In one line that names the file, the byte and what a scenario is."""
    (evedrop.folder / "run").mkdir()
    (evedrop.folder / "run" / "scenario.toml").write_bytes(b'title = "\xff"')
    done = evedrop("check", "run")
    assert done.status == 2
    assert done.err == (
        "run/scenario.toml cannot be read (it is not text in UTF-8: invalid start byte at byte 9); a scenario is a TOML file\n"
    )


def special(folder: Path, kind: str) -> Path:
    """A path that is no file to be read."""
    path = folder / f"{kind}.csv"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "long":
        return folder / ("a" * 300)
    return path


SPECIAL = {
    "folder": "it is a folder",
    "pipe": "it is a pipe or a device, not a file",
    "loop": "Too many levels of symbolic links",
    "device": "it is a pipe or a device, not a file",
    "long": "File name too long",
    "nothing": "No such file or directory",
}


@pytest.mark.parametrize("kind", SPECIAL)
def test_what_is_no_file_is_read_nowhere(kind: str, tmp_path: Path) -> None:
    """Disturbances, recordings, delays and secrets, and a scenario itself: refused at once, with the reason."""
    path = special(tmp_path, kind)
    trace = f'{{ model = "trace", file = "{path}" }}'
    trace = f"[legitimate]\nlink = {{ loss = {trace}, delay = {trace} }}"
    text = f'secret_file = "{path}"\n' + BASE.replace("[legitimate]\nlink = { quality = 0.9 }", trace)
    found = mistakes(text + PLANT.format(file=path))
    for entry in ("secret_file", "legitimate.link.loss.file", "legitimate.link.delay.file", "plant.disturbance_file"):
        assert any(one.startswith(f"{entry}: ") and f"cannot be read ({SPECIAL[kind]})" in one for one in found), entry
    if kind not in ("folder", "nothing", "long"):
        with pytest.raises(UsageError, match=r"cannot be read \(.*\); a scenario is a TOML file"):
            load(path)


def test_a_path_with_a_zero_byte_is_refused() -> None:
    """TOML can write one; no file has it."""
    (mistake,) = mistakes('secret_file = "a\\u0000b"\n' + BASE)
    assert (
        mistake
        == 'secret_file: is "a\\u0000b" with the character U+0000 in it; expected text without control characters'
    )


def bomb(path: Path, size: int, block: bytes) -> Path:
    """A gz file that stands for so many bytes of a block again and again."""
    with gzip.open(path, "wb", compresslevel=1) as file:
        for part in chain([b"P_load [kW]\n"], repeat(block, size // len(block))):
            file.write(part)
    return path


CHECKED = """
import resource, sys
from evedrop.cli.main import main
resource.setrlimit(resource.RLIMIT_AS, (1_500_000_000, 1_500_000_000))
status = main(sys.argv[1:])
# Not ru_maxrss: that begins with what the process had that started this one.
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(peak, resource.getrusage(resource.RUSAGE_SELF).ru_utime)
raise SystemExit(status)
"""


def measured(folder: Path, *arguments: str) -> tuple[str, float, float]:
    """What a command says on standard error that ends with status 2, its peak of memory in MB, and its seconds of processor."""
    done = subprocess.run(
        [sys.executable, "-c", CHECKED, *arguments], capture_output=True, text=True, cwd=folder, check=False
    )
    assert done.returncode == 2, done.stderr
    peak, seconds = map(float, done.stdout.split()[-2:])
    return done.stderr, peak / 1024, seconds


@pytest.mark.parametrize(
    ("block", "said"),
    [
        (b"0" * MEGABYTES, "line 2 has more than 65536 characters"),
        (b"\n" * MEGABYTES, "it has more than 10100 lines, comments and empty lines included"),
        (
            (b"# " + b"x" * 60_000 + b"\n") * 16,
            "it has more than 16828416 characters, comments and empty lines included",
        ),
    ],
    ids=["one line", "empty lines", "comments"],
)
def test_a_compressed_file_is_read_no_further_than_it_can_be_used(block: bytes, said: str, tmp_path: Path) -> None:
    """A gz bomb of 64 MB is refused in little memory and time, with its name and the limit."""
    bomb(tmp_path / "day.csv.gz", 64 * MEGABYTES, block)
    (tmp_path / "bomb.toml").write_text(BASE + PLANT.format(file="day.csv.gz"))
    err, peak, seconds = measured(tmp_path, "check", "bomb.toml")
    assert f"plant.disturbance_file: day.csv.gz cannot be read ({said})" in err
    assert peak < 300
    assert seconds < 20


def test_rows_beyond_the_last_slot_are_not_read(tmp_path: Path) -> None:
    """A day in which the run's hour is: what comes after its last slot may be anything."""
    rows = "".join("0.5\n" for _ in range(50))
    with gzip.open(tmp_path / "day.csv.gz", "wt") as file:
        file.write(f"P_load\n{rows}" + "no number\n" + "x" * 200_000)
    scenario = parse(BASE + PLANT.format(file="day.csv.gz"), "scenario.toml", folder=tmp_path)
    assert scenario.plant is not None
    assert scenario.plant.disturbance_values == [[0.5]] * 50


def test_a_damaged_gz_file_is_refused(tmp_path: Path) -> None:
    """Cut short, or with bytes that decompress to nothing."""
    whole = gzip.compress(b"P_load\n" + b"0.5\n" * 100_000)
    for damaged in (whole[:-20], whole[:200], whole[:30] + b"\xff" * 60 + whole[90:], b"\x1f\x8b\x08"):
        (tmp_path / "day.csv.gz").write_bytes(damaged)
        found = mistakes(BASE.replace("slots = 50", "slots = 100000") + PLANT.format(file="day.csv.gz"), tmp_path)
        assert any("day.csv.gz cannot be read (" in one for one in found)


def test_a_parquet_recording_of_one_long_text_is_refused(tmp_path: Path) -> None:
    """A text of a megabyte in each of 100 000 rows is kept once, not 100 000 times."""
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(100_000, np.int32)), pa.array(["x" * MEGABYTES]))
    pq.write_table(pa.table({"received": texts}), tmp_path / "walk.parquet")
    trace = BASE.replace("{ quality = 0.9 }", '{ loss = { model = "trace", file = "walk.parquet" } }')
    (tmp_path / "long.toml").write_text(trace)
    err, peak, _ = measured(tmp_path, "check", "long.toml")
    assert 'walk.parquet row 1 is "xxxx' in err
    assert peak < 700


def test_lines_end_with_the_limit(tmp_path: Path) -> None:
    """A file of just so many lines is read, and one more line is too many."""
    path = tmp_path / "table.csv"
    path.write_text("a\n" * 10)
    assert list(lines_of(path, Limit(10, 20))) == ["a\n"] * 10
    for limit, said in ((Limit(9, 20), "more than 9 lines"), (Limit(10, 19), "more than 19 characters")):
        with pytest.raises(Unreadable, match=said):
            list(lines_of(path, limit))
    assert contents(path, 20) == b"a\n" * 10
    with pytest.raises(Unreadable, match="more than 19 bytes"):
        contents(path, 19)


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
    """What theory would need gigabytes or minutes for is not worked out."""
    (evedrop.folder / "large.toml").write_text(text)
    started = time.process_time()
    done = evedrop("check", "large.toml")
    assert (done.status, done.err) == (0, "")
    assert warning in done.out
    assert time.process_time() - started < 20


@pytest.mark.parametrize(("n", "radius"), [(1, 1.0001), (2, 1.00002), (3, 1.01)])
def test_the_horizon_is_the_same_slot_by_slot_and_in_halves(
    n: int, radius: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few slots are looked at each, or all: the last one that float64 can follow is the same."""
    A = np.random.default_rng(n).normal(size=(n, n))
    process = Process(A * radius / np.abs(np.linalg.eigvals(A)).max(), 1e-3 * np.eye(n), np.eye(n))
    halves = []
    for each in (2**12, 2**26):
        monkeypatch.setattr("evedrop.model.theory.horizon._EACH", each)
        halves.append(horizon(process, 10_000_000))
    assert halves[0] is not None
    assert halves[0] == pytest.approx(halves[1], rel=1e-5)


@pytest.mark.parametrize(
    ("text", "said"),
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
        ("".join(f"[eavesdroppers.e{i}]\n" for i in range(2000)) + BASE, "has 2000 entries; expected at most 64"),
    ],
    ids=lambda one: "" if len(one) > 60 else one,
)  # fmt: skip
def test_what_no_entry_can_be_is_refused(text: str, said: str) -> None:
    """Numbers, names, texts and tables beyond all bounds; each in a line of some length."""
    found = mistakes(text)
    assert any(said in one for one in found), found
    assert all(len(one) < 1000 for one in found)
    assert len(found) < 200


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
    """What --set is given is refused as what a file says."""
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
    found = [claimed(default_folder("vehicle")) for _ in range(3)]
    assert [str(one) for one in found] == [f"runs/vehicle-20250101-000000{end}" for end in ("", "-2", "-3")]
    assert all(one.is_dir() and one.stat().st_mode & 0o777 == 0o700 for one in found)


def test_a_command_that_fails_leaves_no_empty_folder(evedrop: Evedrop) -> None:
    """The folder that is made for its results is removed again, where nothing came to be in it."""
    done = evedrop("montecarlo", "eavesdroppers", "--slots=20", "--trials=2", "--workers=0")
    assert done.status == 2
    assert not (evedrop.folder / "runs").exists()
    (evedrop.folder / "here").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        claimed(evedrop.folder / "here" / "run")


def test_every_refusal_is_of_the_tree() -> None:
    """What cannot be read is no error of ours by itself: who asks for a file says what it is."""
    assert not issubclass(Unreadable, EvedropError)
    checks: list[Callable[[], object]] = [lambda: load("\x00"), lambda: load("a" * 5000), lambda: load("/dev/null/x")]
    for check in checks:
        with pytest.raises(UsageError):
            check()

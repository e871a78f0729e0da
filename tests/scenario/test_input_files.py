"""Files that a scenario names: one that is not a file, too large, damaged or not text is refused."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evedrop.errors import UsageError
from evedrop.model.links.trace import Pattern
from evedrop.scenario.input_files import read_recordings
from evedrop.scenario.loading import load, parse
from evedrop.system.files import Limit, Unreadable, contents, lines_of
from tests.builders import BASE, mistakes_of
from tests.conftest import Evedrop

PLANT = """
[plant]
disturbances = ["P_load"]
disturbance_matrix = [[1.0], [0.0]]
disturbance_file = "{file}"
"""
MEGABYTES = 2**20


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
    """A path that is not a file to be read."""
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
    lines = mistakes_of(parse, text + PLANT.format(file=path), "scenario.toml")
    for entry in ("secret_file", "legitimate.link.loss.file", "legitimate.link.delay.file", "plant.disturbance_file"):
        assert any(line.startswith(f"{entry}: ") and f"cannot be read ({SPECIAL[kind]})" in line for line in lines), (
            entry
        )
    if kind not in ("folder", "nothing", "long"):
        with pytest.raises(UsageError, match=r"cannot be read \(.*\); a scenario is a TOML file"):
            load(path)


def test_a_path_with_a_zero_byte_is_refused() -> None:
    """TOML can write one; no file has it."""
    (mistake,) = mistakes_of(parse, 'secret_file = "a\\u0000b"\n' + BASE, "scenario.toml")
    assert (
        mistake
        == 'secret_file: is "a\\u0000b" with the character U+0000 in it; expected text without control characters'
    )


def bomb(path: Path, size: int, block: bytes) -> Path:
    """A gz file that expands to this number of bytes, a block repeated."""
    with gzip.open(path, "wb", compresslevel=1) as file:
        for part in chain([b"P_load [kW]\n"], repeat(block, size // len(block))):
            file.write(part)
    return path


CHECKED = """
import resource, sys
from evedrop.cli.main import main
# Addresses, not memory: threads of libraries reserve 1.4 GB of them before anything is read. It only ends what grows without end.
resource.setrlimit(resource.RLIMIT_AS, (6_000_000_000, 6_000_000_000))
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
    ("block", "message"),
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
def test_a_compressed_file_is_read_no_further_than_it_can_be_used(block: bytes, message: str, tmp_path: Path) -> None:
    """A gz bomb of 64 MB is refused in little memory and time, with its name and the limit."""
    bomb(tmp_path / "day.csv.gz", 64 * MEGABYTES, block)
    (tmp_path / "bomb.toml").write_text(BASE + PLANT.format(file="day.csv.gz"))
    err, peak, seconds = measured(tmp_path, "check", "bomb.toml")
    assert f"plant.disturbance_file: day.csv.gz cannot be read ({message})" in err
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


@pytest.mark.thorough
def test_a_damaged_gz_file_is_refused(tmp_path: Path) -> None:
    """Cut short, or with bytes that decompress to nothing."""
    whole = gzip.compress(b"P_load\n" + b"0.5\n" * 100_000)
    for damaged in (whole[:-20], whole[:200], whole[:30] + b"\xff" * 60 + whole[90:], b"\x1f\x8b\x08"):
        (tmp_path / "day.csv.gz").write_bytes(damaged)
        mistakes = mistakes_of(
            parse,
            BASE.replace("slots = 50", "slots = 100000") + PLANT.format(file="day.csv.gz"),
            "scenario.toml",
            folder=tmp_path,
        )
        assert any("day.csv.gz cannot be read (" in mistake for mistake in mistakes)


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
    """A file with exactly the largest number of lines is read, and one more line is too many."""
    path = tmp_path / "table.csv"
    path.write_text("a\n" * 10)
    assert list(lines_of(path, Limit(10, 20))) == ["a\n"] * 10
    for limit, message in ((Limit(9, 20), "more than 9 lines"), (Limit(10, 19), "more than 19 characters")):
        with pytest.raises(Unreadable, match=message):
            list(lines_of(path, limit))
    assert contents(path, 20) == b"a\n" * 10
    with pytest.raises(Unreadable, match="more than 19 bytes"):
        contents(path, 19)


def test_a_model_whose_class_says_so_reads_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Into the parameter that the class names, by whatever name a scenario calls the model; other models keep their entries."""
    recording = tmp_path / "walk.csv"
    recording.write_text("received\n1\n0\n1\n")
    loss = {"model": "pattern", "file": str(recording)}
    assert (read_recordings({"loss": loss}), list(loss)) == ([], ["model", "file"])
    monkeypatch.setattr(Pattern, "recorded", "outcomes")
    assert (read_recordings({"loss": loss}), loss) == ([], {"model": "pattern", "outcomes": "101"})


def test_a_secret_that_a_change_names_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the current folder; the scenario that is written can be read elsewhere."""
    (tmp_path / "secret").write_bytes(bytes(range(64)))
    monkeypatch.chdir(tmp_path)
    text = parse(BASE, "scenario.toml", {"secret_file": "secret"}).to_toml()
    monkeypatch.chdir("/")
    assert parse(text, "again").secret_file == str(tmp_path / "secret")


@pytest.mark.parametrize(("rows", "columns"), [(50_000, 64), (1_000_000, 10), (1, 1)])
def test_there_is_room_for_all_numbers_of_a_table(rows: int, columns: int) -> None:
    """Written in full, with a comma and a space."""
    longest = len(f"{-(2.0**-1000) / 3.0!r}, ")
    assert Limit.of_rows(rows, columns).characters > rows * columns * longest

"""Results are for the user who started the run: a folder 0700, a file 0600, at every moment and whatever the umask is."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import UsageError
from evedrop.results.folder import claimed, default_folder, new_folder, private_file
from evedrop.results.resolved_scenario import resolved
from evedrop.scenario.loading import load
from evedrop.show.view.scene_slots import replay
from tests.conftest import Evedrop, Live, wait_until

OPEN: dict[str, Any] = {"umask": 0o000}
"""Options of a process whose files are for everybody, unless it says otherwise."""
LOOK = """
import os, sys
os.setgroups([])
os.setgid(65534)
os.setuid(65534)
for place in sys.argv[1:]:
    try:
        print(os.listdir(place) if os.path.isdir(place) else open(place, "rb").read(1))
    except OSError as error:
        print(error.strerror)
"""
"""What another user of the host gets of some places: a line each."""


def open_to_others(folder: Path) -> dict[str, str]:
    """Everything in a folder, itself included, whose mode is not the one for a single user: path → mode."""
    modes = {}
    for path in (folder, *folder.rglob("*")):
        try:
            mode = path.lstat().st_mode
        except FileNotFoundError:  # renamed meanwhile, and looked at under its new name another time
            continue
        wanted = 0o700 if stat.S_ISDIR(mode) else 0o600
        if stat.S_IMODE(mode) != wanted:
            modes[str(path.relative_to(folder))] = oct(stat.S_IMODE(mode))
    return modes


def watched(live: Live, top: Path) -> list[dict[str, str]]:
    """The files that were ever open to others while a command ran, from its first file on; it must end well."""
    seen = []
    while live.process.poll() is None:
        if top.exists() and (bad := open_to_others(top)):
            seen.append(bad)
        time.sleep(0.05)  # leave the command a processor
    assert live.end().status == 0
    assert live.folder.is_dir()
    return [*seen, *([bad] if (bad := open_to_others(top)) else [])]


@pytest.mark.thorough
def test_a_run_under_way_and_its_results_are_private(evedrop: Evedrop) -> None:
    """Nothing of a live run is open to others before slot 0, while it runs, and at its end; the view's recording included."""
    live = evedrop.started(
        "run", "vehicle", "--slots", "150", "--pace", "0.002", "--view", "web", out="new/run", **OPEN
    )
    assert watched(live, evedrop.folder / "new") == []
    assert {"scenario.toml", "recording.rrd", "summary.json", "logs", "slots.parquet"} <= set(os.listdir(live.folder))


@pytest.mark.long
def test_a_run_in_shards_is_private(evedrop: Evedrop) -> None:
    """The folders and logs of shards, and what is made one of them, are for their user alone at any moment."""
    changes = ("--trials", "4", "--slots", "60", "--pace", "0", "--set", "shards=2")
    live = evedrop.live("two-eavesdroppers", *changes, **OPEN)
    assert watched(live, live.folder) == []


@pytest.fixture
def open_umask() -> Iterator[None]:
    """Files of this process are for everybody, unless it says otherwise."""
    before = os.umask(0o000)
    yield
    os.umask(before)


@pytest.mark.usefixtures("open_umask")
@pytest.mark.parametrize(
    "command",
    [
        ("montecarlo", "vehicle", "--trials", "2", "--slots", "40", "--workers", "1"),
        (
            "sweep",
            "vehicle",
            "--trials",
            "1",
            "--slots",
            "9",
            "--over",
            "legitimate.link.quality=0.9",
            "--workers",
            "1",
        ),
        ("compare", "vehicle", "--trials", "1", "--slots", "9", "--schemes", "plain", "--adversaries", "naive"),
        ("test", "one.toml", "--in-memory", "--trials", "2"),
    ],
    ids=lambda command: command[0],
)
def test_a_study_is_private(evedrop: Evedrop, command: tuple[str, ...]) -> None:
    """A study's tables, scenarios and pictures are for their user alone, and so are the folders that were made for them."""
    (evedrop.folder / "one.toml").write_text(resolved(load("vehicle", {"slots": 9})), encoding="utf-8")
    done = evedrop(*command, "--out", "new/study")
    assert (evedrop.folder / "new/study").is_dir(), done.err
    assert open_to_others(evedrop.folder / "new") == {}


@pytest.mark.usefixtures("open_umask")
def test_a_recording_made_for_a_look_is_private(evedrop: Evedrop) -> None:
    """The recording that `evedrop view` makes of a study is for its user alone."""
    assert evedrop("montecarlo", "vehicle", "--trials", "1", "--slots", "9", "--out", "study").status == 0
    assert replay(evedrop.folder / "study").is_file()
    assert open_to_others(evedrop.folder / "study") == {}


@pytest.mark.usefixtures("open_umask")
def test_briefs_are_private(evedrop: Evedrop) -> None:
    """Briefs that are written for several hosts are too, in a folder that everybody could look into before."""
    folder = evedrop.folder / "briefs"
    folder.mkdir()
    folder.chmod(0o777)
    done = evedrop("brief", "vehicle", "--out", "briefs")
    assert done.status == 0, done.err
    assert open_to_others(folder) == {}


def test_an_empty_folder_is_narrowed(tmp_path: Path) -> None:
    """An empty folder that all users can read is accepted, and from then on only its owner can."""
    tmp_path.chmod(0o777)
    new_folder(tmp_path)
    assert open_to_others(tmp_path) == {}


def test_a_file_that_is_there_is_narrowed(tmp_path: Path) -> None:
    """A file that everybody may read is emptied and narrowed before anything is written into it."""
    path = tmp_path / "file"
    path.write_text("something")
    path.chmod(0o666)
    assert private_file(path).read_text() == ""
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder whose owner is another user is refused, for its owner could look into it again at any time."""
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(UsageError, match=r"belongs to the user with the id \d+, .* give another folder"):
        new_folder(tmp_path)


@pytest.mark.thorough
def test_another_user_of_the_host_gets_nothing(evedrop: Evedrop) -> None:
    """A process of another user lists no folder and reads no file of a run in progress.

    Only root can start such a process. Others look at the modes alone.
    """
    live = evedrop.live("vehicle", "--slots", "100000", **OPEN)
    live.running()
    wait_until((live.folder / "control.json").exists, "control.json")
    assert open_to_others(live.folder) == {}
    if os.getuid() == 0:
        check_as_nobody(evedrop, live)
    live.process.terminate()
    assert live.end().status == 130


def check_as_nobody(evedrop: Evedrop, live: Live) -> None:
    """Another user gets to the results folder and the briefs, and not into them."""
    for folder in (
        evedrop.folder,
        *evedrop.folder.parents,
    ):  # pytest's own folders are private: give the other user a way there
        if folder.stat().st_uid == os.getuid() and folder != Path("/"):
            folder.chmod(folder.stat().st_mode | 0o011)
    names = ("scenario.toml", "control.json", "slots.parquet", "logs", "logs/recorder.log")
    places = [live.folder, *(live.folder / name for name in names), *live.temporary.glob("evedrop-*")]
    command: list[Any] = [sys.executable, "-c", LOOK, evedrop.folder / "run.news", *places]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines[0].startswith("b'"), "the other user must get as far as the folder's neighbours, or nothing is tested"
    assert lines[1:] == ["Permission denied"] * len(places)


@pytest.mark.parametrize(
    ("scenario", "name"),
    [
        ("vehicle", "vehicle"),
        ("folder/robot.toml", "robot"),
        ("folder/robot.v2.toml", "robot.v2"),
        ("robot.v2-sweep", "robot.v2-sweep"),
    ],
)
def test_a_default_folder_has_the_whole_name_of_its_scenario(scenario: str, name: str) -> None:
    """What follows another dot belongs to it."""
    assert default_folder(scenario).name.rpartition("-")[0].rpartition("-")[0] == name


def test_the_command_that_shares_a_run_shares_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others can reach a run in its default folder after the command of docs/results.md."""
    monkeypatch.chdir(tmp_path)
    folder = claimed(default_folder("vehicle"))
    page = (Path(__file__).parents[2] / "docs" / "results.md").read_text(encoding="utf-8")
    command = re.search(r"`(chmod [^`]*)`\s+shares them", page)
    assert command
    assert "runs/my-run" in command[1]
    subprocess.run(["sh", "-c", command[1].replace("runs/my-run", str(folder))], check=True)
    assert folder.stat().st_mode & 0o055 == 0o055
    assert folder.parent.stat().st_mode & 0o011 == 0o011

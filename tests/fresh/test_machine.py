"""A fresh machine is what it says: chosen in turn, told what pip is told here, gone with all that ran in it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import wait_until
from tests.debian import ROOT
from tests.folders import mounted_below, temporary_folder
from tests.fresh import machine
from tests.fresh.machine import MACHINES, Outcome, chosen, outcome, what_pip_is_told
from tests.privileged import CannotRun, run, skip

NAME = "debian13"
STARTS = f"""
import sys
from pathlib import Path
from tests.fresh.machine import MACHINES, outcome
outcome(MACHINES[{NAME!r}], Path(sys.argv[1]), print, ("echo under way; exec sleep 1000",))
"""


def test_every_machine_has_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four commits, four machines."""
    turns = []
    for commits in range(6, 10):
        monkeypatch.setattr(machine, "run", lambda *_, n=commits, **__: subprocess.CompletedProcess([], 0, f"{n}\n"))
        turns += chosen("in-turn")
    assert sorted(turn.name for turn in turns) == sorted(MACHINES)
    assert chosen("all") == list(MACHINES.values())
    assert [machine.name for machine in chosen("debian12-cc")] == ["debian12-cc"]
    with pytest.raises(ValueError, match="no fresh machine 'debian11'; expected one of debian12, "):
        chosen("debian11")


def test_all_that_went_wrong_is_named() -> None:
    """A command that failed, one that did not end, each failed test and why, and what is left."""
    outcomes = Outcome(
        ended={"make demo": (0, 3), "make test": (2, 5)},
        left=("x.zenoh",),
        lines=(
            ">       assert b()",
            "E       assert 0",
            "FAILED tests/a.py::test_b - assert 0",
            "FAILED to be kind",
            "ERROR tests/c.py::test_d",
            "ERROR tests/e.py",
            "1 failed",
        ),
        used_kilobytes=1,
    )
    assert outcomes.mistakes(("make demo", "make test", "make more")) == [
        "`make more` did not end",
        "`make test` ended with 2",
        "E       assert 0",
        "FAILED tests/a.py::test_b - assert 0",
        "ERROR tests/c.py::test_d",
        "ERROR tests/e.py",
        "left behind: x.zenoh",
    ]


def test_pip_is_told_there_what_it_is_told_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lists of several lines, variables with spaces, and the files and folders that they name."""
    here = {}
    for name in ("index/simple", "wheels", "some more"):
        (tmp_path / name).mkdir(parents=True)
    certificates = tmp_path / "certificates.crt"
    certificates.touch()
    here["pip.conf"] = tmp_path / "pip.conf"
    here["pip.conf"].write_text(
        f"[global]\ncert = {certificates}\nextra-index-url =\n  file://{tmp_path}/index/simple\n  https://b.invalid/simple\n"
        "[install]\nno-compile = true\n"
    )
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", str(here["pip.conf"]))
    monkeypatch.setenv("PIP_FIND_LINKS", f"{tmp_path}/wheels {tmp_path}/missing")
    monkeypatch.setenv("https_proxy", "http://user:a$b'c@proxy.invalid")
    given = tmp_path / "given"
    given.mkdir()
    what_pip_is_told(given)

    script = f'. {given}/variables; echo "$PIP_FIND_LINKS"; echo "$https_proxy"'
    assert run("env", "-i", "sh", "-c", script).stdout.splitlines() == [
        f"{tmp_path}/wheels {tmp_path}/missing",
        "http://user:a$b'c@proxy.invalid",
    ]
    listing = (sys.executable, "-m", "pip", "config", "list")
    there = run(*listing, env={**os.environ, "PIP_CONFIG_FILE": str(given / "pip.conf")}).stdout.splitlines()
    assert f"global.cert='{certificates}'" in there
    assert f"global.extra-index-url='file://{tmp_path}/index/simple https://b.invalid/simple'" in there
    assert "install.no-compile='true'" in there
    shown = (given / "shown").read_text().splitlines()
    assert {f"{tmp_path}/index", f"{tmp_path}/wheels", str(certificates)} <= set(shown)
    assert f"{tmp_path}/missing" not in shown


@pytest.mark.fresh
@pytest.mark.usefixtures("outcomes")
@pytest.mark.parametrize("user", ["root", "newcomer"])
def test_a_machine_is_bare_and_what_stays_there_is_told(user: str) -> None:
    """It has nothing of this environment, no power over this machine, and its own /dev/shm and /tmp; what stays is named."""
    name = next(name for name, machine in MACHINES.items() if machine.user == user and "gcc" not in machine.packages)
    look = "env; pwd; ls -A /dev/shm /tmp; command -v gcc cc; mount -t tmpfs tmpfs /mnt; git log -1"
    leave = "sleep 1000 & touch /tmp/mine /dev/shm/ours /dev/shm/12.zenoh /tmp/pytest-of-nobody; sleep 0.1"
    with temporary_folder("evedrop-fresh-") as folder:
        try:
            seen = outcome(MACHINES[name], folder, print, (look, leave, "exit 3"))
        except CannotRun as error:
            skip(error)
    text = "\n".join(seen.lines)
    (home,) = re.findall(r"^HOME=(/.*)$", text, re.MULTILINE)
    assert Path(home).name == user
    assert f"{home}/evedrop\n/dev/shm:\n\n/tmp:\n" in text
    assert "VIRTUAL_ENV" not in text
    assert "gcc" not in text
    assert run("git", "rev-parse", "HEAD", cwd=ROOT).stdout.strip() in text
    assert re.search("mount: /mnt: .*(denied|superuser)", text)
    assert {status for status, _ in seen.ended.values()} == {0, 3}
    assert sorted(seen.left) == ["mine", "ours", "sleep 1000"]


@pytest.mark.fresh
@pytest.mark.usefixtures("outcomes")
def test_killed_tests_leave_no_machine() -> None:
    """Kill -9 of the process that runs it: neither a mount nor a process nor a file is left but the two folders it began with."""
    with temporary_folder("evedrop-fresh-") as folder:
        command = (sys.executable, "-c", STARTS, folder)
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as starter:
            assert starter.stdout is not None
            assert any("under way" in line for line in starter.stdout)
            assert _of_machines(folder)
            starter.send_signal(signal.SIGKILL)
        wait_until(lambda: not _of_machines(folder), "the end of all that ran there")
        assert mounted_below(folder) == []
        assert sorted(path.name for path in folder.iterdir()) == ["given", "system"]
        assert not list((folder / "system").iterdir())


def _of_machines(folder: Path) -> list[str]:
    """The processes whose root is in a folder."""
    names = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            root = os.readlink(entry / "root")
        except OSError:
            continue
        if root.startswith(str(folder)):
            names.append(entry.name)
    return names

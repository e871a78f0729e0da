"""What the campaign needs of the machine: limits of memory and of processes, and the wire's and the journal's references."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from evedrop.wire.file import load_wire
from tests.faults import wires
from tests.faults.facilities import facilities, limited, process_group
from tests.faults.programs import KEYS
from tests.faults.wires import Start, lost_by_model
from tests.privileged import CannotRun, skip
from tests.wire.wire_links import key_fates

HUNGRY = "x = bytes(500_000_000)"
# The limit of an ordinary user is of all processes together: where others end theirs meanwhile, as many more can be started.
THREADS = """
import threading
threading.stack_size(65536)
ended = threading.Event()
for _ in range(2000):
    threading.Thread(target=ended.wait, daemon=True).start()
"""


def ended(command: list[str], memory: int | None = None, processes: int | None = None) -> str:
    """What a command says on its standard error under limits."""
    words, group = limited(command, memory, processes, "evedrop-test-limited")
    try:
        return subprocess.run(words, capture_output=True, text=True, check=False).stderr
    finally:
        if group is not None:
            group.rmdir()


def test_memory_is_limited() -> None:
    """Python starts with 300 MB, and has no room for 500 more."""
    assert ended([sys.executable, "-c", HUNGRY]) == ""
    assert "MemoryError" in ended([sys.executable, "-c", HUNGRY], memory=300)


def test_processes_are_limited() -> None:
    """Threads count; for root a control group does it."""
    command = [sys.executable, "-c", THREADS]
    assert ended(command) == ""
    try:
        status = ended(command, processes=10)
    except CannotRun as error:
        skip(error)
    assert "can't start new thread" in status
    with pytest.raises(CannotRun, match="no control group"):
        process_group("no/such/place", 10)


def test_without_a_mount_namespace_no_disk_breaks(tmp_path: Path) -> None:
    """And it is said why."""
    present = facilities(False, tmp_path)
    assert not present.small_disks
    assert present.lacks["a disk that breaks"] == "mounting takes root and a mount namespace"


@pytest.mark.parametrize("key", KEYS)
def test_the_fates_of_a_wire_are_those_of_its_model(key: str, tmp_path: Path) -> None:
    """Decided in one go, they are those that the wire decides block by block; as often as the link says."""
    path = tmp_path / "robot.toml"
    path.write_text(wires.FILE)
    link = next(each for each in load_wire(path).links if each.name == key)
    fates = key_fates(link, key, "put", wires.SEED)
    lost = lost_by_model(key, 3000)
    assert [bool(fates.next()[0]) for _ in range(3000)] == lost
    assert abs(sum(lost) / 3000 - (1.0 - wires.QUALITY[key])) < 0.05


def row(key: str, size: int, n: int, fate: str = "delivered", reason: str | None = None) -> dict[str, object]:
    """A row of a wire's journal."""
    return {"link": key, "key": key, "kind": "put", "n": n, "size": size, "fate": fate, "reason": reason, "delay": 0.0}


ROWS = [row("scan", 10, 0), row("scan", 11, 1, "lost", "loss"), row("scan", 12, 2)]
SENT = {("scan", size) for size in range(10, 14)}


def complaints(rows: list[dict[str, object]], received: list[int], status: int = 0) -> list[str]:
    """What is said of a start of a wire whose subscriber received messages of these numbers."""
    start = Start(10, status, SENT, [("scan", size) for size in received])
    return list(wires.true_to_receivers(1, start, rows))


def test_a_journal_that_is_true_to_its_receivers_is_accepted() -> None:
    """The subscriber got what was delivered; of a killed wire, less."""
    assert complaints(ROWS, [10, 12]) == []
    assert complaints(ROWS, [10], status=-9) == []


@pytest.mark.parametrize(
    ("rows", "received", "says"),
    [
        (ROWS, [10], "1 messages never arrived that the journal calls delivered"),
        (ROWS, [10, 11, 12], "1 messages arrived that the journal calls lost"),
        (ROWS, [10, 12, 12], "('scan', 12) arrived 2 times"),
        (ROWS[:2], [10, 12], "1 messages arrived that the journal does not have"),
        ([ROWS[0], ROWS[2]], [10, 12], "messages of scan between others that the wire heard are missing"),
        ([*ROWS, row("scan", 99, 3)], [10, 12, 99], "1 messages that nobody sent"),
        ([], [], "the journal has no message"),
    ],
)
def test_a_journal_that_is_not_true_is_seen(rows: list[dict[str, object]], received: list[int], says: str) -> None:
    """Of a wire that ended by itself."""
    lines = complaints(rows, received)
    assert [line for line in lines if says in line], lines


def test_numbers_and_fates_that_are_wrong_are_seen() -> None:
    """A gap, a number twice, and fates that are not the model's."""
    lost = lost_by_model("scan", 5)
    right = [row("scan", 10 + n, n, *(("lost", "loss") if lost[n] else ("delivered", None))) for n in range(5)]
    assert list(wires.wrong_numbers({1: right})) == list(wires.wrong_fates({1: right})) == []
    assert "gaps at [2]" in next(wires.wrong_numbers({1: right[:2], 2: right[3:]}))
    assert "twice [0]" in next(wires.wrong_numbers({1: right, 2: right[:1]}))
    assert Counter(lost)[True] < 5
    turned = [{**row, "reason": None if row["reason"] else "loss"} for row in right]
    assert "5 fates of scan are not those of its model" in next(wires.wrong_fates({1: turned}))

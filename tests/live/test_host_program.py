"""The program that starts processes on a host for a launcher on another one."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import pytest

from evedrop.live.launch.host_program import HostProcesses
from evedrop.live.launch.starter import StartedProcess

ORDER: Mapping[str, Any] = {
    "start": 7,
    "role": "eavesdropper",
    "brief": {"process": "smart", "part": {}},
    "environment": {},
}


def unable(role: str, brief: Path, log: IO[bytes], environment: Mapping[str, str]) -> StartedProcess:
    """A starter on a system that has no process to spare."""
    raise OSError(11, "Resource temporarily unavailable")


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="reads /proc")
@pytest.mark.parametrize(("folder", "why"), [("", "Resource temporarily unavailable"), ("gone", "No such file")])
def test_a_process_that_cannot_be_started_is_reported(folder: str, why: str, tmp_path: Path) -> None:
    """The launcher gets the reason for the log, and an end; the host goes on, and no file stays open."""
    sent: list[bytes] = []

    def send(text: memoryview) -> int:
        sent.append(bytes(text))
        return len(text)

    host = HostProcesses(tmp_path / folder, unable, send)
    before = os.listdir("/proc/self/fd")
    host.obey(ORDER)
    assert os.listdir("/proc/self/fd") == before
    log, end = (json.loads(line) for line in sent)
    assert log["log"] == 7
    assert log["text"].startswith("evedrop: smart cannot be started (")
    assert why in log["text"]
    assert end == {"ended": 7, "status": 1}
    host.end()


@pytest.mark.parametrize("name", ["../smart", "/etc/smart"])
def test_a_brief_is_written_only_into_the_folder_of_the_run(name: str, tmp_path: Path) -> None:
    """The launcher's name of a process is not a path."""
    order = {**ORDER, "brief": {"process": name, "part": {}}}
    (tmp_path / "private").mkdir()
    with pytest.raises(ValueError, match="is not the name of a process"):
        HostProcesses(tmp_path / "private", unable, len).obey(order)
    assert [path.name for path in tmp_path.rglob("*")] == ["private"]

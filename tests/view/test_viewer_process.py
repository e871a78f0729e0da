"""Rerun's viewer as a child process leaves nothing behind."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from evedrop.errors import UsageError
from evedrop.ports import free_port
from evedrop.view.viewer_process import end, spawn
from tests.conftest import wait_until


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder, empty."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


def test_a_viewer_that_draws_leaves_no_temporary_folder(tmp_path: Path, temporary: Path) -> None:
    """Whether it is terminated or ends by itself because there is no driver; folders of other viewers stay."""
    (temporary / "rerun-data-1-other").mkdir()
    port = free_port()
    try:
        process = spawn(port, ["--headless", "--port", str(port)], tmp_path)
    except UsageError as error:
        assert "the viewer ended with status" in str(error)  # noqa: PT017 - without a driver
    else:
        wait_until(lambda: process.poll() is not None or len(list(temporary.iterdir())) > 1, "a viewer under way")
        end(process)
    assert [path.name for path in temporary.iterdir()] == ["rerun-data-1-other"]

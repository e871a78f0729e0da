"""Which folders a run removes from the folder for temporary files."""

from __future__ import annotations

from pathlib import Path

import pytest

from evedrop.live.launch.private_folder import private_folder


@pytest.mark.parametrize(
    ("name", "mode", "kept"),
    [
        ("evedrop-0123456789abcdef", 0o700, False),
        ("evedrop-0123456789abcdef", 0o755, True),
        ("evedrop-0123456789abcde", 0o700, True),
        ("evedrop-0123456789abcdef0", 0o700, True),
        ("evedrop-checkout", 0o700, True),
    ],
)
def test_only_a_folder_that_a_run_has_made_is_removed(name: str, mode: int, kept: bool, tmp_path: Path) -> None:
    """A folder of the user's own may begin with the same word, and have a file `lock`."""
    folder = tmp_path / name
    folder.mkdir(mode)
    (folder / "lock").touch()
    with private_folder(tmp_path):
        assert folder.exists() is kept

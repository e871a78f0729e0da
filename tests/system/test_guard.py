"""A folder is removed with the process that made it, and what that process could not remove is removed after the block."""

from __future__ import annotations

from pathlib import Path

from evedrop.system.world import world


def test_what_is_left_in_a_folder_is_removed_after_the_block(tmp_path: Path) -> None:
    """The process has removed nothing, for example because it had no memory to do so."""
    folder = tmp_path / "keys"
    with world().process.removed_with_it(folder):
        folder.mkdir()
        (folder / "brief").write_text("secret")
    assert not folder.exists()

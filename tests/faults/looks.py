"""Looks at a results folder with the commands that people have for it: `report`, `view --table` and `diff`."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from evedrop.cli.main import main


def failed_looks(folder: Path, memory: Path | None) -> Iterator[str]:
    """The commands that fail, or say that the run is not that of the same trials in memory, whose folder is `memory`."""
    commands = [["report", str(folder)], ["view", str(folder), "--table"]]
    if memory is not None:
        commands.append(["diff", str(folder), str(memory)])
    for words in commands:
        output = io.StringIO()
        try:
            with redirect_stdout(output), redirect_stderr(output):
                status = main(words)
        except Exception as error:
            yield f"evedrop {words[0]} fails with {error!r}"
            continue
        if status != 0:
            yield f"evedrop {words[0]} ends with {status}: {output.getvalue().strip()}"
    page = folder / "report.html"
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    if not text.rstrip().endswith("</html>") or "cannot be read" in text:
        yield "evedrop report makes no whole page"

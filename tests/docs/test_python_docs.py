"""The Python of docs/python.md runs as it is, and raises the errors that it shows."""

from __future__ import annotations

import re
import traceback
from pathlib import Path
from typing import Any

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(python|pycon)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks in order, in one folder; a block of a session ends with the error that it shows."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    assert {kind for kind, _ in BLOCKS} == {"python", "pycon"}
    for kind, code in BLOCKS:
        if kind == "python":
            exec(compile(code, "docs/python.md", "exec"), names)  # noqa: S102 - the page's own code
            continue
        call, *_, said = re.split(r"^Traceback .*:$\n", code.removeprefix(">>> "), maxsplit=1, flags=re.MULTILINE)
        with pytest.raises(Exception, match="mistakes") as caught:
            exec(call, names)  # noqa: S102 - the same
        assert "".join(traceback.format_exception_only(caught.value)) == said

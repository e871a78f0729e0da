"""The notebooks of docs/ run from top to bottom, in an empty folder, in a kernel without a display."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def test_there_are_four() -> None:
    """There are notebooks for the tests below."""
    assert NOTEBOOKS == ["a-study-for-a-paper", "first-run", "your-own-scheme", "your-own-system"]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_are_kept_without_outputs(name: str) -> None:
    """Outputs would add pictures to every change, and might be those of an older version."""
    notebook_ = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    for cell in notebook_["cells"]:
        assert (cell.get("outputs", []), cell.get("execution_count")) == ([], None)


@pytest.mark.notebooks
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an error and without a warning; results show themselves as tables, and figures as pictures."""
    nbformat = pytest.importorskip("nbformat", reason="`make notebooks` installs what a notebook needs")
    client = pytest.importorskip("nbclient", reason="`make notebooks` installs what a notebook needs")
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"):
        monkeypatch.delenv(variable, raising=False)
    for variable in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(variable, str(tmp_path / variable))
    monkeypatch.setenv("JUPYTER_PATH", str(Path(sys.prefix) / "share" / "jupyter"))
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    (tmp_path / "work").mkdir()
    resources = {"metadata": {"path": str(tmp_path / "work")}}
    client.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs: list[dict[str, Any]] = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    errors = [output["text"] for output in outputs if output.get("name") == "stderr"]
    shown = {kind for output in outputs for kind in output.get("data", {})}
    assert errors == []
    assert {"text/html", "image/png"} <= shown
    assert not any("<progress" in str(output.get("data")) for output in outputs), "a progress bar is left"
    assert not (tmp_path / "work" / "runs").exists()

"""Pictures of the view for the gallery: a live run that is paused, and the same run when it has ended, in two sizes.

They are kept in build/gallery for as long as neither the scenario nor the program changes. Drawing them needs a Vulkan driver.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from picture_folder import PICTURES, program_digest

from evedrop.scenarios import built_in_text

SCENARIO = "vehicle"
SLOT = 1612
SIZES = ("1200x720", "1920x1080")
_PATIENCE_SECONDS = 120.0
_STATES = {"live": f"paused after slot {SLOT}", "finished": f"finished, at slot {SLOT}"}
_EVEDROP = (sys.executable, "-m", "evedrop")


def view_section() -> str:
    """The section of the gallery in Markdown."""
    parts = [
        "## The view\n",
        f"The scene of a run of `{SCENARIO}` in [the view](view.md), at the same slot while the run is paused there and",
        "when it has ended, in two sizes.\n",
    ]
    for name in _names():
        state, size = name.split("-")
        caption = f"{_STATES[state]}, {size.replace('x', ' × ')} pixels"
        parts.append(
            f"### The view {state}, {size.replace('x', ' × ')}\n\n![The view, {caption}](gallery/view-{name}.png)\n"
        )
    return "\n".join(parts)


def view_pictures() -> dict[str, bytes]:
    """Each picture of the view, as PNG, by the name of its file without the suffix."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    made = hashlib.sha256(
        program_digest() + Path(__file__).read_bytes() + built_in_text(SCENARIO).encode()
    ).hexdigest()[:16]
    kept = {f"view-{name}": PICTURES / f"{made}-{name}.png" for name in _names()}
    if not all(path.exists() for path in kept.values()):
        with tempfile.TemporaryDirectory(prefix="evedrop-site-") as folder:
            _take(Path(folder) / "run", made)
    return {name: path.read_bytes() for name, path in kept.items()}


def _names() -> list[str]:
    return [f"{state}-{size}" for state in _STATES for size in SIZES]


def _take(run: Path, made: str) -> None:
    """Run the scenario, pause it, and take all pictures."""
    command = [*_EVEDROP, "run", SCENARIO, "--pace", "0", "--view", "off", "--paused", "--out", str(run)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as going:
        try:
            _wait_for(run / "control.json", going)
            _evedrop("step", run, SLOT + 1)
            _draw(run, made, "live")
            _evedrop("resume", run)
            if going.wait(_PATIENCE_SECONDS):
                raise RuntimeError(f"evedrop run {SCENARIO} ended with status {going.returncode}")
        finally:
            going.terminate()
    _draw(run, made, "finished")


def _draw(run: Path, made: str, state: str) -> None:
    """Draw the slot in all sizes."""
    for size in SIZES:
        _evedrop("view", run, "--picture", PICTURES / f"{made}-{state}-{size}.png", "--size", size, "--slot", SLOT)


def _wait_for(control: Path, going: subprocess.Popen[bytes]) -> None:
    """Wait until a run can be steered."""
    deadline = time.monotonic() + _PATIENCE_SECONDS
    while not control.exists():
        if going.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"evedrop run {SCENARIO} did not start")
        time.sleep(0.05)


def _evedrop(command: str, *words: object) -> None:
    """Run a command on a run, and fail if it fails."""
    subprocess.run(
        [*_EVEDROP, command, *map(str, words)], check=True, timeout=_PATIENCE_SECONDS, stdout=subprocess.DEVNULL
    )

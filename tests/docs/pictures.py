"""The pictures of README and docs that the program draws, each by the command that its page names.

`python -m tests.docs.pictures` draws them again, or only those whose files are given, such as `vehicle.gif`; look at each before
you commit it. That takes some minutes without a graphics card. The view needs a Vulkan driver.
"""

from __future__ import annotations

import itertools
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from PIL import Image

from evedrop.system.ports import free_port
from tests.conftest import wait_until
from tests.docs.browser import CHROMIUM, light_scene
from tests.privileged import CannotRun, skip
from tests.wire.wire_at_work import program

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_EVEDROP = (sys.executable, "-m", "evedrop")
_PERIOD = 0.01  # seconds between two scans of a robot


def evedrop(*words: str | Path) -> None:
    """Carry a command out, and fail if it fails. Skips the test where nothing can draw."""
    done = subprocess.run([*_EVEDROP, *words], check=False, capture_output=True, text=True)
    if "no Vulkan driver" in done.stderr:
        skip(CannotRun(done.stderr))
    assert done.returncode == 0, done.stderr


def quoted(page: Path, picture: str) -> list[str]:
    """The words of the command with which a page says that one of its pictures is made."""
    text = page.read_text(encoding="utf-8")
    made = re.search(r"`evedrop (view (?:RUN|OUT) --[^`]*FILE\.(?:png|gif)[^`]*)`", text[text.index(f"{picture})") :])
    assert made is not None
    return shlex.split(made[1])


def drawn(words: Sequence[str], results: Path, picture: Path) -> Path:
    """The picture that a quoted command makes of some results."""
    places = {"RUN": results, "OUT": results, "FILE.png": picture, "FILE.gif": picture}
    evedrop(*(places.get(word, word) for word in words))
    return picture


def run_of(scenario: str, folder: Path, *changes: str) -> Path:
    """A run of a built-in scenario, as fast as possible; made only once in a folder."""
    run = folder / scenario if not changes else folder / f"{scenario}-changed"
    if not run.exists():
        evedrop("run", scenario, "--pace", "0", "--view", "off", "--out", run, *changes)
    return run


def _nine(folder: Path) -> Path:
    """A run of `vehicle` with five more eavesdroppers: with the legitimate estimator, nine receivers."""
    more = ("bayesian", "genie", "constant", "power-test", "likelihood")
    changes = [f'eavesdroppers.{name}={{strategy="{name}", link={{quality=0.8}}}}' for name in more]
    return run_of("vehicle", folder, *(word for change in changes for word in ("--set", change)))


def wire_at_work(folder: Path) -> Path:
    """The wire of docs/wire/results.md, with a robot and its base that publish for 28 s as the page says."""
    out = folder / "wire"
    if out.exists():
        return out
    example = subprocess.run([*_EVEDROP, "wire", "--example"], check=True, capture_output=True).stdout
    (folder / "robot.toml").write_bytes(example)
    endpoints = {side: f"tcp/127.0.0.1:{free_port()}" for side in ("robot", "base", "listener")}
    changes = {f"side.{side}.listen": endpoint for side, endpoint in endpoints.items()}
    changes |= {"event.0.to": "16", "event.1.to": "25"}
    options = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    command = [
        *_EVEDROP,
        "wire",
        str(folder / "robot.toml"),
        *options,
        "--for",
        "28 s",
        "--view",
        "off",
        "--out",
        str(out),
    ]
    with ExitStack() as stack:
        wire = stack.enter_context(subprocess.Popen(command, stdout=subprocess.DEVNULL))
        wait_until(lambda: (out / "control.json").exists() or wire.poll() is not None, "the wire")
        robot, base = (stack.enter_context(program([endpoints[side]])) for side in ("robot", "base"))
        start = time.monotonic()
        for number in itertools.count():
            time.sleep(max(0.0, start + number * _PERIOD - time.monotonic()))
            if wire.poll() is not None:
                break
            robot.put("robot/scan/front", bytes(6000))
            if number % 2 == 0:
                robot.put("robot/pose", bytes(50))
            if number % 5 == 0:
                base.put("base/order", bytes(20))
    return out


def _compare(folder: Path, picture: Path) -> None:
    page = (DOCS / "compare.md").read_text(encoding="utf-8")
    words = shlex.split(next(line for line in page.splitlines() if line.startswith("evedrop compare ")))[1:]
    evedrop(*words[:-1], folder / "compare")
    shutil.copy(folder / "compare" / "compare.png", picture)


def _viewed(page: Path, results: Callable[[Path], Path]) -> Callable[[Path, Path], None]:
    """What draws a picture of results that it first makes in a folder."""
    return lambda folder, picture: _draw(page, results(folder), picture)


def _draw(page: Path, results: Path, picture: Path) -> None:
    drawn(quoted(page, picture.name), results, picture)


PICTURES: Mapping[str, Callable[[Path, Path], None]] = {
    "live_view.png": _viewed(DOCS / "tutorial.md", lambda folder: run_of("vehicle", folder)),
    "vehicle.gif": _viewed(DOCS / "view.md", lambda folder: run_of("vehicle", folder)),
    "microgrid_view.png": _viewed(DOCS / "view.md", lambda folder: run_of("microgrid", folder)),
    "wire.gif": _viewed(ROOT / "README.md", wire_at_work),
    "wire_view.png": _viewed(DOCS / "wire" / "results.md", wire_at_work),
    "compare.png": _compare,
}
"""File in docs/ → what draws it: called with a folder for results, and the path of the picture."""


def _built_in(scenario: str) -> Callable[[Path], Path]:
    return lambda folder: run_of(scenario, folder)


SCENES: Mapping[str, Callable[[Path], Path]] = {
    **{name: _built_in(name) for name in ("vehicle", "acknowledged", "hijacked", "microgrid")},
    "nine": _nine,
    "wire": wire_at_work,
}
"""Name → what makes the results whose first tab the page of screens shows, called with a folder."""
SIZES = ("1280x720", "1920x1080")


def scene_of(name: str, size: str, folder: Path, picture: Path) -> Path:
    """Draw the first tab of the view of such results, in a folder for results."""
    moment = ["--time", "18"] if name == "wire" else []
    evedrop("view", SCENES[name](folder), "--picture", picture, "--size", size, *moment)
    return picture


def _scene(name: str, size: str) -> Callable[[Path, Path], None]:
    """What draws a scene into docs/screens, in few colours, so that the file is small."""

    def draw(folder: Path, picture: Path) -> None:
        _in_few_colours(scene_of(name, size, folder, picture))

    return draw


def _light_scene(name: str, size: str) -> Callable[[Path, Path], None]:
    """The same in the light theme, at the end of the results, as a browser shows it; the picture stays as it is without one."""

    def draw(folder: Path, picture: Path) -> None:
        if CHROMIUM is not None:
            light_scene(SCENES[name](folder), size, picture)
            _in_few_colours(picture)

    return draw


def _in_few_colours(picture: Path) -> None:
    with Image.open(picture) as drawing:
        small = drawing.convert("RGB").quantize(128)
    small.save(picture, optimize=True)


ALL_PICTURES: Mapping[str, Callable[[Path, Path], None]] = {
    **PICTURES,
    **{f"screens/{name}-{size}.png": _scene(name, size) for name in SCENES for size in SIZES},
    **{f"screens/{name}-{size}-light.png": _light_scene(name, size) for name in SCENES for size in SIZES},
}
"""Those of docs/screens as well."""


def main(names: Sequence[str]) -> None:
    """Draw these pictures, or all of them."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names or ALL_PICTURES:
            ALL_PICTURES[name](Path(folder), DOCS / name)
            sys.stdout.write(f"docs/{name} is drawn\n")


if __name__ == "__main__":
    main(sys.argv[1:])

"""What ten commands print on terminals of six widths: docs/screens/WIDTH.txt, a page for each width.

`python -m tests.docs.screens` writes the pages again; read the difference before you commit it. Rates, times and the folder
differ from run to run, so they are `…` on the page, and pages are compared by their words.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import tempfile
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rich.text import Text

ROOT = Path(__file__).parents[2]
SCREENS = ROOT / "docs" / "screens"
WIDTHS = (40, 60, 80, 100, 120, 200)
_MISTAKEN = """\
process = {A = [[1.0, 0.02], [0.0, 1.0]], Q = [[1e-4, 0.0], [0.0, 1e-2]]}
slot = 3000
encoding = {scheme = "scheduled", mu = 0.55}
legitimate = {quality = 1.4}
eavesdropper = [{name = "naive", strategy = "naiv", quality = 0.9}]
"""
SETUP = (
    "mkdir tests",
    "evedrop show bursts > tests/bursts.toml",
    "evedrop show two-eavesdroppers > tests/two.toml",
    "echo -e '[[expect]]\nmetric = \"smart.mean_squared_error\"\nbelow = 0.1' >> tests/two.toml",
    "evedrop wire --example > robot.toml",
)
COMMANDS = (
    "evedrop --help",
    "evedrop list",
    "evedrop check mistaken.toml",
    "evedrop design vehicle",
    "evedrop run vehicle --slots 1000 --pace 0 --view off --out live",
    "evedrop montecarlo acknowledged --slots 90 --trials 40 --out study",
    "evedrop sweep vehicle --over encoding.state_probability=0.3,0.5,0.7 --slots 400 --trials 20 --out sweep",
    "evedrop compare acknowledged --slots 90 --trials 10 --out compare",
    "evedrop test tests --in-memory --trials 40 --out tested",
    "evedrop wire --check robot.toml robot/scan/front robot/@config/x",
)
"""In one folder, in this order."""
_DIFFERS = re.compile(r"[\d,.]+(?=\s+(?:trial-)?slots/s)|[\d.]+(?= s\b)")
_HEAD = "$ "


class Screen(NamedTuple):
    """A command, and what a terminal shows of it: no colours, no progress."""

    command: str
    text: str

    def wide(self, columns: int) -> list[str]:
        """The lines that are wider than the terminal, but for a single word, which stays whole."""
        return [line for line in self.text.split("\n") if Text(line).cell_len > columns and len(line.split()) > 1]

    @property
    def words(self) -> list[str]:
        """Its words, without those that differ."""
        return _DIFFERS.sub("…", self.text).split()


def screens(columns: int, folder: Path) -> Iterator[Screen]:
    """Carry the commands out in a folder, on a terminal of so many columns."""
    (folder / "mistaken.toml").write_text(_MISTAKEN, encoding="utf-8")
    for command in SETUP:
        _printed(command, folder, columns)
    for command in COMMANDS:
        printed = Text.from_ansi(_printed(command, folder, columns)).plain
        printed = printed.replace(str(folder), "…")
        yield Screen(command, "\n".join(line.rstrip() for line in printed.split("\n")).strip("\n"))


def _printed(command: str, folder: Path, columns: int) -> str:
    """What a command prints on a terminal; its mistakes too, its progress not."""
    terminal, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "COV_"))}
    environment |= {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "TERM": "xterm",
        "LC_ALL": "C.UTF-8",
    }
    environment.pop("COLUMNS", None)
    errors = side if "mistaken" in command else subprocess.DEVNULL
    with subprocess.Popen(["bash", "-c", command], cwd=folder, env=environment, stdin=side, stdout=side, stderr=errors):
        os.close(side)
        return b"".join(_pieces(terminal)).decode("utf-8").replace("\r\n", "\n")


def _pieces(terminal: int) -> Iterator[bytes]:
    """All that programs write to a terminal until the last of them has closed it."""
    try:
        while piece := os.read(terminal, 65536):
            yield piece
    except OSError:  # how Linux says that nobody has the other side any more
        pass
    finally:
        os.close(terminal)


def page_of(columns: int) -> Path:
    """The page of a width."""
    return SCREENS / f"{columns}.txt"


def read_page(columns: int) -> list[Screen]:
    """The screens of a page."""
    parts = page_of(columns).read_text("utf-8").split(f"\n{_HEAD}")[1:]
    return [Screen(command, text.strip("\n")) for command, _, text in (part.partition("\n") for part in parts)]


def write_page(columns: int) -> None:
    """Carry the commands out, and write the page of a width."""
    with tempfile.TemporaryDirectory() as folder:
        parts = [
            f"{_HEAD}{screen.command}\n{_DIFFERS.sub('…', screen.text)}\n" for screen in screens(columns, Path(folder))
        ]
    page_of(columns).parent.mkdir(exist_ok=True)
    page_of(columns).write_text(
        f"What commands print on a terminal of {columns} columns.\n\n" + "\n".join(parts), "utf-8"
    )


if __name__ == "__main__":
    for width in map(int, sys.argv[1:] or WIDTHS):
        write_page(width)

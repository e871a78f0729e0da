"""Setting up says what it downloads, how far it is, and which kernels there are; pip's own words are shown if it fails."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PROGRAM = ROOT / "tools" / "install.py"


@pytest.fixture
def install() -> Any:
    """The program as a module."""
    spec = importlib.util.spec_from_file_location("install", PROGRAM)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["install"] = module  # where its dataclass looks for its types
    spec.loader.exec_module(module)
    del sys.modules["install"]
    return module


def wheel(folder: Path, name: str) -> str:
    """A package without contents; its hash."""
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        file.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        file.writestr(f"{info}/RECORD", f"{info}/METADATA,,\n{info}/WHEEL,,\n{info}/RECORD,,\n")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def installed(tmp_path: Path, second_hash: str = "") -> subprocess.CompletedProcess[str]:
    """What the program says of a list of two packages of a folder, and of one that other machines need."""
    hashes = [wheel(tmp_path, "evedrop_a"), wheel(tmp_path, "evedrop_b")]
    lock = tmp_path / "some.txt"
    lock.write_text(
        f"evedrop-a==1.0 \\\n    --hash=sha256:{hashes[0]}\n"
        f"evedrop-b==1.0 ; python_version >= '3' \\\n    --hash=sha256:{second_hash or hashes[1]}\n"
        f"evedrop-c==1.0 ; sys_platform == 'none' \\\n    --hash=sha256:{hashes[0]}\n"
    )
    # Not into the environment of the tests.
    pip = {
        "PIP_CONFIG_FILE": os.devnull,
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(tmp_path),
        "PIP_TARGET": str(tmp_path / "new"),
    }
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    command = (sys.executable, PROGRAM, lock)
    return subprocess.run(command, env={**environment, **pip}, stdout=subprocess.PIPE, text=True, check=False)


def test_a_list_is_installed_and_its_size_is_said(tmp_path: Path) -> None:
    """Packages that this machine does not need are not counted."""
    done = installed(tmp_path)
    assert done.returncode == 0, done.stdout
    first, *_, last = done.stdout.splitlines()
    assert first == "setup: 2 packages, each checked against its hash (some.txt)"
    assert re.fullmatch(r"setup: 2 packages installed, 1 kB downloaded, in \d+ s", last)
    assert {path.name for path in (tmp_path / "new").glob("*.dist-info")} == {
        "evedrop_a-1.0.dist-info",
        "evedrop_b-1.0.dist-info",
    }


def test_pips_words_are_shown_if_it_fails(tmp_path: Path) -> None:
    """A package that is not the locked one is refused, and pip says which."""
    done = installed(tmp_path, second_hash="0" * 64)
    assert done.returncode == 1
    assert "evedrop_a-1.0-py3-none-any.whl" in done.stdout
    assert "THESE PACKAGES DO NOT MATCH THE HASHES" in done.stdout
    assert done.stdout.splitlines()[-1] == "setup: pip failed with status 1; what it said is above"


# Lines of pip 23.0.1 and 25.1.1, which are those of Debian 12 and 13.
LINES = """\
Looking in indexes: https://index.invalid/simple
Ignoring colorama: markers 'sys_platform == "win32"' don't match your environment
Collecting numpy==2.5.5 (from -r tools/constraints/project.txt (line 1770))
  Downloading numpy-2.5.5-cp313-cp313-manylinux_2_27_x86_64.whl.metadata (6.6 kB)
Collecting click==8.5.1
  Downloading click-8.5.1-py3-none-any.whl (126 kB)
     126.0/126.0 kB 5.6 MB/s eta 0:00:00
  Using cached rerun_sdk-0.30.0-cp310-abi3-manylinux_2_28_x86_64.whl (170.2 MB)
Requirement already satisfied: ruff==0.16.0 in ./lib (from -r tools/constraints/project.txt (line 9)) (0.16.0)
Downloading numpy-2.5.5-cp313-cp313-manylinux_2_27_x86_64.whl (16.9 MB)
"""


def test_how_far_pip_is_can_be_told_from_its_lines(tmp_path: Path, install: Any) -> None:
    """A package is counted once, with the size of its file; while pip is installing, those that are in the environment count."""
    progress = install.Progress({"numpy", "click", "rerun_sdk", "ruff", "ruamel_yaml"})
    assert progress.line(tmp_path) == "0 of 5 packages here, 0 kB"
    for line in LINES.splitlines():
        progress.read(line)
    assert progress.line(tmp_path) == "4 of 5 packages here, 187 MB; the last begun is numpy, 17 MB"
    progress.read("Installing collected packages: click, numpy, rerun-sdk")
    for name in ("numpy-2.5.5", "ruamel.yaml-0.18", "pip-25.1.1"):
        (tmp_path / f"{name}.dist-info").mkdir()
    assert progress.line(tmp_path) == "2 of 5 packages installed"


def test_a_line_comes_while_pip_is_silent(
    tmp_path: Path, install: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A large package takes minutes on a slow line; here pip waits until a line was printed."""
    python = tmp_path / "python"
    printed = tmp_path / "printed"
    os.mkfifo(printed)
    python.write_text(f'#!/bin/sh\necho "  Downloading big-1.0-py3-none-any.whl (118 MB)"\nread -r line <{printed}\n')
    python.chmod(0o755)
    monkeypatch.setattr(install, "SECONDS", 0.01)
    monkeypatch.setattr(sys, "executable", str(python))
    messages = []

    def say(text: str) -> None:
        messages.append(text)
        if "118 MB" in text:
            printed.write_text("yes\n")
            monkeypatch.setattr(install, "SECONDS", 100.0)

    monkeypatch.setattr(install, "_say", say)
    assert install._pip(install.Progress({"big"})) == 0
    assert messages[-1] == "1 of 1 packages here, 118 MB; the last begun is big, 118 MB"
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("kernels", ["numpy, because the C kernels are not built", "C (avx2)"])
def test_the_kernels_are_said(
    kernels: str, tmp_path: Path, install: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And what to install, if they are not built."""
    python = tmp_path / "python"
    python.write_text(
        f'#!/bin/sh\n[ "$2" = pip ] && exit 0\necho "{kernels}"\nexit {int(kernels.startswith("numpy"))}\n'
    )
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    assert install.install_project(tmp_path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"setup: done; the kernels are {kernels}" in lines
    assert ("apt install gcc python3-dev" in lines[-1]) == kernels.startswith("numpy")


def test_documents_say_how_much_is_downloaded(install: Any) -> None:
    """README and CONTRIBUTING name the size that setting up announces."""
    for page in ("README.md", "CONTRIBUTING.md"):
        assert f"{install.MEGABYTES['project.txt']} MB" in (ROOT / page).read_text(encoding="utf-8"), page

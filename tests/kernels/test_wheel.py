"""The wheel: with the C kernels it needs no compiler where it is installed, and it can be refused without them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from evedrop.kernels import choice

ROOT = Path(__file__).parents[2]
REQUIRED = "EVEDROP_KERNELS_REQUIRED"
SOURCES = ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE")
ROOMS = ("emulator", "peers", "scenarios")
BUILD = """
import runpy, sys
sys.modules.update(dict.fromkeys(sys.argv.pop().split(",")))  # these packages are not installed
sys.argv[0] = "hatchling"
runpy.run_module("hatchling", run_name="__main__")
"""


def build(folder: Path, without: str = "-", **changes: str) -> subprocess.CompletedProcess[str]:
    """Build the wheel of a copy of the sources, into `dist`; without: a package to hide; changes: of the environment."""
    copy = folder / "copy"
    for room in ROOMS:
        shutil.copytree(ROOT / room, copy / room, True, shutil.ignore_patterns("_compiled*", "__pycache__"))
    for name in SOURCES:
        shutil.copy(ROOT / name, copy)
    environment = {name: value for name, value in os.environ.items() if name not in {REQUIRED, "CC"}} | changes
    words = [sys.executable, "-c", BUILD, "build", "-t", "wheel", "-d", str(folder / "dist"), without]
    return subprocess.run(words, cwd=copy, env=environment, capture_output=True, text=True, check=False, timeout=300)


def test_an_installed_wheel_has_the_kernels_where_there_is_no_compiler(tmp_path: Path) -> None:
    """In an empty environment with nothing else on the path, the selftest passes with the C kernels."""
    pytest.importorskip(choice.EXTENSION, reason="the C kernels are not built: no compiler worked")
    built = build(tmp_path, **{REQUIRED: "1", "CFLAGS": "-g0"})
    assert built.returncode == 0, built.stderr
    [wheel] = (tmp_path / "dist").iterdir()
    assert wheel.stem.endswith(sysconfig.get_platform().replace("-", "_").replace(".", "_"))
    home = tmp_path / "empty"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True)
    [packages] = home.glob("lib/python*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    # The packages that it needs, but not this checkout: the files that lead to it are read in the environment itself alone.
    (packages / "needed.pth").write_text(f"{sysconfig.get_path('purelib')}\n{sysconfig.get_path('platlib')}\n")
    environment = {"PATH": str(home / "bin"), "HOME": str(tmp_path)}
    code = (
        "import sys, evedrop; print(evedrop.__file__); from evedrop.cli.main import main; sys.exit(main(['selftest']))"
    )
    command = [str(home / "bin" / "python"), "-P", "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith(str(packages))
    assert "kernels         C (" in done.stdout


def test_without_a_compiler_a_wheel_that_must_have_the_kernels_is_not_built(tmp_path: Path) -> None:
    """The message says what is missing, and which variable demands it."""
    built = build(tmp_path, "ziglang", PATH=str(tmp_path), **{REQUIRED: "1"})
    assert built.returncode != 0
    assert (
        "RuntimeError: the C kernels were not built, and EVEDROP_KERNELS_REQUIRED is 1: no C compiler" in built.stderr
    )
    assert not list(tmp_path.glob("dist/*.whl"))


def test_without_a_compiler_a_wheel_is_one_for_all_platforms(tmp_path: Path) -> None:
    """Its name does not claim a platform, unlike that of a wheel with kernels."""
    built = build(tmp_path, "ziglang", PATH=str(tmp_path), **{REQUIRED: "0"})
    assert built.returncode == 0, built.stderr
    [wheel] = (tmp_path / "dist").iterdir()
    assert wheel.name.endswith("-none-any.whl")


def test_other_values_of_the_variable_are_refused(tmp_path: Path) -> None:
    """A word that was meant to require the kernels must not be taken for the opposite."""
    built = build(tmp_path, **{REQUIRED: "yes"})
    assert built.returncode != 0
    assert "EVEDROP_KERNELS_REQUIRED is 'yes'; expected 1 or 0, or leave it out" in built.stderr

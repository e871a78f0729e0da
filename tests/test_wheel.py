"""The wheel: with the C kernels it needs no compiler where it is installed, and it can be refused without them.

Where it is installed, it breaks nothing in a project with packages and files of the same names as parts of it or of Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from evedrop.model.kernels import choice

pytestmark = pytest.mark.wheel
ROOT = Path(__file__).parents[1]
REQUIRED = "EVEDROP_KERNELS_REQUIRED"
SOURCES = ("pyproject.toml", "tools/hatch_build.py", "README.md", "LICENSE")
FOLDERS = ("emulator", "peers", "scenarios")
BUILD = """
import runpy, sys
sys.modules.update(dict.fromkeys(sys.argv.pop().split(",")))  # these packages are not installed
sys.argv[0] = "hatchling"
runpy.run_module("hatchling", run_name="__main__")
"""


def build(folder: Path, without: str = "-", **changes: str) -> subprocess.CompletedProcess[str]:
    """Build the wheel of a copy of the sources, into `dist`; without: a package to hide; changes: of the environment."""
    copy = folder / "copy"
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, True, shutil.ignore_patterns("_compiled*", "__pycache__"))
    (copy / "tools").mkdir()
    for name in SOURCES:
        shutil.copy(ROOT / name, copy / name)
    environment = {name: value for name, value in os.environ.items() if name not in {REQUIRED, "CC"}} | changes
    words = [sys.executable, "-c", BUILD, "build", "-t", "wheel", "-d", str(folder / "dist"), without]
    return subprocess.run(words, cwd=copy, env=environment, capture_output=True, text=True, check=False, timeout=300)


@dataclass(frozen=True)
class Installed:
    """An environment with the wheel, and with nothing of this checkout."""

    home: Path
    packages: Path

    def python(self, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
        """Run its Python in a folder; -P as in a script: the folder is not searched for modules."""
        environment = {"PATH": str(self.home / "bin"), "HOME": str(self.home), "COLUMNS": "160"}
        command = [str(self.home / "bin" / "python"), "-P", *words]
        return subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=120
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel of this machine, installed without its sources and without a compiler."""
    folder = tmp_path_factory.mktemp("wheel")
    compiled = choice.KERNELS != "numpy"
    built = build(folder, **{REQUIRED: "1" if compiled else "0", "CFLAGS": "-g0 -O1"})
    assert built.returncode == 0, built.stderr
    [wheel] = (folder / "dist").iterdir()
    home = folder / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True)
    [packages] = home.glob("lib/python*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    # The packages that it needs, but not this checkout: the files that lead to it are read in the environment itself alone.
    (packages / "needed.pth").write_text(f"{sysconfig.get_path('purelib')}\n{sysconfig.get_path('platlib')}\n")
    if compiled:
        assert wheel.stem.endswith(sysconfig.get_platform().replace("-", "_").replace(".", "_"))
    return Installed(home, packages)


def test_an_installed_wheel_has_the_kernels_where_there_is_no_compiler(installed: Installed, tmp_path: Path) -> None:
    """In an empty environment with nothing else on the path, the selftest passes with the C kernels."""
    pytest.importorskip(choice.EXTENSION, reason="the C kernels are not built: no compiler worked")
    code = (
        "import sys, evedrop; print(evedrop.__file__); from evedrop.cli.main import main; sys.exit(main(['selftest']))"
    )
    done = installed.python(tmp_path, "-c", code)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith(str(installed.packages))
    assert "kernels         C (" in done.stdout


def test_the_description_leads_to_no_file_of_the_repository(installed: Installed) -> None:
    """It is README.md, whose links keep their words where there are no files."""
    [metadata] = installed.packages.glob("evedrop-*.dist-info/METADATA")
    _, _, description = metadata.read_text(encoding="utf-8").partition("\n\n")
    assert description.startswith("# Evedrop\n")
    assert "](docs/" not in description
    assert "The tutorial goes on from here." in description


SPIED = """
title = "A spy of theirs"
slots = 20
seed = 1
[process]
A = [[1.0]]
Q = [[1.0]]
initial_covariance = [[1.0]]
[encoding]
scheme = "innovation"
state_probability = 0.4
[legitimate]
link = { quality = 0.9 }
[eavesdroppers.spy]
strategy = "spy:Spy"
link = { quality = 0.9 }
"""
THEIRS = """
import sys

import emulator, peers, scenarios


def test_names_are_theirs_and_little_is_loaded():
    assert [one.NAME for one in (emulator, peers, scenarios)] == ["their emulator", "their peers", "their scenarios"]
    loaded = {name for name in sys.modules if name.partition(".")[0] in {"evedrop", "numpy", "zenoh", "pydantic"}}
    assert loaded <= {
        *("evedrop", "evedrop.cli", "evedrop.cli.pytest_plugin", "evedrop.scenario", "evedrop.scenario.discovery"),
        *("evedrop.counting", "evedrop.errors", "evedrop.system", "evedrop.system.disk", "evedrop.system.files"),
    }, loaded


def test_a_wire(evedrop_wire, tmp_path):
    sides = "[side.here]\\n[side.there]\\n[[link]]\\nname = 'all'\\nfrom = 'here'\\nto = 'there'\\n"
    (tmp_path / "wire.toml").write_text("seed = 1\\n" + sides)
    assert evedrop_wire(tmp_path / "wire.toml").endpoint("here")


def test_a_simulated_wire(evedrop_simulated_wire):
    radio = evedrop_simulated_wire(side=["here", "there"], link=[{"from": "here", "to": "there"}])
    radio.clock.sleep(600.0)
    assert radio.status().seconds > 600.0
"""
PROJECT = {
    "pyproject.toml": """
[tool.pytest.ini_options]
addopts = "--strict-markers --strict-config -p no:randomly -p no:hypothesispytest -p no:pytest_cov"
filterwarnings = ["error"]
""",
    "conftest.py": "import emulator\n",
    **{f"{name}/__init__.py": f"NAME = 'their {name}'\n" for name in FOLDERS},
    "scenarios/vehicle.toml": "[process]\ncommand = 'web'\n",
    "scenarios/spied.toml": SPIED,
    "scenarios/spy.py": "from evedrop.extend import Naive\n\n\nclass Spy(Naive):\n    pass\n",
    "tests/test_theirs.py": THEIRS,
}
"""A project with packages of the names of our folders, tests of its own, and a scenario with a class of its own."""


LOADED = ("dataclasses", "inspect", "random", "types")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The folder of this project, with files that pytest does not import, since it has loaded modules of these names."""
    for name, text in PROJECT.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    shadow(tmp_path, *LOADED)
    return tmp_path


def shadow(folder: Path, *names: str) -> None:
    """Put files with the names of modules into a folder; they end the process that imports them."""
    for name in names:
        (folder / f"{name}.py").write_text(f"raise SystemExit('their {name}.py was imported')\n")


def test_a_project_with_the_names_of_our_folders_runs_its_suite(installed: Installed, project: Path) -> None:
    """With all warnings as errors: its tests, a wire, and a live scenario whose class is asked and run in processes."""
    done = installed.python(project, "-m", "pytest", "-q", "--evedrop-out", "kept", "tests", "scenarios")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 passed" in done.stdout
    assert (project / "kept" / "spied" / "summary.json").exists()


@pytest.mark.long
def test_it_may_choose_how_pytest_imports_and_shares_work(installed: Installed, project: Path) -> None:
    """Modules imported by path, no cache, two workers: the same tests pass, and nothing of ours is in its tree."""
    for name in LOADED:  # a worker of xdist looks for modules where it starts
        (project / f"{name}.py").unlink()
    before = {path for path in project.rglob("*") if "__pycache__" not in path.parts}
    words = ("--import-mode=importlib", "-o", "pythonpath=.", "-p", "no:cacheprovider", "-n", "2", "tests")
    done = installed.python(project, "-m", "pytest", "-q", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout
    assert {path for path in project.rglob("*") if "__pycache__" not in path.parts} == before


def test_commands_import_no_file_of_the_folder_in_which_they_are_typed(installed: Installed, project: Path) -> None:
    """The built-in scenarios have their names there; workers and live processes import what is installed."""
    shadow(
        project, "json", "signal", "selectors", "statistics", "numpy", "zenoh", "pydantic", "sitecustomize", "evedrop"
    )
    listed = installed.python(project, "-m", "evedrop", "list")
    assert listed.returncode == 0, listed.stdout + listed.stderr
    assert "A patrolling vehicle and three eavesdroppers" in listed.stdout
    short = ("--slots", "20", "--set", "expect=[]")
    for words in (
        ("montecarlo", "vehicle", *short, "--trials", "4", "--workers", "2"),
        ("run", "vehicle", *short, "--view", "off"),
        ("test", "scenarios", "--in-memory", "--jobs", "2"),
    ):
        done = installed.python(project, "-m", "evedrop", *words)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "was imported" not in done.stdout + done.stderr


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

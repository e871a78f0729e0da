"""Who may import what: what a fresh process has loaded after each import."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

HOUSE = Path(__file__).parents[1]


def modules_of(folder: str) -> list[str]:
    """The modules under a folder."""
    paths = sorted((HOUSE / folder).rglob("*.py"))
    return [".".join(path.relative_to(HOUSE).with_suffix("").parts).removesuffix(".__init__") for path in paths]


def loaded_by(*modules: str) -> dict[str, set[str]]:
    """Module → what a fresh process has loaded besides Python itself once it, and those before it, are imported."""
    code = f"""
import importlib, json, sys
bare, found = set(sys.modules), {{}}
for name in {modules!r}:
    importlib.import_module(name)
    found[name] = [one for one in sys.modules if one not in bare]
print(json.dumps(found))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=HOUSE)
    return {module: set(names) for module, names in json.loads(ended.stdout).items()}


@cache
def installed() -> frozenset[str]:
    """The importable names of everything installed that is not ours."""
    return frozenset(packages_distributions()) - {"emulator", "peers", "scenarios"}


def packages(names: set[str]) -> set[str]:
    """The packages, not Python's own and not ours, that modules belong to."""
    return {name.partition(".")[0] for name in names} & installed()


def ours(names: set[str]) -> set[str]:
    """Our own parts among modules: such as evedrop.runs."""
    return {".".join(name.split(".")[:2]) for name in names if name.startswith(("emulator.", "peers."))}


def test_peers_and_network_stay_light() -> None:
    """Peers and network load zenoh, msgpack, numpy, cryptography, and neither view nor results nor scenarios."""
    for module, names in loaded_by(*modules_of("peers"), *modules_of("emulator/network")).items():
        assert packages(names) <= {"zenoh", "msgpack", "numpy", "cryptography", "_cffi_backend"}, module
        assert not ours(names) & {"evedrop.view", "evedrop.runs", "evedrop.scenario", "evedrop.api"}, module


def test_a_solver_is_loaded_by_who_uses_it_alone() -> None:
    """The strategy that needs one is part of the model, and registered in it, but loads it with its first controller."""
    names = loaded_by("evedrop.model.controllers")["evedrop.model.controllers"]
    assert "evedrop.model.controllers.mpc" in names
    assert not packages(names) & {"osqp", "scipy"}


THEORY = ("design", "markov", "theory")


def test_model_is_mathematics() -> None:
    """The model loads numpy, and cryptography for its streams: no network, no view, no scipy but in theory and design."""
    model = [name for name in modules_of("emulator/model") if name.rpartition(".")[2] not in THEORY]
    assert len(model) > 15
    for module, names in loaded_by(*model).items():
        assert packages(names) <= {"numpy", "cryptography", "_cffi_backend"}, module
        assert ours(names) <= {"evedrop.model", "evedrop.streams"}, module


def test_theory_may_use_scipy_and_no_more() -> None:
    """Theory and design load scipy besides, and still neither network nor view nor results."""
    for module, names in loaded_by(*(f"evedrop.model.{name}" for name in THEORY)).items():
        assert packages(names) <= {"numpy", "scipy", "cryptography", "_cffi_backend"}, module
        assert ours(names) <= {"evedrop.model", "evedrop.streams", "evedrop.errors"}, module


@pytest.mark.parametrize("module", ["evedrop.live.launch.launcher", "evedrop.memory.montecarlo", "evedrop.api"])
def test_launcher_and_memory_load_neither_zenoh_nor_rerun(module: str) -> None:
    """The launcher stays clear of what could hang, so that it can end it; Monte Carlo and the Python calls need neither."""
    assert not packages(loaded_by(module)[module]) & {"zenoh", "rerun", "matplotlib"}


def test_the_command_line_loads_nothing_to_say_help() -> None:
    """What `evedrop --help` loads is Python's own and ours."""
    assert packages(loaded_by("evedrop.cli.main")["evedrop.cli.main"]) == set()


def test_the_pytest_plugin_loads_nothing_but_pytest() -> None:
    """It is loaded in every project of an environment that has Evedrop in it."""
    found = loaded_by("pytest", "evedrop.pytest_plugin")
    more = found["evedrop.pytest_plugin"] - found["pytest"]
    assert packages(more) == set()
    assert ours(more) == {"evedrop.pytest_plugin", "evedrop.discovery", "evedrop.files"}


def test_only_the_view_loads_rerun_and_matplotlib() -> None:
    """No module outside the view loads either when it is imported."""
    outside = [
        name
        for folder in ("emulator/model", "emulator/network", "emulator/run", "peers")
        for name in modules_of(folder)
    ]
    for module, names in loaded_by(*outside).items():
        assert not packages(names) & {"rerun", "matplotlib"}, module

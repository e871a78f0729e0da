"""What a fresh process has loaded after each import. `make lint` checks which package may import which."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ELSEWHERE = {"peers": ROOT / "peers"}
"""Packages whose folder is not in `emulator/evedrop/`."""
SCIPY = "evedrop.model.theory."


def modules_of(package: str) -> list[str]:
    """The modules of a package. Raises AssertionError if there is no such package, so that no check becomes void."""
    folder = ELSEWHERE.get(package, ROOT / "emulator" / "evedrop" / package.replace(".", "/"))
    paths = sorted(folder.rglob("*.py"))
    assert paths, f"there is no package {package}"
    names = (path.relative_to(folder).with_suffix("").parts for path in paths)
    return [".".join(["evedrop", package, *name]).removesuffix(".__init__") for name in names]


def loaded_by(*modules: str) -> dict[str, set[str]]:
    """Module → what a fresh process has loaded besides Python itself once it, and those before it, are imported."""
    code = f"""
import importlib, json, sys
bare, loaded = set(sys.modules), {{}}
for name in {modules!r}:
    importlib.import_module(name)
    loaded.setdefault(name, [module for module in sys.modules if module not in bare])
print(json.dumps(loaded))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {module: set(names) for module, names in json.loads(ended.stdout).items()}


@cache
def installed() -> frozenset[str]:
    """The importable names of everything installed that is not ours."""
    return frozenset(packages_distributions()) - {"evedrop"}


def packages(names: set[str]) -> set[str]:
    """The packages, not Python's own and not ours, that modules belong to."""
    return {name.partition(".")[0] for name in names} & installed()


def ours(names: set[str]) -> set[str]:
    """Our own packages among modules: such as evedrop.live."""
    return {".".join(name.split(".")[:2]) for name in names if name.startswith("evedrop.")}


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """Module → what is loaded once it and those before it are: first the lightest, at last all that a live run may load.

    What comes before a module can only make a check of it stricter.
    """
    peers = (*modules_of("peers"), *modules_of("live.network"), *modules_of("live.protocol"))
    others = ("live", "simulate", "scenario", "score", "results")
    rest = (module for package in others for module in modules_of(package))
    return loaded_by("evedrop.model.controllers", *model(), *peers, "evedrop.live.recorder.recorder", *rest)


def test_a_wire_starts_without_what_only_its_report_needs() -> None:
    """Neither the templates of the page nor its charts."""
    assert not packages(loaded_by("evedrop.wire.run")["evedrop.wire.run"]) & {"jinja2", "matplotlib", "rerun"}


@pytest.fixture(scope="module")
def loaded_without_network() -> dict[str, set[str]]:
    """The same for what loads no Zenoh."""
    return loaded_by("evedrop.live.launch.launcher", "evedrop.simulate.montecarlo", "evedrop.cli.api")


MESSAGES = {"zenoh", "msgpack", "msgspec", "typing_extensions"}
"""What carries and checks messages; msgspec loads the last one where it is installed."""


def test_peers_and_network_stay_light(loaded: dict[str, set[str]]) -> None:
    """Peers, network and protocol load six packages and their own, and neither results nor the tables of scenarios."""
    modules = (*modules_of("peers"), *modules_of("live.network"), *modules_of("live.protocol"))
    for module in modules:
        names = loaded[module]
        assert packages(names) <= MESSAGES | {"numpy", "cryptography", "xxhash", "_cffi_backend"}, module
        assert ours(names) <= {
            f"evedrop.{name}"
            for name in ("live", "model", "peers", "scenario", "system", "counting", "names", "errors")
        }
        of_scenarios = {".".join(name.split(".")[:3]) for name in names if name.startswith("evedrop.scenario.")}
        assert of_scenarios <= {f"evedrop.scenario.{name}" for name in ("conformance", "plugins", "progress_events")}, (
            module
        )


def test_a_solver_is_loaded_only_when_a_controller_is_made(loaded: dict[str, set[str]]) -> None:
    """The strategy that needs a solver is registered with the others, and loads it with its first controller."""
    names = loaded["evedrop.model.controllers"]
    assert "evedrop.model.controllers" in names
    assert not packages(names) & {"osqp", "scipy"}


MATHEMATICS = {f"evedrop.{name}" for name in ("model", "system", "counting", "names", "errors")}
"""What the model may import."""


def model() -> list[str]:
    """The modules of the model that do without scipy, and without kernels that may not be built."""
    return [name for name in modules_of("model") if not name.startswith((SCIPY, "evedrop.model.kernels.compiled"))]


def test_model_is_mathematics(loaded: dict[str, set[str]]) -> None:
    """The model loads numpy, and xxhash for digests: no network, no view, no scipy outside theory."""
    assert len(model()) > 15
    for module in model():
        names = loaded[module]
        assert packages(names) <= {"numpy", "xxhash", "_cffi_backend"}, module
        assert ours(names) <= MATHEMATICS, module


def test_theory_may_use_scipy_and_no_more() -> None:
    """Theory loads scipy besides, and still neither network nor view nor results."""
    for module, names in loaded_by(*modules_of("model.theory")).items():
        assert packages(names) <= {"numpy", "scipy", "_cffi_backend"}, module
        assert ours(names) <= MATHEMATICS, module


@pytest.mark.parametrize("module", ["evedrop.live.launch.launcher", "evedrop.simulate.montecarlo", "evedrop.cli.api"])
def test_launcher_and_memory_load_neither_zenoh_nor_rerun(
    module: str, loaded_without_network: dict[str, set[str]]
) -> None:
    """The launcher stays clear of what could hang, so that it can end it; Monte Carlo and the Python calls need neither."""
    assert not packages(loaded_without_network[module]) & {"zenoh", "rerun", "matplotlib"}


STARTS = {
    "evedrop.live.launch.launcher": {"msgspec", "numpy", "xxhash", "pydantic", "tomli_w"},
    "evedrop.live.recorder.recorder": {
        "numpy",
        "xxhash",
        "pydantic",
        "cryptography",
        "zenoh",
        "msgpack",
        "msgspec",
        "pyarrow",
        "tomli_w",
    },
    "evedrop.live.network.operator": {"numpy", "xxhash", "cryptography", "zenoh", "msgpack", "msgspec"},
}
"""Module → the packages, besides those that these need themselves, whose imports a run's first slot or a command may wait for."""
THEIRS = {"pydantic_core", "annotated_types", "typing_extensions", "typing_inspection", "_cffi_backend", "cloudpickle"}
SLOW = {"http.server", "rich", "multiprocessing", "asyncio", "unittest", "concurrent.futures"}


@pytest.mark.parametrize("module", STARTS)
def test_a_run_starts_without_what_only_its_end_or_its_view_needs(
    module: str, loaded: dict[str, set[str]], loaded_without_network: dict[str, set[str]]
) -> None:
    """Neither scipy, nor the terminal's tables, nor a web server is loaded before the first slot."""
    names = loaded_without_network.get(module) or loaded[module]
    assert packages(names) - THEIRS <= STARTS[module] | {"_distutils_hack"}
    assert not names & SLOW


def test_the_command_line_loads_nothing_to_print_help() -> None:
    """`evedrop --help` loads only Python's own modules and ours."""
    assert packages(loaded_by("evedrop.cli.main")["evedrop.cli.main"]) == set()


def test_the_pytest_plugin_loads_nothing_but_pytest() -> None:
    """The plugin is loaded in every project whose environment contains Evedrop."""
    loaded = loaded_by("pytest", "evedrop.cli.pytest_plugin")
    more = loaded["evedrop.cli.pytest_plugin"] - loaded["pytest"]
    assert packages(more) == set()
    assert {name for name in more if name.startswith("evedrop.")} == {"evedrop.cli", "evedrop.cli.pytest_plugin"}


def test_only_view_and_paper_load_rerun_and_matplotlib(loaded: dict[str, set[str]]) -> None:
    """No module of the other packages loads Rerun or matplotlib when it is imported; theory is looked at above."""
    for module, names in loaded.items():
        assert not packages(names) & {"rerun", "matplotlib"}, module

"""Tests of the Dockerfile and of docker-compose.yml that need no Docker."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from evedrop.errors import UsageError
from evedrop.live.launch.compose import write_compose
from evedrop.scenario.loading import load
from tests.conftest import Evedrop
from tests.debian import ROOT


def test_the_base_image_is_pinned_by_a_digest() -> None:
    """Every stage builds upon one image that is named by version and digest, unless the user names another."""
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    (pinned,) = (line.removeprefix("ARG PINNED=") for line in lines if line.startswith("ARG PINNED="))
    assert re.fullmatch(r"python:3\.\d+\.\d+-slim-\w+@sha256:[0-9a-f]{64}", pinned)
    stages = [line.split()[1] for line in lines if line.startswith("FROM ")]
    assert stages == ["${EVEDROP_BASE:-${PINNED}}"] * 2
    assert "python:" not in (ROOT / "docker-compose.yml").read_text(), "the Dockerfile alone names it"


def test_the_image_is_built_from_all_that_the_package_contains() -> None:
    """The Dockerfile copies every folder of the wheel, the pages of `evedrop docs` too, and .dockerignore lets them through."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        folders = tomllib.load(file)["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"]
    assert "docs" in folders
    copied = re.findall(r"^COPY (\S+) /source/\1$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    let_through = (ROOT / ".dockerignore").read_text().splitlines()
    tops = {folder.split("/")[0] for folder in folders}
    assert [top for top in sorted(tops) if top not in copied or f"!{top}" not in let_through] == []


def test_the_shipped_services_are_those_that_the_command_writes(evedrop: Evedrop) -> None:
    """`evedrop brief two-eavesdroppers --compose` in a folder with a Dockerfile gives docker-compose.yml, byte for byte."""
    (evedrop.folder / "Dockerfile").touch()
    words = ("brief", "two-eavesdroppers", "--compose", ".")
    refused = evedrop(*words)
    assert (refused.status, refused.err) == (
        2,
        "evedrop: . is not empty; give another --compose DIR, or add --overwrite\n",
    )
    assert evedrop(*words, "--overwrite").out == "docker-compose.yml\n"
    assert (evedrop.folder / "docker-compose.yml").read_text() == (ROOT / "docker-compose.yml").read_text()


OWN = """
seed = 4
title = "Own"
slots = 20
network.routers = 2
[process]
A = [[0.9]]
Q = [[1.0]]
initial_covariance = [[1.0]]
[encoding]
scheme = "plain"
[legitimate.link]
quality = 0.9
[plant]
inputs = ["u"]
input_matrix = [[1.0]]
[controller]
strategy = "lqr"
state_weights = [1.0]
input_weights = [1.0]
"""
NAMES = ("view", "on", "e", "briefs", "eavesdropper-view", *(f"antenna-{number}" for number in range(8)))


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder for a scenario with controller, relay, and a dozen eavesdroppers, some with awkward names."""
    folder = tmp_path_factory.mktemp("own")
    tables = "".join(f'[eavesdroppers.{name}]\nstrategy = "naive"\nlink.quality = 0.5\n' for name in NAMES)
    (folder / "$own.toml").write_text(OWN + tables)
    written = write_compose(load(folder / "$own.toml"), str(folder / "$own.toml"), False, folder / "made", False)
    assert [path.name for path in written] == ["docker-compose.yml", "own.toml"]
    return folder / "made"


def services_of(folder: Path) -> dict[str, Any]:
    """The services of a docker-compose.yml, read as docker-compose does."""
    yaml = YAML(typ="safe")
    yaml.version = (1, 1)
    services: dict[str, Any] = yaml.load(folder / "docker-compose.yml")
    return services


def test_every_process_has_a_service_a_brief_and_a_network(own: Path) -> None:
    """Each service reaches only its router and has only its own brief; names are strings, and the scenario is the one given."""
    result = services_of(own)
    services = result["services"]
    mounts = [volume.split(":") for volume in services["briefs"]["volumes"][2:]]
    by_process = {path.rpartition("/")[2]: name for name, path in mounts}
    assert set(by_process) == {"router", "relay", "sensor", "legitimate", "controller", "recorder", *NAMES}
    assert set(by_process.values()) == set(result["volumes"])
    assert min(map(len, by_process.values())) > 1, "Compose v2 takes a letter and a colon for a drive of Windows"
    for process, name in by_process.items():
        volumes = services[name]["volumes"]
        assert volumes[0] == f"{name}:/brief:ro"
        assert len(volumes) == (2 if process == "recorder" else 1)
        role = "eavesdropper" if process in NAMES else process
        assert services[name]["command"][:2] == [role, "/brief/brief.json"]
        hub = "router" if process in {"sensor", "relay"} else "relay"
        assert hub in services[name]["depends_on"] or process == "router"
    networks: dict[str, set[str]] = {}
    for name, service in services.items():
        for network in service.get("networks", ()):
            networks.setdefault(network, set()).add(name)
    assert set(networks) == set(result["networks"])
    for process, name in by_process.items():
        hub = "router" if process in {"sensor", "relay"} else "relay"
        if process != "router":
            assert networks.pop(f"to-{name}") == {name, hub}
    assert networks == {"to-view": {"recorder", "view"}, "view": {"view", "finished"}}
    scenario = load(own / services["briefs"]["environment"]["EVEDROP_SCENARIO"][len("${EVEDROP_SCENARIO:-") : -1])
    assert set(scenario.eavesdroppers) == set(NAMES)


@pytest.mark.skipif(shutil.which("docker-compose") is None, reason="docker-compose is not installed")
def test_docker_compose_accepts_the_files(own: Path) -> None:
    """`docker-compose config` takes them, and names every service."""
    done = subprocess.run(
        ["docker-compose", "config", "--services"], cwd=own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) | {"finished"} == set(services_of(own)["services"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("two-eavesdroppers", "--listen", "tls/a:1"), "--listen belongs to briefs"),
        (("two-eavesdroppers", "--wait", "5"), "--wait belongs to briefs"),
        (("two-eavesdroppers", "--set", "shards=1", "--set", "secret_file=secret"), "secret_file = "),
        (("two-eavesdroppers", "--set", "shards=2", "--trials", "2"), "shards = 2"),
        (("restart",), "slot "),
        (("file/two.toml", "--slots", "7"), "file/two.toml is the scenario itself"),
    ],
)
def test_what_containers_cannot_run_is_refused(words: tuple[str, ...], message: str, evedrop: Evedrop) -> None:
    """The message is one sentence, and no file is written."""
    folder = evedrop.folder / "file"
    folder.mkdir()
    shutil.copy(ROOT / "scenarios" / "two-eavesdroppers.toml", folder / "two.toml")
    (evedrop.folder / "secret").write_bytes(bytes(32))
    done = evedrop("brief", *words, "--compose", "file", "--overwrite")
    assert done.status == 2
    assert done.err.startswith(f"evedrop: {message}"), done.err
    assert [path.name for path in folder.iterdir()] == ["two.toml"]


SHIPPED = load("two-eavesdroppers")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"modules": "/srv/here"}, r"^modules = /srv/here: .*evedrop brief SCENARIO --out DIR"),
        (
            {"process": SHIPPED.process.model_copy(update={"source": "zenoh"})},
            r"^process\.zenoh: no container can reach",
        ),
    ],
)
def test_what_the_image_lacks_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    """Classes of the user, and a program that gives the states; no folder is made."""
    with pytest.raises(UsageError, match=message):
        write_compose(SHIPPED.model_copy(update=changes), "two-eavesdroppers", False, tmp_path / "made", False)
    assert not (tmp_path / "made").exists()


def test_a_scenario_beside_its_files_is_used_as_it_is(evedrop: Evedrop) -> None:
    """With --overwrite in its own folder nothing but docker-compose.yml is written, and a change of options makes a copy."""
    shutil.copy(ROOT / "scenarios" / "two-eavesdroppers.toml", evedrop.folder / "mine.toml")
    before = (evedrop.folder / "mine.toml").read_bytes()
    assert evedrop("brief", "mine.toml", "--compose", ".", "--overwrite").out == "docker-compose.yml\n"
    assert (evedrop.folder / "mine.toml").read_bytes() == before
    done = evedrop("brief", "mine.toml", "--slots", "7", "--compose", "other")
    assert done.out.split() == ["other/docker-compose.yml", "other/mine.toml"]
    assert load(evedrop.folder / "other" / "mine.toml").slots == 7


@pytest.mark.parametrize(
    ("states", "losses", "outside"),
    [("../states.csv", "losses.csv", 0), ("states.csv", "../losses.csv", 1), ("linked.csv", "losses.csv", 0)],
)
def test_a_scenario_beside_its_files_needs_all_of_them(states: str, losses: str, outside: int, tmp_path: Path) -> None:
    """A file elsewhere, by its name or by a link, is in no container; another folder gets a copy of everything."""
    folder = tmp_path / "own"
    folder.mkdir()
    for place in (tmp_path, folder):
        (place / "states.csv").write_text("x\n" + "0.5\n" * 20)
        (place / "losses.csv").write_text("lost\n" + "1\n0\n" * 10)
    (folder / "linked.csv").symlink_to(tmp_path / "states.csv")
    text = OWN.partition("[plant]")[0].replace("network.routers = 2", "")
    text = text.replace("[encoding]", f'source = "file"\nstates = ["x"]\nstate_file = "{states}"\n[encoding]')
    text = text.replace("quality = 0.9", f'loss = {{ model = "trace", file = "{losses}", lost = "lost" }}')
    own = folder / "mine.toml"
    own.write_text(text)
    given = (load(own), str(own), False)
    with pytest.raises(UsageError, match=rf"mine\.toml names {re.escape((states, losses)[outside])}, which the"):
        write_compose(*given, folder, True)
    assert not (folder / "docker-compose.yml").exists()
    written = write_compose(*given, tmp_path / "copy", False)
    assert [path.name for path in written] == ["docker-compose.yml", "mine.toml", "states.csv"]
    own.write_text(text.replace((states, losses)[outside], ("states.csv", "losses.csv")[outside]))
    assert write_compose(*given, folder, True) == [folder / "docker-compose.yml"]

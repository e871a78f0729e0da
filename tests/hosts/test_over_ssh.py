"""`evedrop run --hosts` with every host in a network namespace, and an sshd on each: the same bits, and pulled cables."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from evedrop.results.crash_proof_tables import last_round
from evedrop.results.reading import Results
from evedrop.results.resolved_scenario import resolved
from evedrop.scenario.tables import Scenario
from tests.by_hand import as_if_undisturbed
from tests.conftest import wait_until, with_mark
from tests.hosts.lan import Lan, lan
from tests.hosts.test_hosts import on_hosts
from tests.privileged import CannotRun, skip
from tests.sshd import sshd

PORT = 7447
PLACES = {"alpha": ("router", "sensor", "legitimate"), "beta": ("eve",)}
"""Host → its processes; the recorder is on the host of the launcher."""


@contextmanager
def launched(folder: Path, scenario: Scenario) -> Iterator[tuple[Lan, subprocess.Popen[str]]]:
    """A network, and a run on it that a launcher starts over ssh."""
    text = ["[router]", 'listen = "tls/10.77.0.2:7447"']
    with lan("launcher", *PLACES) as network, ExitStack() as stack:
        for host, processes in PLACES.items():
            (folder / host / "temporary").mkdir(parents=True)
            address = network.addresses[host]
            try:
                server = stack.enter_context(sshd(folder / host, address, network.entering(host), 2222))
            except CannotRun as error:
                skip(error)
            script = folder / host / "evedrop.sh"
            program = shlex.join([sys.executable, "-m", "evedrop"])
            script.write_text(f'TMPDIR={folder}/{host}/temporary exec {program} "$@"\n')
            text = [f'ssh_config = "{server.config}"', *[line for line in text if not line.startswith("ssh_config")]]
            text += [f"[hosts.{host}]", f'address = "{address}"', f"processes = {json.dumps(processes)}"]
            text += [f'command = ["sh", {json.dumps(str(script))}]', "port = 2222"]
        # One client for both: the keys of alpha's server let it into beta, too.
        (folder / "beta" / "user.pub").write_text((folder / "alpha" / "user.pub").read_text())
        host_keys = [(folder / host / "known_hosts").read_text() for host in PLACES]
        client = (folder / "alpha" / "client").read_text()
        (folder / "known_hosts").write_text("".join(host_keys))
        (folder / "client").write_text(client.replace(f"{folder}/alpha/known_hosts", f"{folder}/known_hosts"))
        text[0] = f'ssh_config = "{folder}/client"'
        (folder / "hosts.toml").write_text("\n".join(text))
        (folder / "scenario.toml").write_text(resolved(scenario))
        (folder / "here").mkdir()
        command = [
            *network.entering("launcher"),
            "env",
            f"TMPDIR={folder}/here",
            sys.executable,
            "-m",
            "evedrop",
            "run",
        ]
        words = ["scenario.toml", "--hosts", "hosts.toml", "--view", "off", "--out", "run", "--json"]
        with subprocess.Popen(
            [*command, *words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as launcher:
            try:
                yield network, launcher
            finally:
                launcher.kill()


def under_way(folder: Path, launcher: subprocess.Popen[str]) -> None:
    """Wait until slots are on disk."""
    wait_until(lambda: launcher.poll() is not None or last_round(folder / "run").slots > 50, "a run under way", 90.0)
    assert launcher.poll() is None, launcher.communicate()[1]


def _is_free(place: Path) -> bool:
    return not with_mark(f"TMPDIR={place}")


def nothing_left(folder: Path) -> None:
    """No process and no file of a process is left on any host."""
    for host in (*PLACES, "here"):
        place = folder / host / "temporary" if host in PLACES else folder / host
        wait_until(partial(_is_free, place), f"no process left of {host}", 60.0)
        assert list(place.iterdir()) == []


def test_over_ssh_hosts_give_the_same_run(tmp_path: Path) -> None:
    """Also if a host is cut off for a while: the run goes on to the digests of an undisturbed one, and nothing is left."""
    scenario = on_hosts(slots=1500)
    with launched(tmp_path, scenario) as (network, launcher):
        under_way(tmp_path, launcher)
        network.unplug("beta")
        time.sleep(8.0)  # how long it is out is what is tested
        network.plug("beta")
        _, errors = launcher.communicate(timeout=120.0)
        assert launcher.returncode == 0, errors
        summary = Results.read(tmp_path / "run").summary
        as_if_undisturbed(summary, scenario, tmp_path / "memory")
        assert [outage["process"] for outage in summary["outages"]] == ["eve"]
        nothing_left(tmp_path)


def test_a_host_that_stays_away_is_named(tmp_path: Path) -> None:
    """Its cable is pulled for good: the run ends, says which host is gone, and the other host has no process left."""
    scenario = on_hosts(slots=100_000, longest_outage=8.0)
    with launched(tmp_path, scenario) as (network, launcher):
        under_way(tmp_path, launcher)
        network.unplug("beta")
        _, errors = launcher.communicate(timeout=120.0)
        assert launcher.returncode == 3, errors
        assert "host beta" in errors
        place = tmp_path / "alpha" / "temporary"
        wait_until(partial(_is_free, place), "no process left on alpha", 60.0)

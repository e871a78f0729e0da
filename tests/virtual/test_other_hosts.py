"""Runs with processes on other hosts in the simulated world."""

from __future__ import annotations

from dataclasses import replace

import pytest

from evedrop.cli.simulated import program
from evedrop.scenario.tables import Scenario
from evedrop.virtual import faults, host_faults
from evedrop.virtual.campaign import PlayedCase, play_case
from evedrop.virtual.cases import SimulatedCase, case_from, case_of
from evedrop.virtual.disturbance import Disturbance
from evedrop.virtual.drawn_hosts import MISTAKES, DrawnHost, DrawnHosts
from evedrop.virtual.host_parts import part_on
from evedrop.virtual.other_hosts import ODDITIES
from tests.virtual.disturbed_runs import RELAYED, SCENARIO, disturbed

HOSTS = DrawnHosts((DrawnHost("alpha", ("router", "sensor")), DrawnHost("beta", ("eve",))))
CONNECTS, GREETED, RUNS = 5, 30, 150
"""Events after which ssh connects, after which hosts have answered, and after which all processes are there."""


def played(*struck: Disturbance, hosts: DrawnHosts = HOSTS, scenario: Scenario = SCENARIO) -> PlayedCase:
    """The run on hosts with these faults."""
    return disturbed(*struck, hosts=hosts, scenario=scenario)


def test_a_run_on_hosts_is_the_run_in_memory() -> None:
    """Each process is on its host, which has its own fork server and folder; all hosts are left clean."""
    run = played().run
    assert (run.status, run.left) == (0, [])
    starts = {note.words[0]: note.process for note in run.happened if note.what == "starts"}
    assert starts["sensor"] == starts["router"] == "fork server of host alpha"
    assert starts["eve"] == "fork server of host beta"
    assert starts["legitimate"] == "fork server"


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        (faults.KillProcess("ssh of host beta", RUNS), 3, "eve was lost: the connection with host beta ended: "),
        (faults.KillProcess("sshd of host beta", RUNS), 3, "Connection to beta closed by remote host."),
        (faults.KillProcess("evedrop host of host beta", RUNS), 3, "the connection with host beta ended"),
        (faults.TerminateProcess("evedrop host of host beta", RUNS), 3, "the connection with host beta ended"),
        (faults.KillProcess("fork server of host beta", RUNS), 3, "the fork server on host beta ended"),
        (faults.StopProcess("evedrop host of host beta", RUNS), 0, ""),
        (faults.StopProcess("ssh of host beta", RUNS), 0, ""),
        (faults.StopProcess("sshd of host beta", RUNS), 0, ""),
        (faults.KillProcess("router", RUNS), 0, ""),
        (host_faults.CutSsh("connection of host beta", RUNS), 3, "host beta"),
        (host_faults.FreezeSsh("connection of host beta", RUNS, 3.0), 0, ""),
        (host_faults.UnplugHost("machine of host beta", RUNS, 3.0), 0, ""),
        (host_faults.UnplugHost("machine of host beta", RUNS), 3, "host beta"),
        (host_faults.LosePower("machine of host beta", RUNS), 3, "eve"),
        (host_faults.LosePower("machine of host alpha", RUNS), 3, "host alpha"),
        (host_faults.FillHostDisk("disk of host beta", GREETED), 3, "eve cannot be started"),
        (faults.KillProcess("ssh of host beta", CONNECTS), 2, "host beta: ssh ended with status -9; try `ssh beta"),
        (host_faults.LosePower("machine of host beta", CONNECTS), 2, "host beta: "),
    ],
    ids=str,
)
def test_a_run_ends_as_it_must(fault: Disturbance, status: int, said: str) -> None:
    """It names the host, and nothing is left on any of them."""
    run = played(fault).run
    assert (run.status, said in run.said) == (status, True), run.said


def test_a_host_that_is_cut_off_for_good_stays_so() -> None:
    """Whatever else happens to it for a moment."""
    run = played(
        *(host_faults.UnplugHost("machine of host beta", RUNS + some, 0.01 * some or None) for some in (0, 5))
    ).run
    assert (run.status, "host beta" in run.said) == (3, True), run.said


SHORT = Scenario({**SCENARIO.as_tables(), "longest_outage": 3.0})


@pytest.mark.parametrize("moment", range(RUNS, RUNS + 60, 10))
def test_a_short_silence_of_a_host_is_tolerated_whenever_it_begins(moment: int) -> None:
    """A little less than four fifths of the longest outage, between any two questions of ssh."""
    assert played(host_faults.FreezeSsh("connection of host beta", moment, 2.39), scenario=SHORT).run.status == 0


def test_ssh_gives_up_on_a_host_that_stays_silent() -> None:
    """When the question after the last one that may be without an answer is due."""
    fault = host_faults.FreezeSsh("connection of host beta", RUNS)
    silent = played(fault, scenario=SHORT)
    assert "server beta not responding" in silent.run.said
    assert 3.0 < silent.run.ends["ssh of host beta"][0] - silent.struck[fault] <= 4.0


def test_a_host_that_hears_nothing_from_the_beginning_ends() -> None:
    """The connection seems open, and not even the first heartbeat comes."""
    run = played(host_faults.FreezeSsh("connection of host beta", 6), hosts=DrawnHosts(HOSTS.hosts[1:])).run
    assert run.status == 2
    assert run.ended < 60.0
    assert 600.0 < run.seconds < 610.0


def test_the_fork_server_of_a_host_that_ends_takes_its_processes_along() -> None:
    """Those of other hosts end as after any failure."""
    happened = played(faults.KillProcess("fork server of host alpha", RUNS)).run.happened
    ends = {note.words[0]: note.words[1] for note in happened if note.what == "ends"}
    assert ends["sensor"] == ends["router"] == -9


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_hosts_file_with_a_mistake_names_it(mistake: str) -> None:
    """And nothing is started."""
    wrong = replace(HOSTS, mistake=mistake)
    if mistake == "no folder of classes":
        own = {"strategy": "evedrop.virtual.own_classes:Gate", "link": {"quality": 0.9}}
        scenario = Scenario({**SCENARIO.as_tables(), "eavesdroppers": {"eve": own}})
    else:
        scenario = RELAYED if MISTAKES[mistake].right.startswith("[relay]") else SCENARIO
    run = played(hosts=wrong, scenario=scenario).run
    assert run.status == 2
    assert MISTAKES[mistake].message in run.said
    assert not any(note.what == "starts" and "ssh" in str(note.words[0]) for note in run.happened)


def test_a_run_in_shards_stays_on_one_machine() -> None:
    """It says so."""
    run = played(scenario=Scenario({**SCENARIO.as_tables(), "trials": 2, "shards": 2})).run
    assert (run.status, "hosts carry one run" in run.said) == (2, True)


@pytest.mark.parametrize(
    ("oddity", "said"),
    [
        ("no evedrop", "host beta: sh: 1: exec: evedrop: not found; try `ssh beta evedrop --version`"),
        ("another version", "host beta: evedrop 0.0.1 is installed there"),
        ("refuses ssh", "host beta: ssh: connect to host beta port 22: Connection refused"),
        ("a shell that only talks", "host beta: "),
        ("a chatty shell", ""),
    ],
)
def test_a_host_that_cannot_be_used_is_named(oddity: str, said: str) -> None:
    """With a remedy, and nothing is started on the others; what a login shell prints does no harm."""
    hosts = DrawnHosts((HOSTS.hosts[0], DrawnHost("beta", ("eve",), oddity)))
    run = played(hosts=hosts).run
    assert (run.status == 0) == ODDITIES[oddity]
    assert said in run.said


@pytest.mark.campaign
def test_hosts_are_written_down() -> None:
    """With their oddities, mistakes and faults."""
    cases = [case for case in map(case_of, range(1, 400)) if case.hosts is not None]
    assert len(cases) > 20
    assert any(host.detailed for case in cases if case.hosts for host in case.hosts.hosts)
    for case in cases:
        assert case_from(case.to_text()) == case


def test_a_case_without_hosts_is_the_smallest() -> None:
    """Then those with fewer hosts, mistakes, oddities and processes; each is another one."""
    hosts = DrawnHosts(
        (DrawnHost("alpha", ("router", "sensor"), "a chatty shell", True), DrawnHost("beta", ("eve",))), "x"
    )
    smaller = [*hosts.smaller()]
    assert smaller[0] is None
    assert hosts not in smaller
    assert len({*smaller}) == len(smaller) > 6


def test_hosts_fit_a_smaller_scenario() -> None:
    """A host without processes is left out."""
    tables = {**SCENARIO.as_tables(), "eavesdroppers": {}}
    fitting = HOSTS.fitting(Scenario(tables))
    assert fitting == DrawnHosts((HOSTS.hosts[0],))
    assert DrawnHosts((DrawnHost("beta", ("eve",)),)).fitting(Scenario(tables)) is None


def test_a_part_has_the_name_of_its_host() -> None:
    """And a fault that hits nothing says so."""
    done = play_case(SimulatedCase(1, SCENARIO, (host_faults.CutSsh(part_on("connection", "beta"), RUNS),)), program)
    assert done.struck == {}

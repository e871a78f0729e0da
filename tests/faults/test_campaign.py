"""The campaign itself: some of its cases, and what they disturb."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from evedrop.results.reading import Results
from tests.faults.campaign import SKIPPED, Campaign
from tests.faults.cases import HASTY_SECONDS, PATIENT_SECONDS, Case, case_of
from tests.faults.disturbed import CLEANER, CONFUSED_FILE, FORK_SERVERS, disturbed
from tests.faults.facilities import Facilities
from tests.faults.kinds import EVERYBODY, KINDS, LIMITS
from tests.faults.moments import PHASES
from tests.faults.mutation import outcome_of
from tests.faults.studies import StudyCase
from tests.faults.variants import VARIANTS
from tests.faults.wires import WireCase
from tests.mutants import mutants

ROOT = Path(__file__).parents[2]
ENDURED, FAILED, INTERRUPTED, WIRE, STUDY = "326", "273", "190", "10", "34"
FULL, FULL_EARLY, EARLY, LITTLE = "70003", "70011", "70048", "70029"
WORDS = {
    ENDURED: "stop sensor 0.9 s",
    FAILED: "kill smart",
    INTERRUPTED: "terminate launcher",
    WIRE: "interrupt at 0.21 s; stop 1.5 s, terminate at",
    STUDY: "interrupt study at 0.14; interrupt study at",
    FULL: "fill the disk results at finish",
    FULL_EARLY: "shards: fill the disk results at run 0.07",
    LITTLE: "little memory: 1958",
    EARLY: "kill second fork server (shard 2) at run 0.06",
}
"""Case → its disturbance, on which its end depends."""


@pytest.mark.long
@pytest.mark.parametrize(
    "ends",
    [
        {FAILED: "failed by name"},
        {ENDURED: "as if undisturbed", INTERRUPTED: "interrupted"},
        {FULL: "", FULL_EARLY: "", EARLY: "failed by name", LITTLE: ""},  # whichever end: their results are looked at
        {WIRE: "as if undisturbed", STUDY: "as if undisturbed"},
    ],
    ids=["failed", "endured and interrupted", "full disks, before the first metrics, little memory", "wire and study"],
)
def test_cases_of_the_campaign_keep_what_is_promised(ends: dict[str, str]) -> None:
    """One of each end, as `make test-faults` runs them. `tests/live` does the same to runs in every `make test`."""
    command = [sys.executable, "-m", "tests.faults.campaign", "--seed", *ends]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    outcomes = {line.split()[0]: line for line in done.stdout.splitlines() if line.strip()}
    for case, end in ends.items():
        assert end in outcomes[case]
    assert f" in {len(ends)} runs, 0 with a miss" in done.stdout


@pytest.mark.long
def test_a_run_whose_router_confuses_keys_leaves_word_of_it(tmp_path: Path) -> None:
    """Otherwise the judge would not ask for the messages that were dropped."""
    with disturbed(VARIANTS["plain"], tmp_path, limits={"confused": 20}) as run:
        assert run.launcher.wait() == 0, run.text("stderr")
        assert (tmp_path / CONFUSED_FILE).exists()
        assert Results.read(run.out).summary["misdelivered"]


def test_a_number_is_always_the_same_case() -> None:
    """And all variants, kinds, targets and phases come, of live runs, wires and studies."""
    cases = [case_of(seed) for seed in range(600)]
    assert cases == [case_of(seed) for seed in range(600)]
    live = [case for case in cases if isinstance(case, Case) and not case.variant.hosts]
    faults = [fault for case in live for fault in case.faults]
    assert {case.variant.name for case in live} == set(VARIANTS)
    assert {case.longest_outage for case in live} == {PATIENT_SECONDS, HASTY_SECONDS}
    assert {fault.kind for fault in faults} == set(KINDS)
    assert {fault.moment.phase for fault in faults} == set(PHASES)
    processes = {*(name for variant in VARIANTS.values() for name in variant.processes), *FORK_SERVERS, CLEANER}
    assert {fault.target for fault in faults} == {*processes, "launcher", EVERYBODY, "results"}
    assert {fault.shard for fault in faults} == {0, 1}
    assert {type(case) for case in cases} == {Case, WireCase, StudyCase}
    assert [number for number, words in WORDS.items() if words not in str(case_of(int(number)))] == []
    wires = {fault.kind for case in cases if isinstance(case, WireCase) for fault in case.faults}
    assert wires == {"kill", "interrupt", "terminate", "hang up"}
    studies = {(fault.kind, fault.target) for case in cases if isinstance(case, StudyCase) for fault in case.faults}
    assert {("kill", "worker"), ("go on", "worker"), ("kill", "study"), ("interrupt", "study")} <= studies


def test_a_limited_run_has_no_other_fault_and_names_what_it_needs() -> None:
    """Nobody could tell which of them ended it."""
    cases = [case for case in map(case_of, range(600)) if isinstance(case, Case)]
    limited = [case for case in cases if any(fault.kind in LIMITS for fault in case.faults)]
    assert all(len(case.faults) == 1 for case in limited)
    assert {"a limit of processes", "a disk that breaks", "sshd"} == {need for case in cases for need in case.needs}
    assert {name for case in limited for name in case.limits} == {"processes", "memory"}


def test_a_case_whose_facility_is_missing_is_skipped_loudly(tmp_path: Path) -> None:
    """It is no miss, and no case that passed."""
    case = next(case for case in map(case_of, range(600)) if isinstance(case, Case) and case.needs)
    lacks = dict.fromkeys(case.needs, "there is no such thing here")
    verdict = Campaign(tmp_path, Facilities(small_disks=False, lacks=lacks)).carry_out(case)
    assert (verdict.outcome, verdict.misses, verdict.lack) == (SKIPPED, (), "there is no such thing here")
    assert "there is no such thing here" in str(verdict)


LOOKED_AT = {
    "module.ProgressLine": "cli/console.py",
    "event": "scenario/progress_events.py",
    "module.Brief": "live/protocol/brief.py",
    "module.SshHost": "live/launch/other_hosts.py",
    "host": "live/launch/other_hosts.py",
    "module.Publisher": "live/network/connection.py",
    "publisher": "live/network/connection.py",
    "other": "live/network/connection.py",
}
"""What the campaign looks at from within the launcher and the processes → the file that has it."""


def test_what_the_campaign_looks_at_is_there() -> None:
    """The attributes that it replaces or reads in the program have these names: a renamed one would only be missed in a run."""
    text = (Path(__file__).parent / "within" / "sitecustomize.py").read_text(encoding="utf-8")
    for owner, file in LOOKED_AT.items():
        attributes = set(re.findall(rf"\b{re.escape(owner)}\.(\w+)", text)) - {"heard", "key", "name"}
        assert attributes, owner
        program = (ROOT / "emulator" / "evedrop" / file).read_text(encoding="utf-8")
        for attribute in attributes:
            assert re.search(rf"def {attribute}\b|self\.{attribute}\b", program), (
                owner,
                attribute,
            )


def test_the_outcome_of_a_mutant_is_read_from_what_the_campaign_says(tmp_path: Path) -> None:
    """Noticed by a miss, by a run that nobody disturbed, or not at all."""
    mutant = mutants()[0]
    passed, missed = "     5  interrupted  1.0 s  plain: x", "    12  MISS  1.0 s  plain: y\n        rows are missing\n"
    outcomes = [outcome_of(mutant, text, 1.0, tmp_path) for text in (passed, f"{passed}\n{missed}", "REFUSED no")]
    assert [(outcome.noticed, outcome.cases) for outcome in outcomes] == [
        (None, 1),
        ("rows are missing", 2),
        ("undisturbed: no", 0),
    ]
    assert "NOT NOTICED" in str(outcomes[0])

"""Whatever happens to real processes happens in the simulated world, too."""

from __future__ import annotations

import pytest

from evedrop.virtual.cases import case_of
from evedrop.virtual.drawn_faults import KINDS
from evedrop.virtual.host_faults import HOST_KINDS
from evedrop.virtual.host_parts import host_of, part_of
from evedrop.virtual.rare_faults import RARE_KINDS
from tests.faults.cases import FAMILIES
from tests.faults.disturbed import CLEANER, FORK_SERVERS
from tests.faults.hosts import PARTS
from tests.faults.kinds import EVERYBODY, RESULTS
from tests.faults.kinds import KINDS as REAL_KINDS
from tests.faults.twins import (
    OF_CONNECTIONS,
    OF_FAMILIES,
    OF_HOSTED,
    OF_KINDS,
    OF_PARTS,
    OF_TARGETS,
    OF_VARIANTS,
    WITHOUT_TWIN,
)
from tests.faults.variants import HOSTED, VARIANTS
from tests.virtual.simulated import any_case


def test_everything_has_a_twin_or_a_reason() -> None:
    """Kinds of faults have one without exception."""
    assert set(OF_KINDS) == set(REAL_KINDS)
    real = {"launcher", EVERYBODY, RESULTS, *FORK_SERVERS, CLEANER, *PARTS, *VARIANTS, *HOSTED, *FAMILIES} - {"live"}
    paired = {*OF_TARGETS, *OF_PARTS, *OF_VARIANTS, *OF_HOSTED, *OF_FAMILIES}
    assert paired | {*WITHOUT_TWIN} == real
    assert not paired & {*WITHOUT_TWIN}
    assert all(WITHOUT_TWIN.values())


@pytest.mark.thorough
def test_all_twins_are_drawn() -> None:
    """And all other kinds of faults, at all targets, for all variants."""
    cases = [case_of(seed) for seed in range(1, 600)]
    faults = [fault for case in cases for fault in case.faults]
    assert (
        {type(fault) for fault in faults}
        == {*KINDS.values(), *HOST_KINDS.values(), *RARE_KINDS.values()}
        >= {*OF_KINDS.values()}
    )
    assert {*OF_CONNECTIONS.values()} <= {*HOST_KINDS.values()}
    assert {fault.target for fault in faults} >= {*OF_TARGETS.values()}
    assert {part_of(fault.target) for fault in faults if host_of(fault.target)} >= {*OF_PARTS.values()}
    assert {type(any_case(seed)) for seed in range(1, 30)} >= {*OF_FAMILIES.values()}
    for name, is_one in OF_VARIANTS.items():
        assert any(is_one(case.scenario) for case in cases), name
    for name, is_hosted in OF_HOSTED.items():
        assert any(map(is_hosted, cases)), name

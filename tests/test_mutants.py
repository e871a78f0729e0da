"""The mistakes that campaigns must notice fit the code."""

from __future__ import annotations

import pytest

from tests.mutants import PACKAGE, Mutant, mutants, mutated


@pytest.mark.parametrize("mutant", mutants(), ids=lambda mutant: mutant.breaks)
def test_every_mutant_fits_the_code(mutant: Mutant) -> None:
    """Its old text is in its file exactly once, and with its new text the file is still Python; a campaign must notice it."""
    text = (PACKAGE / mutant.file).read_text(encoding="utf-8")
    compile(mutated(mutant, text), mutant.file, "exec")
    assert mutant.seeds or mutant.simulated
    with pytest.raises(ValueError, match="2 times, not once"):
        mutated(mutant, 2 * text)


def test_no_two_mutants_have_the_same_description() -> None:
    """A mutant is found by its description."""
    names = [mutant.breaks for mutant in mutants()]
    assert len(names) == len(set(names))

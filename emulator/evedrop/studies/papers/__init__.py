"""Papers of the literature, reproduced: one file each, by their name in `evedrop paper`.

To add one, write a class and add it to `PAPERS`; its page is docs/papers/NAME.md.
"""

from __future__ import annotations

from collections.abc import Mapping

from evedrop.errors import UsageError
from evedrop.studies.papers.crimson2023 import Crimson2023
from evedrop.studies.papers.kennedy2022 import Kennedy2022
from evedrop.studies.papers.luecke2022 import Luecke2022
from evedrop.studies.papers.naha2021 import Naha2021
from evedrop.studies.papers.reproduction import Paper, Progress, Reproduction, silent
from evedrop.system.hints import near

PAPERS: Mapping[str, type[Paper]] = {
    "kennedy2022": Kennedy2022,
    "luecke2022": Luecke2022,
    "crimson2023": Crimson2023,
    "naha2021": Naha2021,
}
"""Name on the command line → paper, in the order of the list."""


def paper(name: str) -> type[Paper]:
    """A paper by its name. Raises UsageError if no paper has this name."""
    if name not in PAPERS:
        hint = near(name, PAPERS) or f"; expected one of {', '.join(PAPERS)}"
        raise UsageError(f"paper {name}: no such paper{hint}")
    return PAPERS[name]


def reproduce(name: str, quick: bool = False, progress: Progress = silent) -> Reproduction:
    """Compute every number of a paper. quick: small sizes; progress receives a line for each step.

    Raises UsageError if there is no such paper.
    """
    paper_class = paper(name)
    return Reproduction(
        name,
        paper_class.title,
        paper_class.authors,
        paper_class.published,
        quick,
        tuple(paper_class().rows(quick, progress)),
    )

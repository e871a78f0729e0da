"""The paper that this project starts from: every number that it prints.

Source: docs/errata.md; docs/papers/kennedy2022.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

from evedrop.studies.papers import microgrid, numerical
from evedrop.studies.papers.numbers import microgrid_application, numerical_illustration
from evedrop.studies.papers.paper import Paper, Progress
from evedrop.studies.papers.reproduction import PublishedNumber


@final
class Kennedy2022(Paper):
    """Innovation-based secrecy without acknowledgements; all numbers come from theory, so `quick` changes nothing."""

    title = "Innovation-Based Remote State Estimation Secrecy with no Acknowledgments"
    authors = "J. M. Kennedy, J. J. Ford, D. E. Quevedo, F. Dressler"
    published = "arXiv 2212.08234, 2022"
    text_read = True

    def rows(self, quick: bool, progress: Progress) -> Iterator[PublishedNumber]:  # noqa: ARG002 - there is nothing to shorten
        """The numbers of the numerical illustration and of the microgrid; `evedrop figures` draws their figures."""
        progress("numerical illustration")
        yield from numerical_illustration(numerical.designs())
        progress("microgrid")
        yield from microgrid_application(microgrid.theory(microgrid.DAY))

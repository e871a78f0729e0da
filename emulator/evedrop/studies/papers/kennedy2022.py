"""The paper that this project starts from: every number that it prints.

Source: docs/errata.md; docs/papers/kennedy2022.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

from evedrop.studies.papers import microgrid, numerical
from evedrop.studies.papers.numbers import Number, microgrid_application, numerical_illustration
from evedrop.studies.papers.paper import Paper, Progress
from evedrop.studies.papers.reproduction import NumberVerdict, PublishedNumber


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
        for number in numerical_illustration(numerical.designs()):
            yield _row(number)
        progress("microgrid")
        for number in microgrid_application(microgrid.theory(microgrid.DAY)):
            yield _row(number)


_VERDICTS = {
    "agree": NumberVerdict.AGREES,
    "erratum": NumberVerdict.ERRATUM,
    "not checkable": NumberVerdict.NOT_COMPARABLE,
}


def _row(number: Number) -> PublishedNumber:
    kind, _, reason = number.verdict.partition(": ")
    try:
        theirs, ours = float(number.paper), float(number.ours)
    except ValueError:
        return PublishedNumber.stated(number.where, number.what, number.paper, number.ours, _VERDICTS[kind], reason)
    digits = len(number.paper.partition(".")[2])
    return PublishedNumber.compared(
        number.where, number.what, theirs, ours, absolute=0.5 * 10.0**-digits, erratum=reason
    )

"""Writes the results of tests as JUnit XML, which every CI server reads.

Source: docs/testing.md.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from evedrop.errors import UsageError
from evedrop.show.report.page import printable
from evedrop.studies.scenario_tests import Finding, Outcome
from evedrop.system.files import check_writable


def check_junit(path: Path) -> None:
    """Raise UsageError if no report can be written there; makes its folder."""
    with _named(path):
        check_writable(path)


def write_junit(path: Path | None, tested: Sequence[Finding], started: float) -> None:
    """Write a report if there is a path; started: seconds since the epoch. Raises UsageError if it cannot be written."""
    if path is not None:
        with _named(path):
            path.write_bytes(junit_of(tested, started))


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Make the folder of a report; an error in the block names the report."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another --junit") from error


def junit_of(tested: Sequence[Finding], started: float) -> bytes:
    """The report: one test suite, with a test case for each scenario. A failed expectation is a failure, all else an error."""
    failures = sum(finding.outcome is Outcome.FAILED for finding in tested)
    errors = sum(finding.outcome in {Outcome.MISTAKES, Outcome.BROKEN} for finding in tested)
    counts = {
        "name": "evedrop",
        "tests": str(len(tested)),
        "failures": str(failures),
        "errors": str(errors),
        "skipped": "0",
        "time": f"{sum(finding.seconds for finding in tested):.3f}",
    }
    suites = ET.Element("testsuites", counts)
    when = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(started))
    suite = ET.SubElement(suites, "testsuite", {**counts, "timestamp": when})
    for finding in tested:
        _add(suite, finding)
    ET.indent(suites, " ")
    return bytes(ET.tostring(suites, encoding="utf-8", xml_declaration=True)) + b"\n"


def _add(suite: ET.Element, tested: Finding) -> None:
    path = Path(tested.scenario)
    where = ".".join(path.with_suffix("").parts[:-1]) or "scenarios"
    case = ET.SubElement(
        suite,
        "testcase",
        {"classname": printable(where), "name": printable(path.stem), "time": f"{tested.seconds:.3f}"},
    )
    attributes = {"seed": tested.seed, "results": tested.folder, "report": tested.report, "verdict": tested.verdict}
    if any(value is not None for value in attributes.values()):
        properties = ET.SubElement(case, "properties")
        for name, value in attributes.items():
            if value is not None:
                ET.SubElement(properties, "property", {"name": name, "value": printable(str(value))})
    if tested.outcome is not Outcome.PASSED:
        kind = "failure" if tested.outcome is Outcome.FAILED else "error"
        message = tested.reasons[0] if tested.reasons else ""
        failure = ET.SubElement(case, kind, {"message": printable(message), "type": tested.outcome.name.lower()})
        failure.text = printable("\n".join((*tested.reasons, *tested.story.splitlines())))

"""Writes the results of tests as JUnit XML, which every CI server reads.

Source: docs/testing.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from evedrop.errors import UsageError
from evedrop.show.report.page import printable
from evedrop.studies.scenario_tests import Finding, Outcome


def write_junit(path: Path, tested: Sequence[Finding], started: float) -> None:
    """Write a report; started: seconds since the epoch. Raises UsageError if it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(junit_of(tested, started))
    except OSError as error:
        raise UsageError(f"{path} cannot be written ({error.strerror}); give another --junit") from error


def junit_of(tested: Sequence[Finding], started: float) -> bytes:
    """The report: one test suite, with a test case for each scenario. A failed expectation is a failure, all else an error."""
    failures = sum(one.outcome is Outcome.FAILED for one in tested)
    errors = sum(one.outcome in {Outcome.MISTAKES, Outcome.BROKEN} for one in tested)
    counts = {
        "name": "evedrop",
        "tests": str(len(tested)),
        "failures": str(failures),
        "errors": str(errors),
        "skipped": "0",
        "time": f"{sum(one.seconds for one in tested):.3f}",
    }
    suites = ET.Element("testsuites", counts)
    when = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(started))
    suite = ET.SubElement(suites, "testsuite", {**counts, "timestamp": when})
    for one in tested:
        _add(suite, one)
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
    known = {"seed": tested.seed, "results": tested.folder, "report": tested.report}
    if any(value is not None for value in known.values()):
        properties = ET.SubElement(case, "properties")
        for name, value in known.items():
            if value is not None:
                ET.SubElement(properties, "property", {"name": name, "value": printable(str(value))})
    if tested.outcome is not Outcome.PASSED:
        kind = "failure" if tested.outcome is Outcome.FAILED else "error"
        message = tested.reasons[0] if tested.reasons else ""
        said = ET.SubElement(case, kind, {"message": printable(message), "type": tested.outcome.name.lower()})
        said.text = printable("\n".join(tested.reasons))

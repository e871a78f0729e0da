"""CITATION.cff lists the paper behind every scheme and every paper that Evedrop recomputes."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml

from evedrop.model.schemes import SCHEMES
from evedrop.studies.papers import PAPERS

ROOT = Path(__file__).parents[2]
FILE: dict[str, Any] = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
WITHOUT_A_PAPER = {"plain", "cipher", "twin-track"}
"""Schemes that are common knowledge, or proposals of this project."""


def test_every_reference_can_be_found() -> None:
    """It has a title, a year, authors, and says what it is cited for."""
    for reference in FILE["references"]:
        assert {"title", "year", "authors", "notes"} <= set(reference), reference
        assert all({"given-names", "family-names"} <= set(author) for author in reference["authors"])


def test_every_scheme_has_its_paper() -> None:
    """In the notes of a reference, or in the message."""
    notes = " ".join(
        [FILE["message"].replace("partial encryption", "partial-encryption")]
        + [reference["notes"] for reference in FILE["references"]]
    )
    assert {name for name in SCHEMES if re.search(rf"\b{name}\b", notes)} == set(SCHEMES) - WITHOUT_A_PAPER


def test_every_recomputed_paper_is_there() -> None:
    """By its number at arXiv, or by its DOI."""
    there = {reference.get("doi") for reference in FILE["references"]}
    there |= {
        key["value"].removeprefix("arXiv:")
        for reference in FILE["references"]
        for key in reference.get("identifiers", ())
    }
    for paper in PAPERS.values():
        wanted = set(re.findall(r"arXiv (\d{4}\.\d{5})|doi (10\.[\w./]+)", paper.published))
        assert wanted
        assert {doi or other for doi, other in wanted} <= there, paper.published


def test_what_is_not_released_is_not_said_to_be_stable() -> None:
    """The version is that of the package, whose status is alpha."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert FILE["version"] == project["version"]
    assert "not been released" in FILE["message"]
    assert "## Unreleased" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "Development Status :: 3 - Alpha" in project["classifiers"]

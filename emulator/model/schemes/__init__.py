"""Schemes by their name in a scenario: one file each."""

from __future__ import annotations

from collections.abc import Mapping

from emulator.model.schemes.innovation import Innovation
from emulator.model.schemes.plain import Plain
from emulator.model.schemes.scheme import Scheme

SCHEMES: Mapping[str, type[Scheme]] = {"innovation": Innovation, "plain": Plain}

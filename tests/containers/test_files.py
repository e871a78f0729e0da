"""What the files of the image and of its services must say, whatever Docker there is."""

from __future__ import annotations

import re

from tests.containers.base import ROOT


def test_the_base_image_is_pinned_by_a_digest() -> None:
    """Every stage builds upon one image that is named by version and digest, unless the user names another."""
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    (pinned,) = (line.removeprefix("ARG PINNED=") for line in lines if line.startswith("ARG PINNED="))
    assert re.fullmatch(r"python:3\.\d+\.\d+-slim-\w+@sha256:[0-9a-f]{64}", pinned)
    stages = [line.split()[1] for line in lines if line.startswith("FROM ")]
    assert stages == ["${EVEDROP_BASE:-${PINNED}}"] * 2
    assert "python:" not in (ROOT / "docker-compose.yml").read_text(), "the Dockerfile alone names it"

"""`evedrop selftest`: whether this machine computes the golden digests."""

from __future__ import annotations

import argparse

from evedrop.cli.command import command
from evedrop.errors import RunError


@command(section="inspect", example="selftest", page="install")
def selftest(_: argparse.Namespace) -> int:
    """Check this machine against reference digests."""
    from evedrop.cli.selftest import GOLDEN, selftest

    check = selftest()
    for name, value in check.machine.items():
        print(f"{name:<16}{value}")
    for name, digest in check.digests.items():
        print(f"{name:<16}{digest}  {'golden' if GOLDEN.get(name) == digest else 'NOT the golden digest'}")
    if not check.passed:
        raise RunError("this machine does not compute the golden digests; please report the lines above")
    print("passed: this machine computes the expected digests")
    return 0


COMMANDS = (selftest,)

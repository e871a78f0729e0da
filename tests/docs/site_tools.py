"""The modules of tools/site, which are not in a package: MkDocs finds them by PYTHONPATH."""

from __future__ import annotations

import importlib
import sys
from typing import Any

from tests.docs.consoles import ROOT

FOLDER = ROOT / "tools" / "site"


def site_tool(name: str) -> Any:
    """A module of tools/site."""
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))
    return importlib.import_module(name)

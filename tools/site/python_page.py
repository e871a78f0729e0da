"""The page of the Python module `evedrop`: its functions first, then the classes of what they take and return."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import evedrop
from evedrop import EvedropError

_HEAD = """# The module `evedrop`

```python
from evedrop import Scenario, run, montecarlo, compare
```

These names, and those of [`evedrop.extend`](extend.md), are public; all other modules may change in any version.
[From Python](../python.md) has examples.
"""
_ELSEWHERE = {"wire": "evedrop.wire.running.wire"}
"""Names that are also those of packages → where the object is."""
_OF_SCENARIO = ("load", "replace", "to_toml", "as_tables")


def python_page() -> str:
    """The page in Markdown, with a directive of mkdocstrings for each name."""
    groups: dict[str, list[str]] = {"Functions": [], "Scenario and settings": [], "Results": [], "Errors": []}
    for name in evedrop.__all__:
        groups[_group(name)].append(name)
    parts = [_HEAD]
    for title, names in groups.items():
        parts += [f"## {title}\n", *(line for name in names for line in _directive(name))]
    return "\n".join(parts)


def _group(name: str) -> str:
    value = getattr(evedrop, name)
    if not inspect.isclass(value):
        return "Functions"
    if issubclass(value, EvedropError):
        return "Errors"
    return "Results" if name.endswith("Results") else "Scenario and settings"


def _directive(name: str) -> Iterator[str]:
    yield f"::: {_ELSEWHERE.get(name, f'evedrop.{name}')}"
    yield "    options:"
    yield "      heading_level: 3"
    yield "      show_root_heading: true"
    yield "      show_root_toc_entry: true"
    yield "      show_root_full_path: false"
    if name == "Scenario":  # its keywords are the keys of a scenario, which have a page
        yield f"      members: {list(_OF_SCENARIO)}"
    yield ""

"""An extension of Griffe: examples in docstrings, which begin with >>>, become code blocks, and named pages become links."""

from __future__ import annotations

import re
from typing import Any

from doc_links import linked
from griffe import Extension, Object

_EXAMPLE = re.compile(r"(?:^>>> .*\n?(?:^(?!\s*$).*\n?)*)+", re.MULTILINE)


class Doctests(Extension):
    """Puts a fence around each example, and links pages."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """For the docstring of an object."""
        if obj.docstring is not None:
            obj.docstring.value = linked(_EXAMPLE.sub(_fenced, obj.docstring.value), "../")


def _fenced(match: re.Match[str]) -> str:
    code = re.sub(r" +# doctest: .*", "", match[0].rstrip())
    return f"```python\n{code}\n```\n"

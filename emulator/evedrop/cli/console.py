"""The console that draws tables and the progress line: its styles reach the terminal, control characters in its text do not."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from evedrop.system.output import escaped


class StyledConsole(Console):
    """A console that escapes control characters in all text, and writes its own styles past the escaping of `Output`."""

    def __init__(self, file: Any, **named: Any) -> None:
        """Draw on a stream; named: as for Rich's own console."""
        super().__init__(file=getattr(file, "styled", file), **named)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The pieces of text of what is drawn; Rich measures and cuts them afterwards."""
        return _escaped(super().render(renderable, options))


def _escaped(segments: Iterable[Segment]) -> Iterator[Segment]:
    for segment in segments:
        yield segment if segment.control else Segment(escaped(segment.text), segment.style)

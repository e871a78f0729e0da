"""The scenario's title, in the first line of the view."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import rerun as rr
import rerun.blueprint as rrb

from evedrop.show.view.column import Column
from evedrop.show.view.panels.heights import TITLE_HEIGHT
from evedrop.show.view.panels.panel import PlacedView, ViewPanel
from evedrop.show.view.scene import SceneSlots

_PATH = "title"


@final
class Title(ViewPanel):
    """A line over the whole width: the title, and which trials the panels show."""

    def views(self) -> Iterator[PlacedView]:
        """One view without a title bar."""
        yield PlacedView(rrb.TextDocumentView(origin=_PATH, titlebar=False), "title", height=TITLE_HEIGHT)

    def styles(self) -> dict[str, rr.TextDocument]:
        """The text, which does not change."""
        trials = self.scene.trials
        of = "" if trials == 1 else f" · curves: means of {trials:,} trials, everything else: the first of them"
        return {_PATH: rr.TextDocument(f"**{_plain(self.scene.title)}**{of}", media_type="text/markdown")}

    def columns(self, slots: SceneSlots) -> Iterator[Column]:
        """Nothing: the title is a style."""
        del slots
        yield from ()


def _plain(text: str) -> str:
    """The text with every character of Markdown escaped."""
    return "".join(f"\\{character}" if character in "\\`*_{}[]()<>#+-.!|~$" else character for character in text)

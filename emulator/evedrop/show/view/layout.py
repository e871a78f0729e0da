"""The layout of a recording: the names of its tabs and panels, and the same layout with only one of them.

A layout is a blueprint as Rerun's viewer gives it and takes it back: path → archetype → field. A name is the beginning of the
title that the view shows, in the form in which somebody types it: `state-plane` for "State plane   ellipses: 2σ reported", and
the name of the receiver for the world as it believes it.

Source: docs/view.md, pictures.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Any, final

from evedrop.errors import UsageError
from evedrop.scenario.words import listed
from evedrop.system.hints import near

Blueprint = dict[str, dict[str, dict[str, Any]]]

_VIEWPORT, _ROOT = "/viewport", "root_container"
_CONTAINER, _VIEW = "ContainerBlueprint", "ViewBlueprint"
_END_OF_TITLE = re.compile(r"   |[:,;]| since | in the ")  # an explanation follows
_OTHER_WORDS = re.compile(r"\([^)]*\)|^the |^an? | believes$")


@final
class Layout:
    """The tabs and panels of a recording."""

    def __init__(self, blueprint: Blueprint) -> None:
        self._blueprint = blueprint
        self._root = f"/container/{blueprint[_VIEWPORT]['ViewportBlueprint'][_ROOT]}"
        self._parents = {child: path for path in self._below(self._root) for child in self._children(path)}
        self._paths: dict[str, str] = {}
        shown = list[object]()
        for path in sorted(self._below(self._root), key=self._is_view):
            if (name := self._name(path)) and (content := self._content(path)) not in shown:
                shown.append(content)
                self._paths[_free(name, self._paths)] = path

    @property
    def names(self) -> list[str]:
        """The names of the tabs, then those of the panels in the order of the layout."""
        return list(self._paths)

    def alone(self, name: str | None) -> Blueprint:
        """The layout with only this panel, or with only this tab and what all tabs share; None: the tab that is open.

        Raises UsageError if there is no such panel.
        """
        path = self._root if name is None else self._path(as_typed(name))
        if path is None:
            raise UsageError(
                f"--panel {name} is not a panel of this recording; give {listed(self.names)}"
                f"{near(as_typed(str(name)), self._paths)}"
            )
        changed = deepcopy(self._blueprint)
        if self._is_view(path):
            changed[self._root][_CONTAINER] = {"container_kind": "Vertical", "contents": [path[1:]]}
        else:
            self._open(path, changed)
        reached = set(Layout(changed)._below(self._root))
        return {path: parts for path, parts in changed.items() if _owner(path) is None or _owner(path) in reached}

    def _path(self, name: str) -> str | None:
        """The path of this name, or of the only name that begins with it."""
        begun = [name] if name in self._paths else [other for other in self._paths if other.startswith(name)]
        return self._paths[begun[0]] if len(begun) == 1 else None

    def _open(self, path: str, changed: Blueprint) -> None:
        """Leave a single one of some tabs: that of this container, and otherwise the one that is open."""
        chosen = {path, *self._above(path)}
        for tabs in self._below(self._root):
            part = self._blueprint[tabs].get(_CONTAINER, {})
            if part.get("container_kind") == "Tabs":
                child = next((child[1:] for child in self._children(tabs) if child in chosen), part["active_tab"])
                changed[tabs][_CONTAINER] = {"container_kind": "Vertical", "contents": [child]}

    def _name(self, path: str) -> str:
        """What a user types for a path; empty for a container without a title."""
        part = self._blueprint[path][_VIEW if self._is_view(path) else _CONTAINER]
        return as_typed(part.get("display_name") or part.get("space_origin", ""))

    def _content(self, path: str) -> object:
        """Equal for views that show the same."""
        if not self._is_view(path):
            return path
        return self._blueprint[path], self._blueprint.get(f"{path}/ViewContents")

    def _is_view(self, path: str) -> bool:
        return _VIEW in self._blueprint[path]

    def _children(self, path: str) -> Iterator[str]:
        if not self._is_view(path):
            contents = self._blueprint[path][_CONTAINER].get("contents", [])
            yield from (f"/{child}" for child in ([contents] if isinstance(contents, str) else contents))

    def _below(self, path: str) -> Iterator[str]:
        """A path and all below it, in the order of the layout."""
        yield path
        for child in self._children(path):
            yield from self._below(child)

    def _above(self, path: str) -> Iterator[str]:
        while path in self._parents:
            path = self._parents[path]
            yield path


def as_typed(title: str) -> str:
    """The name of a panel with this title; a name itself is not changed."""
    words = _OTHER_WORDS.sub("", _END_OF_TITLE.split(title.lower().strip())[0].strip())
    return re.sub(r"[^\w]+", "-", words).strip("-")


def _free(name: str, taken: Mapping[str, str]) -> str:
    """The name, with a number if it is taken."""
    numbered = (f"{name}-{number}" for number in range(2, len(taken) + 3))
    return next(free for free in (name, *numbered) if free not in taken)


def _owner(path: str) -> str | None:
    """The view or container that a path of a blueprint is about; None for the panels around them."""
    match = re.match(r"/(?:view|container)/[^/]+", path)
    return None if match is None else match[0]

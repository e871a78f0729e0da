"""Pairs of methods, one for a block of slots and one for a single slot: a class writes one of them and is given the other.

Source: docs/your-own.md, many slots at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

Written = TypeVar("Written", bound=Callable[..., Any])


def complete(kind: type, base: type, block: str, single: str, of_one: Callable[[Any], Any], *others: str) -> None:
    """Give a class the method of a pair that it does not write; block, single: the names of the two.

    A class that changes `single`, or one of `others`, after it inherited `block` has the `block` of `base`, which calls `single`
    for each slot. A class that writes `block` alone, and inherits no `single`, has that of a block of one: of_one makes it.
    """
    if outdated(kind, block, single, *others):
        setattr(kind, block, getattr(base, block))
    elif getattr(kind, single) is getattr(base, single) and getattr(kind, block) is not getattr(base, block):
        setattr(kind, single, of_one(getattr(kind, block)))


def needed(method: Written) -> Written:
    """A method for a single slot that a class must have: abstract, unless the class writes the one for blocks of slots.

    Type checkers, which do not know of `complete`, take it for an ordinary method.
    """
    setattr(method, "__isabstractmethod__", True)  # noqa: B010 - mypy refuses the assignment
    return method


def outdated(kind: type, block: str, *single: str) -> bool:
    """Whether a class changes what happens in a single slot after it inherited the method for blocks of slots.

    block: the name of that method; single: the names of the methods for a single slot.
    """
    newest = next(one for one in kind.__mro__ if vars(one).keys() & {block, *single})
    return block not in vars(newest)

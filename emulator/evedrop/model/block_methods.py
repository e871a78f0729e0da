"""Methods that take many slots at once, and the subclasses that must not inherit them.

Source: docs/your-own.md, many slots at once.
"""

from __future__ import annotations


def outdated(kind: type, block: str, *single: str) -> bool:
    """Whether a class changes what happens in a single slot after it inherited the method for blocks of slots.

    block: the name of that method; single: the names of the methods for a single slot.
    """
    newest = next(one for one in kind.__mro__ if vars(one).keys() & {block, *single})
    return block not in vars(newest)

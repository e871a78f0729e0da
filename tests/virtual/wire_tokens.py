"""Says which liveliness tokens must be seen at the sides of a simulated wire, and which must not.

Source: docs/maintainers/simulated-world.md; docs/wire/semantics.md, liveliness.
"""

from __future__ import annotations

from collections.abc import Iterator

import zenoh

from evedrop.virtual.zenoh.access import intersects
from evedrop.wire.liveliness import joined
from evedrop.wire.plan import WirePlan
from tests.virtual.wire_programs import Course, WireProgram

_STEADY_SECONDS = 3.0
"""For which programs and wire must be there together, so that all tokens are known."""


def wrong_tokens(plan: WirePlan, course: Course, end: float) -> Iterator[str]:
    """A token is seen at the sides at which it must be, and nowhere else; end: of the first start, in virtual seconds."""
    to = joined(plan)
    held = [(program, token) for program, *_ in course.here for token in program.tokens()]
    blinks = [(program, token) for program, *_ in course.here for token in program.objects("blink")]
    shown = {(side, token) for program, token in [*held, *blinks] for side in (program.side, *to[program.side])}
    if strange := sorted(course.alive - shown):
        yield f"{len(strange)} tokens are seen where they must not be, such as {strange[0]}"
    steady = {
        program.side: program
        for program, since, until in course.here
        if since + _STEADY_SECONDS < end and (not until or until[0] > since + _STEADY_SECONDS)
    }
    together = max((since for _, since, _ in course.here), default=0.0) + _STEADY_SECONDS
    if together > min((until[0] for *_, until in course.here if until), default=end) or together > end:
        return
    for holder in steady.values():
        for token in holder.tokens():
            others = [program.side for program, same in held if same == token and holder.side in to[program.side]]
            for side in to[holder.side]:
                lets = side in steady and _watches(steady[side], token) and _lets(plan, side, holder.side, token)
                # Of a token that the wire already mirrors at the holder's side, Zenoh does not tell it again.
                hidden = any(side != other and side not in to[other] for other in others)
                if lets and not hidden and (side, token) not in course.alive:
                    yield f"the token {token} of {holder.side} is not seen at {side}"


def _lets(plan: WirePlan, side: str, other: str, token: str) -> bool:
    """Whether both sides allow a token."""
    return all(
        any(zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(token)) for key in plan.sides[name].keys)
        or plan.sides[name].keys == ("**",)
        for name in (side, other)
    )


def _watches(program: WireProgram, token: str) -> bool:
    return any(intersects(tokens, token) for tokens in program.objects("watch"))

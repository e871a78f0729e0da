"""What every table of a scenario has: strict entries, and all of its mistakes at once, those between entries too."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from emulator.scenario.words import listed

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Found = tuple[str, str]
"""A mistake in a table: the entry, and what is wrong with it."""


def expected(what: str) -> PydanticCustomError:
    """The error of one value: the line will say what was found and that this was expected."""
    return PydanticCustomError("expected", "one value", {"expected": what})


def one_of(names: Iterable[str]) -> Callable[[str], str]:
    """A check that a value is one of some names."""

    def check(value: str) -> str:
        if value not in names:
            raise expected(listed(sorted(names)))
        return value

    return check


class Table(BaseModel):
    """A table of a scenario. Abstract."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def mistakes(cls, table: Mapping[str, Any]) -> list[Found]:
        """What only shows when entries are seen together; entries that are wrong by themselves may be in the table."""
        del table
        return []

    @model_validator(mode="wrap")
    @classmethod
    def _all_at_once(cls, found: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        """Entries by themselves and together, so that one mistake does not hide another."""
        together = cls.mistakes(found) if isinstance(found, Mapping) else []
        mistakes = PydanticCustomError("mistakes", "several", {"mistakes": together})
        try:
            table = check(found)
        except ValidationError as error:
            if not together:
                raise
            lines = [_again(detail) for detail in error.errors(include_url=False)]
            lines.append(InitErrorDetails(type=mistakes, input=found))
            raise ValidationError.from_exception_data(cls.__name__, lines) from None
        if together:
            raise mistakes
        return table


def _again(detail: ErrorDetails) -> InitErrorDetails:
    """An error that was reported, to be reported once more with others."""
    kind, context = detail["type"], detail.get("ctx", {})
    own = PydanticCustomError(kind, detail["msg"], context) if kind in {"expected", "mistakes"} else kind
    return InitErrorDetails(type=own, loc=detail["loc"], input=detail["input"], ctx=context)

"""What the axis of a scenario's entry is called in pictures, whether it has numbers, and the unit of a squared error."""

from __future__ import annotations

from collections.abc import Iterable

_NAMES = {
    "encoding.state_probability": "μ_d: probability of sending a state",
    "link.quality": "μ: probability that a packet arrives",
}


def axis_name(key: str) -> str:
    """The symbol of the paper and its meaning, where `_` begins an index; of an entry without a symbol, the key."""
    table, _, rest = key.partition(".")
    receiver, _, entry = rest.partition(".")
    if table == "eavesdroppers" and entry == "link.quality":
        return f"μ of {receiver}: probability that a packet arrives"
    return _NAMES.get(key.removeprefix("legitimate."), key)


def are_numbers(values: Iterable[object]) -> bool:
    """Whether an axis shows values at their places; it names others side by side, such as words, true and false."""
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)


def squared_unit(units: Iterable[str]) -> str:
    """The unit of a squared error over all states, to follow its name; empty without any. units: those of the states."""
    distinct = list(dict.fromkeys(units))
    squares = [f"({unit})²" if set("/ *·") & set(unit) else f"{unit}²" for unit in distinct if unit]
    return f" ({' + '.join(squares)})" if squares else ""


def as_mathematics(name: str) -> str:
    """The same for matplotlib, with the symbol as mathematics."""
    return without_mathematics(name).replace("μ_d", r"$\mu_d$")


def without_mathematics(text: str) -> str:
    """A text of the user for matplotlib, which would take what is between two dollar signs as mathematics."""
    return text.replace("$", r"\$")

"""Classes by their names: built in, of a package, or in a module; any other name is refused with the reason."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evedrop.errors import NoAnswer, NotRegistered
from evedrop.model.eavesdroppers.eavesdropper import Eavesdropper, PacketTaker
from evedrop.model.links import LOSS_MODELS
from evedrop.model.links.loss_model import Bernoulli, LossModel
from evedrop.model.registry import Registry, asked, is_own, no_modules, place_of
from evedrop.model.schemes import SCHEMES
from tests.packages import install

GROUP = "evedrop.tests.registry"
MODULE = """
from evedrop.extend import Bernoulli, LossModel


class Mine(Bernoulli):
    parameters = {}


class Half(LossModel):
    quality = 0.5


class None_(LossModel):
    pass


class Table(Bernoulli):
    parameters = ("quality",)


class Numbered(Bernoulli):
    parameters = {1: 0.5}


class Taken(Bernoulli):
    parameters = {"model": 1}


number = 3
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path of Python with a package; what is imported from it is forgotten afterwards."""
    entries = {GROUP: {"mine": "registered:Mine", "gone": "registered:Gone", "here": "__main__:Mine"}}
    entries["evedrop.tests.other"] = {"mine": "registered:Half"}
    install(
        tmp_path,
        {"registered.py": MODULE, "registered_empty.py": "", "registered_exits.py": "raise SystemExit(3)"},
        entries,
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [module for module in sys.modules if module.startswith("registered")]:
        del sys.modules[name]


def registry(group: str = GROUP, **given: Any) -> Registry[LossModel]:
    """A registry with one class of its own."""
    return Registry("loss model", LossModel, group, {"bernoulli": Bernoulli}, ("model",), **given)  # type: ignore[type-abstract]


def test_the_built_in_classes_are_what_it_iterates_over(folder: Path) -> None:
    """Others are looked up by their names."""
    result = registry()
    assert (list(result), len(result), result["bernoulli"]) == (["bernoulli"], 1, Bernoulli)
    assert result.names == ["bernoulli", "gone", "here", "mine"]
    assert registry("evedrop.tests.none").names == ["bernoulli"]
    assert [result.foreign(name) for name in ("bernoulli", "mine", "registered:Mine")] == [False, True, True]
    assert [is_own(name) for name in ("bernoulli", "registered:Mine", 3)] == [False, True, False]
    mine = result["mine"]
    assert mine is result["registered:Mine"]
    assert issubclass(mine, Bernoulli)
    assert "mine" in result
    assert "other" not in result


REFUSED = {
    "other": "",
    "mine:": "; expected PACKAGE.MODULE:CLASS, such as mine:Masked",
    "1:2": "; expected PACKAGE.MODULE:CLASS, such as mine:Masked",
    "__main__:Mine": ", which other processes cannot import; expected a class in a module, a file of its own",
    "here": ", which an installed package says is __main__:Mine, which other processes cannot import; expected a class in",
    "nowhere:Mine": ", and the module nowhere cannot be imported (No module named 'nowhere'); expected a module in the",
    "registered_exits:Mine": ", and the module registered_exits cannot be imported (SystemExit: 3, registered_exits.py line 1); "
    "expected one that can be imported",
    "registered:Mime": "has no Mime; did you mean registered:Mine?",
    "registered:Qqq": "has no Qqq; expected one of Mine, Half, None_, Table, Numbered, Taken",
    "registered_empty:Mine": "has no Mine; expected one of none",
    "sys:Mine": ", and the module sys has no Mine; ",
    "gone": ", which an installed package says is registered:Gone, and the module registered (",
    "registered:number": ", which is not a LossModel; expected a class that inherits from evedrop.extend.LossModel",
    "pathlib:Path": ", which is not a LossModel; expected a class that inherits from evedrop.extend.LossModel",
    "registered:Half": ", which lacks fates; expected a class with this method, as evedrop.extend.LossModel describes it",
    "registered:None_": ", which lacks fates, quality; expected a class with these methods, as evedrop.extend.LossModel "
    "describes them",
    "registered:Table": ", whose parameters are not a table; expected the entries it takes, each with an example",
    "registered:Numbered": ", whose parameters are not a table; expected the entries it takes, each with an example",
    "registered:Taken": ", one of whose parameters is called model, as an entry of every loss model is",
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_name_of_no_usable_class_is_refused(name: str, folder: Path) -> None:
    """With the reason and what was expected; the error is a KeyError, too."""
    with pytest.raises(NotRegistered) as refused:
        registry()[name]
    assert refused.value.name == name
    assert REFUSED[name] in refused.value.why
    assert (refused.value.why == "") == (name == "other")


def test_a_name_that_two_packages_use_is_refused(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody could tell which class it is; the full name of either can."""
    install(tmp_path / "second", {}, {GROUP: {"mine": "registered:Half"}}, "second")
    monkeypatch.syspath_prepend(str(tmp_path / "second"))
    with pytest.raises(NotRegistered) as refused:
        registry()["mine"]
    assert refused.value.why == (
        ", a name that two installed packages use; expected one of registered:Half and registered:Mine itself"
    )


def test_a_class_that_must_not_run_here_has_a_remote_class(folder: Path) -> None:
    """Its module is not imported, but by `imported`; a name that cannot be a class has no remote class."""
    asked_for: list[str] = []

    def remote_class(name: str) -> type[LossModel]:
        asked_for.append(name)
        return type("Elsewhere", (Bernoulli,), {"parameters": {"model": 1} if name.endswith("Taken") else {}})

    result = registry(remote_class=remote_class)
    assert result["mine"].__name__ == "Elsewhere"
    assert result["bernoulli"] is Bernoulli
    assert "registered" not in sys.modules
    with pytest.raises(NotRegistered, match="one of whose parameters is called model"):
        result["registered:Taken"]
    with pytest.raises(NotRegistered, match=r"expected PACKAGE\.MODULE:CLASS"):
        result["mine:"]
    assert asked_for == ["mine", "registered:Taken"]
    assert result.imported("mine").__name__ == "Mine"


def checks(value: Any) -> type[Any]:
    """A class whose check of parameters does so."""
    return type("Mine", (Bernoulli,), {"mistakes": staticmethod(value), "__module__": __name__})


def test_the_mistakes_that_a_class_finds_are_texts() -> None:
    """Any return value or exception leaves its parameters with mistakes or none."""
    assert asked(LOSS_MODELS["bernoulli"], {"quality": 0.5}) == []
    assert asked(checks(lambda _: [("depth", 3)]), {"depth": 3}) == [("depth", "3")]

    def fails(given: Any) -> Any:
        raise ValueError("too   deep")

    ((entry, sentence),) = asked(checks(fails), {"depth": 3})
    assert entry == "depth"
    assert sentence.startswith("cannot be checked: Mine.mistakes raised ValueError: too deep, test_registry.py line ")
    assert sentence.endswith("; expected it to return a list of (entry, what is wrong)")
    for wrong in (None, ["depth"], [("depth",)]):
        message = f"cannot be checked: Mine.mistakes returned {wrong!r}; expected it to return a list of (entry, what is wrong)"
        assert asked(checks(lambda _, wrong=wrong: wrong), {}) == [("parameters", message)]


def raised(code: str, file: str = "/there/mine.py") -> BaseException:
    """The error of code in a file."""
    try:
        exec(compile(code, file, "exec"), {})  # noqa: S102 - code of this test
    except BaseException as error:
        return error
    raise AssertionError(code)


def test_the_place_of_an_error_is_the_line_of_its_author() -> None:
    """The last line of the file in question, or of any file that is not Python's own; an error without words has its name."""
    assert place_of(NoAnswer("it ended")) == "it ended"
    assert place_of(raised("1 / 0"), "/there/mine.py") == "ZeroDivisionError: division by zero, mine.py line 1"
    assert place_of(raised("\nraise KeyError")) == "KeyError, mine.py line 2"
    assert place_of(raised("x = (")).startswith("SyntaxError: '(' was never closed, mine.py line 1")
    assert place_of(ValueError("never raised")) == "ValueError: never raised"
    assert place_of(ValueError()) == "ValueError"
    nameless = SyntaxError("bad")
    assert place_of(nameless) == "SyntaxError: bad"


def test_a_class_that_lacks_methods_is_sent_to_the_class_it_inherits_from() -> None:
    """PacketTaker describes `uses`; Eavesdropper, the base of all eavesdroppers, does not."""

    class Bare(PacketTaker):
        pass

    strategies = Registry("strategy", Eavesdropper, GROUP, {})  # type: ignore[type-abstract]
    with pytest.raises(
        NotRegistered, match=r"lacks use_probabilities, uses; .* as evedrop.extend.PacketTaker describes them"
    ):
        strategies._checked("mine:Bare", Bare, "")


def test_no_class_of_a_module_is_found_while_results_are_looked_at() -> None:
    """Its module is not even looked for; built-in names are found, and afterwards the module is looked for again."""
    with no_modules():
        with pytest.raises(NotRegistered, match="results are only looked at"):
            SCHEMES["nowhere:Scheme"]
        assert SCHEMES["innovation"].__name__ == "Innovation"
    with pytest.raises(NotRegistered) as refused:
        SCHEMES["nowhere:Scheme"]
    assert "only looked at" not in str(refused.value)

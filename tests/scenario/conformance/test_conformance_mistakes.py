"""Mistakes in a class of anybody's own are named before anything starts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from evedrop.scenario.loading import load
from tests.builders import digests_of, mistakes_of
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.scenario.conformance.own_classes import ENTRY, HEAD, SCENARIO

pytestmark = pytest.mark.usefixtures("imports_forgotten")
MISTAKES = {
    "shape": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return Packet(x.T, np.zeros(3, bool))",
              "slot 0: Packet.z has shape (3, 2); expected (2, 3): n states, R trials"),
    "dtype": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return Packet(x.astype(np.float32), np.zeros(3, bool))",
              "slot 0: Packet.z has type float32; expected float64"),
    "pair": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return x, None",
             "slot 0: encode() returned tuple; expected a Packet"),
    "raises": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return 1 / 0",
               "slot 0: encode() raised ZeroDivisionError: division by zero, case_raises.py "
               f"line {len(HEAD.splitlines()) + 4}"),
    "changes": ("scheme", "Mine(Sends):\n    def packet(self, k, x):\n        x += 1.0",
                "changes in place what it is given"),
    "header": ("scheme", "Mine(Plain):\n    header = ('one',)", "`header` names 1 numbers"),
    "key": ("scheme", "Mine(Plain):\n    def shared(self, keys, batch): return keys['noise']",
            "reaches for the key of 'noise', and has asked for none"),
    "abstract": ("scheme", "Mine(Scheme):\n    def outcomes(self, mu): return None",
                 "which lacks shared; expected a class with this method"),
    "other": ("scheme", "Mine(Naive):\n    pass", "which is not a Scheme; expected a class that inherits from evedrop.extend"),
    "absent": ("scheme", "Mein(Plain):\n    pass", "has no Mine; did you mean case_absent:Mein?"),
    "syntax": ("scheme", "Mine(Plain)\n    pass", "cannot be imported (SyntaxError: "),
    "fails": ("scheme", "Mine(Plain):\n    pass\n\nimport nowhere_at_all",
              "ModuleNotFoundError: No module named 'nowhere_at_all', "),
    "needs": ("scheme", "Mine(Plain):\n    parameters = {'depth': 3}",
              "encoding.depth: is missing; the scheme case_needs:Mine needs it"),
    "table": ("scheme", "Mine(Plain):\n    parameters = ('depth',)", "whose parameters are not a table"),
    "taken": ("eavesdropper", "Mine(Naive):\n    parameters = {'window': 3}", "one of whose parameters is called window"),
    "belief": ("eavesdropper", "Mine(Naive):\n    def step(self, k, belief, heard): return belief._replace(x_hat=heard.z[0])",
               "slot 0: Belief.x_hat has shape (3,); expected (2, 3)"),
    "infinite": ("eavesdropper",
                 "Mine(Naive):\n    def step(self, k, belief, heard): return belief._replace(x_hat=heard.z / 0.0 * 0.0)",
                 "x_hat, trial 0, is nan; expected finite numbers"),
    "asymmetric": ("eavesdropper",
                   "Mine(Naive):\n    def step(self, k, belief, heard):\n"
                   "        return belief._replace(P=belief.P + np.tri(2, k=-1)[:, :, None])",
                   "P, trial 0, is 0.0 at [0][1] and 1.0 at [1][0]; expected a covariance, which is symmetric except for"),
    "streams": ("eavesdropper", "Mine(Naive):\n    @classmethod\n    def streams(cls, parameters): return ('schedule',)",
                "knowledge of the schedule, and the scheme plain has none"),
    "fate": ("link", "Mine(Bernoulli):\n    parameters = {}\n    def __init__(self): super().__init__(0.9)\n"
             "    def fates(self, first, uniforms): return uniforms[:, 0] < 0.9", "has type bool; expected uint8"),
    "quality": ("link", "Mine(Bernoulli):\n    parameters = {}\n    quality = 1.5\n    def __init__(self): super().__init__(0.9)",
                "quality is 1.5; expected a number from 0 to 1"),
    "outcomes": ("scheme", "Mine(Plain):\n    def outcomes(self, mu): return 'always'",
                 "outcomes(0.0) is 'always'; expected Outcomes, or None: no closed form"),
    "odds": ("scheme", "Mine(Plain):\n    def outcomes(self, mu):\n"
             "        return super().outcomes(mu).__class__(float('nan'), 0.0, 0.0, 0.0, 0.0)",
             "outcomes(0.0).predicted is nan; expected a probability, or None in place of Outcomes"),
    "secret": ("scheme", "Mine(Plain):\n    secret_streams = 'schedule'",
               "secret_streams is 'schedule'; expected a tuple of names, each once, such as ('schedule',)"),
    "secrets": ("scheme", "Mine(Plain):\n    secret_streams = None", "secret_streams is None; expected a tuple of names"),
    "numbered": ("scheme", "Mine(Plain):\n    secret_streams = estimator_streams = (3,)", "secret_streams is (3,); expected a"),
    "silence": ("scheme", "Mine(Plain):\n    may_be_silent = 'no'", "may_be_silent is 'no'; expected True or False"),
    "number": ("eavesdropper", "Mine(Naive):\n    @classmethod\n    def outcomes(cls, parameters, mu_d): return 0.5",
               "outcomes() is float; expected a function of the link's quality that gives Outcomes"),
    "told": ("eavesdropper", "Mine(Naive):\n    @classmethod\n    def streams(cls, parameters): return 'coin'",
             "streams() is 'coin'; expected a tuple of names"),
    "good": ("link", "Mine(Bernoulli):\n    parameters = {}\n    quality = 'good'\n    def __init__(self): super().__init__(0.9)",
             "quality is 'good'; expected a number from 0 to 1"),
    "chain": ("link", "Mine(Bernoulli):\n    parameters = {}\n    chain = (1, 2)\n    def __init__(self): super().__init__(0.9)",
              "in a dry run: "),
    "soon": ("delay", "Mine(ConstantDelay):\n    parameters = {}\n    def __init__(self): super().__init__(1.0)\n"
             "    def arrived(self, lag): return 'soon'", "arrived(0) is 'soon'; expected a number from 0 to 1"),
    "late": ("delay", "Mine(ConstantDelay):\n    parameters = {}\n    def __init__(self): super().__init__(1.0)\n"
             "    def delays(self, first, numbers): return -numbers", "expected slots, 0 or more"),
}  # fmt: skip


def written(case: str, folder: Path) -> dict[str, Any]:
    """Write the module and the scenario of a mistake; the change of the scenario that names the class."""
    kind, body, _ = MISTAKES[case]
    (folder / f"case_{case}.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (folder / "mine.toml").write_text(SCENARIO)
    if kind == "link":
        return {"legitimate.link": {"loss": {"model": f"case_{case}:Mine"}}}
    return {ENTRY[kind]: f"case_{case}:Mine"}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # a class that divides by zero does so in this process
@pytest.mark.usefixtures("asked_here")
@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_in_a_class_is_named(case: str, tmp_path: Path) -> None:
    """With the entry that names the class, what was found and what was expected."""
    kind, _, sentence = MISTAKES[case]
    mistakes = mistakes_of(load, tmp_path / "mine.toml", written(case, tmp_path))
    line = next(line for line in mistakes if sentence in line)
    assert line.startswith(("encoding.", f"{ENTRY[kind]}: is"))


@pytest.mark.parametrize("case", ["shape", "belief"])
def test_a_run_with_a_mistake_in_a_class_is_refused(case: str, evedrop: Evedrop) -> None:
    """As a command, and with a process that answers for the eavesdropper's class: status 2, and no results."""
    changes = [word for key, value in written(case, evedrop.folder).items() for word in ("--set", f"{key}={value}")]
    done = evedrop("run", "mine.toml", "--view", "off", "--out", "run", *changes)
    assert done.status == 2, done.err
    assert MISTAKES[case][2] in done.err
    assert not (evedrop.folder / "run").exists()


@pytest.mark.parametrize(
    "name",
    mostly_long(
        ["mine", "nowhere.at.all:Mine", "mine:", ":Mine", "__main__:Mine", "os:path"],
        ["mine", "nowhere.at.all:Mine", "mine:"],
    ),
)
def test_a_name_that_names_nothing_is_refused(name: str, evedrop: Evedrop) -> None:
    """Every fault of a class is reported as a mistake of the scenario, with its path."""
    (evedrop.folder / "mine.toml").write_text(SCENARIO)
    for entry in ("encoding.scheme", "eavesdroppers.eve.strategy"):
        done = evedrop("check", "mine.toml", "--set", f'{entry}="{name}"')
        assert done.status == 2
        assert f'  {entry}: is "{name}"' in done.err
        assert "expected" in done.err
    assert evedrop("check", "--scheme", name).status == 2


def test_one_name_is_one_module(evedrop: Evedrop) -> None:
    """Two folders with modules of the same name cannot be used in one session: the class would be ambiguous."""
    for folder in ("here", "there"):
        (evedrop.folder / folder).mkdir()
        (evedrop.folder / folder / "twice.py").write_text(f"{HEAD}\n\nclass Mine(Plain):\n    pass\n")
        (evedrop.folder / folder / "s.toml").write_text(SCENARIO.replace('"plain"', '"twice:Mine"'))
    assert evedrop("check", "here/s.toml").status == 0
    done = evedrop("check", "there/s.toml")
    assert done.status == 2
    assert "another one of this name is loaded already" in done.err
    assert evedrop.process("check", "there/s.toml").status == 0


@pytest.mark.parametrize("name", mostly_long(["json", "wave", "zenoh"], ["wave"]))
@pytest.mark.parametrize("entry", ["encoding.scheme", "eavesdroppers.eve.strategy"])
def test_a_module_called_like_an_installed_one_is_refused(name: str, entry: str, evedrop: Evedrop) -> None:
    """Nothing in a folder of modules stands in place of Python's or a library's."""
    (evedrop.folder / f"{name}.py").write_text(f"{HEAD}\n\nclass Mine(Plain):\n    pass\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO)
    done = evedrop("check", "mine.toml", "--set", f"{entry}={name}:Mine")
    assert done.status == 2
    assert re.search(f"has a module {name} .*another one of this name is (loaded already|installed)", done.err)


@pytest.mark.long
def test_a_scheme_that_needs_acknowledgements_must_have_them(evedrop: Evedrop) -> None:
    """The scenario is refused without the table, with what to write, and runs with it."""
    body = "from evedrop.model.schemes.acknowledged import Acknowledged\n\n\nclass Mine(Acknowledged):\n    pass\n"
    (evedrop.folder / "heeds.py").write_text(body)
    (evedrop.folder / "mine.toml").write_text(SCENARIO.replace('"plain"', '"heeds:Mine"'))
    done = evedrop("run", "mine.toml", "--view", "off", "--out", "run")
    assert done.status == 2
    assert "acknowledgements: is missing; the scheme heeds:Mine acts on acknowledgements; expected a table" in done.err
    with_table = ("--set", "acknowledgements.link.quality=0.9")
    assert evedrop("run", "mine.toml", "--view", "off", "--out", "live", *with_table).status == 0
    assert evedrop("montecarlo", "mine.toml", "--trials", "3", "--out", "memory", *with_table).status == 0
    assert digests_of(evedrop.folder / "live") == digests_of(evedrop.folder / "memory")

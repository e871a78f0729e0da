"""Mistakes in a class of anybody's own are named before anything starts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from evedrop.scenario.loading import load
from tests.builders import digests_of, mistakes_of, places_of
from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.golden.pages import Golden
from tests.scenario.conformance.own_classes import ENTRY, HEAD, SCENARIO

pytestmark = pytest.mark.usefixtures("imports_forgotten")
MISTAKES = {
    "shape": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return Packet(x.T, np.zeros(3, bool))"),
    "dtype": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return Packet(x.astype(np.float32), np.zeros(3, bool))"),
    "pair": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return x, None"),
    "raises": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return 1 / 0"),
    "leaves": ("scheme", "Mine(Sends):\n    def packet(self, k, x): raise SystemExit(0)"),
    "gone": ("scheme", "Mine(Plain):\n    @classmethod\n    def mistakes(cls, given): raise SystemExit(0)"),
    "acts": ("eavesdropper",
             "Mine(Naive):\n    def step(self, k, belief, heard):\n"
             "        return super().step(k, belief, heard)._replace(action=np.full(self.trials, 1, np.uint8))"),
    "changes": ("scheme", "Mine(Sends):\n    def packet(self, k, x):\n        x += 1.0"),
    "header": ("scheme", "Mine(Plain):\n    header = ('one',)"),
    "key": ("scheme", "Mine(Plain):\n    def shared(self, keys, batch): return keys['noise']"),
    "abstract": ("scheme", "Mine(Scheme):\n    def outcomes(self, mu): return None"),
    "other": ("scheme", "Mine(Naive):\n    pass"),
    "absent": ("scheme", "Mein(Plain):\n    pass"),
    "syntax": ("scheme", "Mine(Plain)\n    pass"),
    "fails": ("scheme", "Mine(Plain):\n    pass\n\nimport nowhere_at_all"),
    "needs": ("scheme", "Mine(Plain):\n    parameters = {'depth': 3}"),
    "table": ("scheme", "Mine(Plain):\n    parameters = ('depth',)"),
    "taken": ("eavesdropper", "Mine(Naive):\n    parameters = {'window': 3}"),
    "belief": ("eavesdropper", "Mine(Naive):\n    def step(self, k, belief, heard): return belief._replace(x_hat=heard.z[0])"),
    "infinite": ("eavesdropper",
                 "Mine(Naive):\n    def step(self, k, belief, heard): return belief._replace(x_hat=heard.z / 0.0 * 0.0)"),
    "asymmetric": ("eavesdropper",
                   "Mine(Naive):\n    def step(self, k, belief, heard):\n"
                   "        return belief._replace(P=belief.P + np.tri(2, k=-1)[:, :, None])"),
    "streams": ("eavesdropper", "Mine(Naive):\n    @classmethod\n    def streams(cls, parameters): return ('schedule',)"),
    "fate": ("link", "Mine(Bernoulli):\n    parameters = {}\n    def __init__(self): super().__init__(0.9)\n"
             "    def fates(self, first, uniforms): return uniforms[:, 0] < 0.9"),
    "quality": ("link", "Mine(Bernoulli):\n    parameters = {}\n    quality = 1.5\n"
             "    def __init__(self): super().__init__(0.9)"),
    "outcomes": ("scheme", "Mine(Plain):\n    def outcomes(self, mu): return 'always'"),
    "odds": ("scheme", "Mine(Plain):\n    def outcomes(self, mu):\n"
             "        return super().outcomes(mu).__class__(float('nan'), 0.0, 0.0, 0.0, 0.0)"),
    "secret": ("scheme", "Mine(Plain):\n    secret_streams = 'schedule'"),
    "secrets": ("scheme", "Mine(Plain):\n    secret_streams = None"),
    "numbered": ("scheme", "Mine(Plain):\n    secret_streams = estimator_streams = (3,)"),
    "silence": ("scheme", "Mine(Plain):\n    may_be_silent = 'no'"),
    "number": ("eavesdropper", "Mine(Naive):\n    @classmethod\n    def outcomes(cls, parameters, mu_d): return 0.5"),
    "told": ("eavesdropper", "Mine(Naive):\n    @classmethod\n    def streams(cls, parameters): return 'coin'"),
    "good": ("link", "Mine(Bernoulli):\n    parameters = {}\n    quality = 'good'\n"
             "    def __init__(self): super().__init__(0.9)"),
    "chain": ("link", "Mine(Bernoulli):\n    parameters = {}\n    chain = (1, 2)\n"
             "    def __init__(self): super().__init__(0.9)"),
    "soon": ("delay", "Mine(ConstantDelay):\n    parameters = {}\n    def __init__(self): super().__init__(1.0)\n"
             "    def arrived(self, lag): return 'soon'"),
    "late": ("delay", "Mine(ConstantDelay):\n    parameters = {}\n    def __init__(self): super().__init__(1.0)\n"
             "    def delays(self, first, numbers): return -numbers"),
}  # fmt: skip


def written(case: str, folder: Path) -> dict[str, Any]:
    """Write the module and the scenario of a mistake; the change of the scenario that names the class."""
    kind, body = MISTAKES[case]
    (folder / f"case_{case}.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (folder / "mine.toml").write_text(SCENARIO)
    if kind == "link":
        return {"legitimate.link": {"loss": {"model": f"case_{case}:Mine"}}}
    return {ENTRY[kind]: f"case_{case}:Mine"}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # a class that divides by zero does so in this process
@pytest.mark.usefixtures("asked_here")
@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_in_a_class_is_named(case: str, tmp_path: Path, golden: Golden) -> None:
    """With the entry that names the class, what was found and what was expected."""
    mistakes = mistakes_of(load, tmp_path / "mine.toml", written(case, tmp_path))
    places = [place for place in places_of(mistakes) if place.startswith(("encoding.", ENTRY[MISTAKES[case][0]]))]
    assert places
    golden("check", re.sub(r"(loss_model\.py line )\d+", r"\1N", "\n".join(mistakes)))


@pytest.mark.parametrize("case", ["shape", "belief"])
def test_a_run_with_a_mistake_in_a_class_is_refused(case: str, evedrop: Evedrop, golden: Golden) -> None:
    """As a command, and with a process that answers for the eavesdropper's class: status 2, and no results."""
    changes = [word for key, value in written(case, evedrop.folder).items() for word in ("--set", f"{key}={value}")]
    done = evedrop("run", "mine.toml", "--view", "off", "--out", "run", *changes)
    assert done.status == 2, done.err
    assert f"  {ENTRY[MISTAKES[case][0]]}: is" in done.err
    golden("run", done.err)
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

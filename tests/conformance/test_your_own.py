"""Classes of anybody's own: the tutorial as it stands, other ways to name them, and the mistakes that are made with them."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evedrop import extend
from evedrop.errors import ScenarioError
from evedrop.loading import load
from evedrop.loading.amended import with_event
from evedrop.model.eavesdroppers import ANSWERS
from evedrop.results.writer import load_results
from tests.builders import digests_of
from tests.conftest import Evedrop

PAGE = Path(__file__).parents[2] / "docs" / "your-own.md"
BLOCK = re.compile(r"^```(?:python|toml)\n# (\S+\.\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

SCENARIO = """
title = "Somebody's own"
slots = 40
trials = 3

[process]
A = [[1.0, 0.1], [0.0, 1.0]]
Q = [[1e-3, 0.0], [0.0, 1e-3]]
initial_covariance = [[1.0, 0.0], [0.0, 1.0]]

[encoding]
scheme = "plain"

[legitimate]
link = { quality = 0.9 }

[eavesdroppers.eve]
strategy = "naive"
link = { quality = 0.8 }
"""


@pytest.fixture(autouse=True)
def _imports_forgotten(tmp_path: Path) -> Iterator[None]:
    """What a test imports from its folder is no other test's."""
    before = list(sys.path)
    ANSWERS.forget()
    yield
    sys.path[:] = before
    ANSWERS.forget()
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.fixture
def tutorial(evedrop: Evedrop) -> Evedrop:
    """The command in a folder with the files of the tutorial."""
    for name, text in BLOCK.findall(PAGE.read_text(encoding="utf-8")):
        (evedrop.folder / name).write_text(text, encoding="utf-8")
    return evedrop


def test_the_tutorial_has_three_short_classes_and_a_scenario() -> None:
    """Each is complete in less than 40 lines, and an application in less than 50."""
    blocks = dict(BLOCK.findall(PAGE.read_text(encoding="utf-8")))
    assert set(blocks) == {"flipped.py", "tracker.py", "shifts.py", "three.toml", "platooning.py", "pyproject.toml"}
    assert blocks.pop("platooning.py").count("\n") < 49
    assert all(text.count("\n") < 39 for text in blocks.values())


def test_the_tutorial_works_as_it_is_typed(tutorial: Evedrop) -> None:
    """Its classes are checked, and run live, in memory and again from the results, with the same digests."""
    commands = [
        line.split()[1:] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("evedrop ")
    ]
    assert {words[0] for words in commands} == {"check", "run", "montecarlo", "diff"}
    for words in [*commands, ["check", "--scheme", "flipped:Flipped"]]:
        done = tutorial(*words)
        assert done.status == 0, (words, done.out, done.err)
        assert "BROKEN" not in done.out
    assert (
        "no difference in 180 blocks of 256 slots: legitimate, naive, tracker" in tutorial("diff", "live", "memory").out
    )
    assert "is not the one" not in (again := tutorial("montecarlo", "live", "--trials", "20", "--out", "again")).err
    assert again.status == 0
    assert digests_of(tutorial.folder / "again") == digests_of(tutorial.folder / "live")
    peers = load_results(tutorial.folder / "live").summary["peers"]
    assert peers["tracker"]["expected_trace_covariance"] is None
    assert peers["legitimate"]["expected_trace_covariance"] == pytest.approx(0.00059, rel=0.02)


def test_workers_import_it_too(tutorial: Evedrop) -> None:
    """Trials by worker processes are the trials of this one."""
    for workers in "12":
        options = ("--trials", "502", "--slots", "4", "--workers", workers, "--out", workers)
        assert tutorial("montecarlo", "three.toml", *options).status == 0
    assert digests_of(tutorial.folder / "1") == digests_of(tutorial.folder / "2")


def test_a_module_that_has_changed_since_is_warned_of(tutorial: Evedrop) -> None:
    """Results know the module that they were made with."""
    assert tutorial("montecarlo", "three.toml", "--trials", "1", "--out", "run").status == 0
    with (tutorial.folder / "shifts.py").open("a") as module:
        module.write("# another\n")
    assert "warning: the module shifts is not the one these results were made with" in tutorial("check", "run").out


def test_the_folder_of_modules_can_be_another(tutorial: Evedrop) -> None:
    """`modules` is beside the scenario, wherever the command is typed; every process is told what it needs, and no more."""
    lib, home = tutorial.folder / "home" / "lib", tutorial.folder / "home"
    lib.mkdir(parents=True)
    for module in tutorial.folder.glob("*.py"):
        module.rename(lib / module.name)
    scenario = 'modules = "lib"\n' + (tutorial.folder / "three.toml").read_text()
    (home / "three.toml").write_text(scenario)
    short = ("home/three.toml", "--slots", "20", "--set", "trials=2")
    assert tutorial("run", *short, "--view", "off", "--out", "live").status == 0
    assert tutorial("brief", *short, "--out", "briefs").status == 0
    told = {path.stem: json.loads(path.read_text())["part"].get("modules") for path in tutorial.folder.glob("briefs/*")}
    assert {name for name, folder in told.items() if folder == str(lib)} == {
        "sensor",
        "legitimate",
        "tracker",
        "router",
    }
    done = tutorial("check", "home/three.toml", "--set", "modules=nowhere")
    assert done.status == 2
    assert f'modules: is "{tutorial.folder}/nowhere", which is not a folder' in done.err


def test_an_installed_package_gives_short_names(tutorial: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Entry points of a package on the path are names like any other, in every process; the built-in ones stay."""
    site = tutorial.folder / "site"
    (site / "mypackage-1.0.dist-info").mkdir(parents=True)
    (site / "mypackage-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: mypackage\nVersion: 1.0\n")
    (site / "mypackage-1.0.dist-info" / "entry_points.txt").write_text(
        "[evedrop.schemes]\nflip = flipped:Flipped\nplain = flipped:Flipped\n"
        "[evedrop.eavesdroppers]\ntrack = tracker:Tracker\n[evedrop.links]\nshifts = shifts:Shifts\nbad = shifts:Shift\n"
    )
    for module in tutorial.folder.glob("*.py"):
        module.rename(site / module.name)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=":")
    monkeypatch.syspath_prepend(str(site))
    changes = ("slots=20", "encoding.scheme=flip", "eavesdroppers.tracker.strategy=track")
    short = ("three.toml", *(word for change in changes for word in ("--set", change)))
    named = ("--set", "eavesdroppers.tracker.link.loss.model=shifts")
    assert tutorial("run", *short, *named, "--view", "off", "--set", "trials=2", "--out", "live").status == 0
    assert tutorial("montecarlo", *short, *named, "--trials", "2", "--out", "memory").status == 0
    assert digests_of(tutorial.folder / "live") == digests_of(tutorial.folder / "memory")
    assert 'scheme = "flip"' in (tutorial.folder / "live" / "scenario.toml").read_text()
    assert tutorial("check", "--scheme", "flip").status == 0
    done = tutorial("check", *short, "--set", "eavesdroppers.tracker.link.loss.model=bad")
    assert 'loss.model: is "bad", which an installed package says is shifts:Shift, and the module shifts' in done.err
    done = tutorial("check", "three.toml", "--set", "encoding.scheme=flop")
    assert done.status == 2
    assert "encrypted-schedule, flip, innovation" in done.err
    assert "did you mean flip?" in done.err


HEAD = """
import numpy as np
from evedrop.extend import (
    Bernoulli, ConstantDelay, Naive, NoInnovations, Packet, PacketReader, Plain, PlainEncoder, PlainEstimator, Scheme,
)


class Sends(Plain):
    def shared(self, keys, batch):
        encode = lambda encoder, k, x, predicted: self.packet(k, x)
        encoder = type("Encoder", (PlainEncoder,), {"encode": encode})
        return NoInnovations(self.process, batch.trials, encoder, lambda: PlainEstimator(self.process, batch.trials))
"""
ENTRY = {
    "scheme": "encoding.scheme",
    "eavesdropper": "eavesdroppers.eve.strategy",
    "link": "legitimate.link.loss.model",
    "delay": "legitimate.link.delay.model",
}
MISTAKES = {
    "shape": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return Packet(x.T, np.zeros(3, bool))",
              "slot 0: Packet.z has shape (3, 2); expected (2, 3): n states, R trials"),
    "dtype": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return Packet(x.astype(np.float32), np.zeros(3, bool))",
              "slot 0: Packet.z has type float32; expected float64"),
    "pair": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return x, None",
             "slot 0: encode() returned tuple; expected a Packet"),
    "raises": ("scheme", "Mine(Sends):\n    def packet(self, k, x): return 1 / 0",
               "slot 0: encode() raised ZeroDivisionError: division by zero, case_raises.py line 16"),
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


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_in_a_class_is_named_before_anything_starts(case: str, evedrop: Evedrop) -> None:
    """With the entry that names the class, what was found and what was expected; status 2, and no results."""
    kind, body, said = MISTAKES[case]
    (evedrop.folder / f"case_{case}.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO)
    given: dict[str, Any] = {ENTRY[kind]: f"case_{case}:Mine"}
    if kind == "link":
        given = {"legitimate.link": f'{{loss = {{model = "case_{case}:Mine"}}}}'}
    changes = [word for key, value in given.items() for word in ("--set", f"{key}={value}")]
    done = evedrop("run", "mine.toml", "--view", "off", "--out", "run", *changes)
    assert done.status == 2, done.err
    line = next(line for line in done.err.splitlines() if said in line)
    assert line.startswith(("  encoding.", f"  {ENTRY[kind]}: is"))
    assert not (evedrop.folder / "run").exists()


@pytest.mark.parametrize("name", ["mine", "nowhere.at.all:Mine", "mine:", ":Mine", "__main__:Mine", "os:path"])
def test_a_name_that_names_nothing_is_refused(name: str, evedrop: Evedrop) -> None:
    """Whatever is wrong with it, it is a mistake of the scenario with its path."""
    (evedrop.folder / "mine.toml").write_text(SCENARIO)
    for entry in ("encoding.scheme", "eavesdroppers.eve.strategy"):
        done = evedrop("check", "mine.toml", "--set", f'{entry}="{name}"')
        assert done.status == 2
        assert f'  {entry}: is "{name}"' in done.err
        assert "expected" in done.err
    assert evedrop("check", "--scheme", name).status == 2


def test_one_name_is_one_module(evedrop: Evedrop) -> None:
    """Two folders with a module of one name cannot be used in one session: nobody could tell which class it was."""
    for folder in ("here", "there"):
        (evedrop.folder / folder).mkdir()
        (evedrop.folder / folder / "twice.py").write_text(f"{HEAD}\n\nclass Mine(Plain):\n    pass\n")
        (evedrop.folder / folder / "s.toml").write_text(SCENARIO.replace('"plain"', '"twice:Mine"'))
    assert evedrop("check", "here/s.toml").status == 0
    done = evedrop("check", "there/s.toml")
    assert done.status == 2
    assert "another one of this name is loaded already" in done.err
    assert evedrop.process("check", "there/s.toml").status == 0


@pytest.mark.parametrize("name", ["json", "wave", "zenoh"])
@pytest.mark.parametrize("entry", ["encoding.scheme", "eavesdroppers.eve.strategy"])
def test_a_module_called_like_an_installed_one_is_refused(name: str, entry: str, evedrop: Evedrop) -> None:
    """Nothing in a folder of modules stands in place of Python's or a library's."""
    (evedrop.folder / f"{name}.py").write_text(f"{HEAD}\n\nclass Mine(Plain):\n    pass\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO)
    done = evedrop("check", "mine.toml", "--set", f"{entry}={name}:Mine")
    assert done.status == 2
    assert re.search(f"has a module {name} .*another one of this name is (loaded already|installed)", done.err)


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


def test_an_error_in_a_later_slot_names_the_line(evedrop: Evedrop) -> None:
    """In memory as live, by a worker too: status 3, what was raised, and where."""
    body = "Mine(Naive):\n    def uses(self, k):\n        return None if k < 20 else 1 / 0"
    (evedrop.folder / "tires.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO.replace('"naive"', '"tires:Mine"'))
    for words in (
        ("montecarlo", "--trials", "2"),
        ("montecarlo", "--trials", "600", "--workers", "2"),
        ("run", "--view", "off"),
    ):
        done = evedrop(words[0], "mine.toml", *words[1:], "--out", f"run{len(words)}{words[0]}")
        assert done.status == 3
        assert "ZeroDivisionError: division by zero" in done.err
        assert "tires.py" in done.err


def test_another_shape_in_a_later_slot_is_not_sent(evedrop: Evedrop) -> None:
    """Turned round, a packet has as many bytes as ever: live as in memory the run ends with status 3 and says what it was."""
    lines = (
        "from evedrop.model.schemes.plain import Plain",
        "class Turns(Plain):",
        "    def shared(self, keys, batch):",
        "        found = super().shared(keys, batch)",
        "        made = found.encoder",
        "        def encoder():",
        "            one = made()",
        "            encode = one.encode",
        "            one.encode = lambda k, x, predicted: encode(k, x if k < 30 else x.T, predicted)",
        "            return one",
        "        found.encoder = encoder",
        "        return found",
    )
    (evedrop.folder / "turns.py").write_text("\n".join(lines))
    (evedrop.folder / "mine.toml").write_text(SCENARIO.replace('"plain"', '"turns:Turns"'))
    live = evedrop("run", "mine.toml", "--trials", "4", "--view", "off", "--out", "live")
    assert live.status == 3
    assert "slot 30: encode of the scheme turns:Turns gave z of shape (4, 2); expected (2, 4)" in live.err
    assert evedrop("montecarlo", "mine.toml", "--trials", "4", "--out", "memory").status == 3


LATER = {
    "packet": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n"
               "        return Packet(x * (np.nan if k == 30 else 1.0), np.zeros(x.shape[1], bool))",
               "the scheme later_packet:Mine failed in slot 30, trials {trials}: Packet.z, trial {first}, is nan; "),
    "turned": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n"
               "        return Packet(x[:1] if k == 30 else x, np.zeros(x.shape[1], bool))",
               "the scheme later_turned:Mine failed in slot 30, trials {trials}: Packet.z has shape (1, "),
    "raised": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n"
               "        return Packet(x / [1.0 if k < 30 else None], np.zeros(x.shape[1], bool))",
               "the scheme later_raised:Mine failed in slot 30, trials {trials}: TypeError: "),
    "belief": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def step(self, k, belief, heard):\n"
               "        after = super().step(k, belief, heard)\n"
               "        return after if k != 30 else after._replace(x_hat=after.x_hat * np.nan)",
               "eve's strategy later_belief:Mine failed in slot 30, trials {trials}: Belief.x_hat, trial {first}, is nan"),
    "type": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def step(self, k, belief, heard):\n"
             "        after = super().step(k, belief, heard)\n"
             "        return after if k != 30 else after._replace(P=after.P.astype(np.float32))",
             "eve's strategy later_type:Mine failed in slot 30, trials {trials}: Belief.P has type float32; expected float64"),
    "fates": ("legitimate.link.loss.model", "Mine(Bernoulli):\n    parameters = {}\n"
              "    def __init__(self): super().__init__(0.9)\n    def fates(self, first, uniforms):\n"
              "        return super().fates(first, uniforms) if first < 32 else 1 / 0",
              "legitimate's link (later_fates:Mine) failed in slots 32 to 63, trials {trials}: ZeroDivisionError: "),
}  # fmt: skip
"""What of a class goes wrong in a later slot than the dry run sees → the entry, the class, what is said."""


def later(evedrop: Evedrop, case: str) -> tuple[str, ...]:
    """Write the scenario and the class of a case; the changes that name it."""
    entry, body, _ = LATER[case]
    (evedrop.folder / f"later_{case}.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO.replace("slots = 40", "slots = 100\nfirst_trial = 5"))
    if entry == ENTRY["link"]:
        return ("--set", f'legitimate.link={{loss = {{model = "later_{case}:Mine"}}}}')
    return ("--set", f"{entry}=later_{case}:Mine")


@pytest.mark.parametrize("case", LATER)
def test_what_breaks_in_a_later_slot_ends_a_study_in_memory(case: str, evedrop: Evedrop) -> None:
    """Status 3, as live, with class, slot and trials; and never an exit as if all were well."""
    changes = later(evedrop, case)
    assert evedrop("check", "mine.toml", *changes).status == 0
    done = evedrop("montecarlo", "mine.toml", "--trials", "20", "--out", "memory", *changes)
    assert done.status == 3
    assert LATER[case][2].format(trials="5 to 24", first=5) in done.err
    assert "Traceback" not in done.err
    assert not (evedrop.folder / "memory").exists()


@pytest.mark.parametrize(
    ("case", "words", "trials"),
    [
        ("packet", ("montecarlo", "--trials", "600", "--workers", "2"), ("5 to 504", "505 to 604")),
        ("packet", ("sweep", "--over", "seed=1,2", "--trials", "20"), ("5 to 24",)),
        ("packet", ("test", "--in-memory"), ("5 to 7",)),
        ("fates", ("compare", "--schemes", "plain", "--adversaries", "naive"), ("5 to 204",)),
    ],
    ids=["worker", "sweep", "test", "comparison"],
)
def test_every_command_in_memory_names_class_slot_and_trials(
    case: str, words: tuple[str, ...], trials: tuple[str, ...], evedrop: Evedrop
) -> None:
    """A worker process, a sweep, a test and a comparison say what a study does; of two workers, the one that fails first."""
    changes = later(evedrop, case)
    if words[0] == "test":
        text = (evedrop.folder / "mine.toml").read_text().replace('"plain"', '"later_packet:Mine"')
        (evedrop.folder / "mine.toml").write_text(text)
        changes = ()
    done = evedrop(words[0], "mine.toml", *words[1:], "--out", "out", *changes)
    assert done.status == 3
    assert any(LATER[case][2].format(trials=one, first=one.split()[0]) in done.err + done.out for one in trials)
    assert "Traceback" not in done.err


def test_a_link_of_a_run_that_goes_on_can_be_one_of_its_modules(tutorial: Evedrop) -> None:
    """The router knows where the run's modules are; a run that was started without any gets none on the way."""
    shifts = {"link": "legitimate", "set": {"loss": {"model": "shifts:Shifts", "period": 10, "good": 0.9, "bad": 0.1}}}
    scenario = load(tutorial.folder / "three.toml")
    assert with_event(scenario, shifts, 30).event[0].model_dump(exclude_none=True) == {"at": 30, **shifts}
    with pytest.raises(ScenarioError, match="set: names shifts:Shifts, and the run was started without modules"):
        with_event(load("vehicle"), shifts, 30)
    event = 'event=[{from = 5, to = 15, kill = "tracker"}, {at = 10, link = "naive", set = {loss = {model = "shifts:Shifts", '
    event += "period = 10, good = 0.9, bad = 0.1}}}]"
    for name, command in (
        ("live", ("run", "--view", "off", "--set", "trials=2")),
        ("memory", ("montecarlo", "--trials", "2")),
    ):
        words = (command[0], "three.toml", *command[1:], "--slots", "30", "--out", name, "--set", event)
        assert tutorial(*words).status == 0
    assert digests_of(tutorial.folder / "live") == digests_of(tutorial.folder / "memory")


def test_design_is_for_the_scheme_it_is_for(tutorial: Evedrop) -> None:
    """No closed form is invented for a scheme of somebody's own; an eavesdropper without one is left out and named."""
    done = tutorial("design", "three.toml")
    assert done.status == 2
    assert "no closed form is known for flipped:Flipped" in done.err
    (tutorial.folder / "louder.py").write_text(
        "from evedrop.extend import Plain\n\n\nclass Louder(Plain):\n    'Other packets, maybe.'\n"
    )
    done = tutorial("design", "three.toml", "--set", 'encoding={scheme = "louder:Louder"}')
    assert done.status == 2
    assert "no closed form is known for louder:Louder" in done.err
    paper = ("--set", 'encoding={scheme = "innovation", state_probability = 0.5}')
    done = tutorial("design", "three.toml", *paper, "--set", "eavesdroppers.tracker.link={quality = 0.9}", "--json")
    assert json.loads(done.out)["left_out"] == {"tracker": "tracker:Tracker"}


def test_a_plug_in_needs_one_module(tutorial: Evedrop) -> None:
    """The tutorial imports `evedrop.extend` and nothing else of Evedrop; every name there is documented and can be had."""
    text = PAGE.read_text(encoding="utf-8")
    assert set(re.findall(r"^(?:from|import) (evedrop[\w.]*)", text, flags=re.MULTILINE)) == {"evedrop.extend"}
    assert set(re.findall(r"evedrop\.(?:model|kernels|streams|live|memory)[\w.]*", text)) == set()
    assert all(
        getattr(extend, name).__doc__
        for name in extend.__all__
        if name not in {"Floats", "Flags", "Codes", "OutcomesAt"}
    )
    assert tutorial("check", "three.toml").status == 0


def test_classes_of_a_plug_in_are_compared(tutorial: Evedrop) -> None:
    """A comparison takes a scheme and an eavesdropper of one's own among the built-in ones."""
    words = (
        "--schemes",
        "flipped:Flipped,plain",
        "--adversaries",
        "naive,tracker:Tracker",
        "--trials",
        "20",
        "--slots",
        "60",
        "--json",
    )
    done = tutorial("compare", "three.toml", *words, "--out", "found")
    assert done.status == 0, done.err
    found = json.loads(done.out)
    assert [*found["schemes"]] == ["flipped:Flipped", "plain"]
    for scheme in found["schemes"].values():
        assert scheme["against"]["tracker:Tracker"]["eavesdropper"]["mean"] > 0.0
        assert scheme["against"]["naive"]["eavesdropper"]["mean"] > 0.0
    assert (tutorial.folder / "found" / "scenarios" / "flipped.Flipped.toml").is_file()
    wrong = tutorial("compare", "three.toml", "--schemes", "flipped:Flop", "--out", "wrong")
    assert wrong.status == 2
    assert "has no Flop; expected one of Sender, Reader, Flipped" in wrong.err

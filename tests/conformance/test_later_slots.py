"""A class of anybody's own that breaks in a later slot than the dry run sees."""

from __future__ import annotations

import pytest

from tests.conformance.own_classes import ENTRY, HEAD, SCENARIO
from tests.conftest import Evedrop

pytestmark = pytest.mark.usefixtures("imports_forgotten")


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

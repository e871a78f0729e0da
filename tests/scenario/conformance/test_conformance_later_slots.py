"""A class of anybody's own that breaks in a later slot than the dry run sees."""

from __future__ import annotations

import re

import pytest

from tests.conftest import Evedrop
from tests.examples import mostly_long
from tests.scenario.conformance.own_classes import ENTRY, HEAD, SCENARIO

pytestmark = pytest.mark.usefixtures("imports_forgotten")


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_another_shape_in_a_later_slot_is_not_sent(evedrop: Evedrop) -> None:
    """Turned round, a packet has as many bytes as before: live as in memory the run ends with status 3 and says what it was."""
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
    message = "the scheme turns:Turns failed in slot 30, trials 0 to 3: Packet.z has shape (4, 2); expected (2, 4)"
    assert message in live.err
    memory = evedrop("montecarlo", "mine.toml", "--trials", "4", "--out", "memory")
    assert memory.status == 3
    assert message in memory.err


_BLOCKS = """Blocks(PlainEncoder):
    def encode_block(self, slots, x, predicted):
        packets = PacketBlock(x, np.zeros((len(x), x.shape[2]), bool))
        {}


class Mine(Plain):
    def shared(self, keys, batch):
        return NoInnovations(self.process, batch.trials, Blocks, lambda: PlainEstimator(self.process, batch.trials))"""
_FOLLOWS = """Mine(Naive):
    def follow(self, slots, belief, gamma, z):
        found, last = super().follow(slots, belief, gamma, z)
        if 37 in slots:
            {}
        return found, last"""

LATER = {
    "nan_delays": ("legitimate.link.delay.model", "Mine(ConstantDelay):\n    parameters = {}\n"
                   "    def __init__(self): super().__init__(1.0)\n"
                   "    def delays(self, first, numbers):\n"
                   "        late = np.arange(first, first + len(numbers))[:, None] >= 32\n"
                   "        return np.where(late, np.nan, super().delays(first, numbers))",
                   "legitimate's link (later_nan_delays:Mine) failed in slots {slots}, trials {trials}: ValueError: "
                   "delays() gave nan"),
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
    "narrow": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n"
               "        return Packet(x if k != 37 else x.astype(np.float32), np.zeros(x.shape[1], bool))",
               "the scheme later_narrow:Mine failed in slot 37, trials {trials}: Packet.z has type float32; expected float64"),
    "uses": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def uses(self, k):\n        return None if k != 37 else 1 / 0",
             "eve's strategy later_uses:Mine failed in slot 37, trials {trials}: ZeroDivisionError: division by zero, "
             "later_uses.py line "),
    "flags": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def uses(self, k):\n"
              "        return None if k != 37 else np.zeros(7, bool)",
              "eve's strategy later_flags:Mine failed in slot 37, trials {trials}: ValueError: operands could not be broadcast"),
    "block": ("encoding.scheme", _BLOCKS.format("return packets if 37 not in slots else 1 / 0"),
              "the scheme later_block:Mine failed in slots {slots}, trials {trials}: ZeroDivisionError: division by zero, "
              "later_block.py line "),
    "short": ("encoding.scheme", _BLOCKS.format("return packets.rows(slice(0, -1 if 37 in slots else None))"),
              "the scheme later_short:Mine failed in slots {slots}, trials {trials}: PacketBlock.z has shape ("),
    "tuple": ("encoding.scheme", _BLOCKS.format("return tuple(packets) if 37 in slots else packets"),
              "the scheme later_tuple:Mine failed in slots {slots}, trials {trials}: encode_block() returned tuple; "),
    "follow": ("eavesdroppers.eve.strategy", _FOLLOWS.format("found.x_hat[37 - slots.start] = np.nan"),
               "eve's strategy later_follow:Mine failed in slots {slots}, trials {trials}: slot 37: Belief.x_hat, trial {first}, "
               "is nan; expected finite numbers"),
    "last": ("eavesdroppers.eve.strategy", _FOLLOWS.format("last = last._replace(P=last.P[:1])"),
             "eve's strategy later_last:Mine failed in slots {slots}, trials {trials}: "),
    "leaves": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def uses(self, k):\n"
               "        if k == 37:\n            raise SystemExit(0)",
               "eve's strategy later_leaves:Mine failed in slot 37, trials {trials}: SystemExit: 0, later_leaves.py line "),
    "file": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n"
             "        return Packet(x if k != 30 else open('/nowhere'), np.zeros(x.shape[1], bool))",
             "the scheme later_file:Mine failed in slot 30, trials {trials}: FileNotFoundError: [Errno 2] No such file"),
    "refuses": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n        from evedrop.extend import UsageError\n"
                "        if k == 30:\n            raise UsageError('no')\n        return Packet(x, np.zeros(x.shape[1], bool))",
                "the scheme later_refuses:Mine failed in slot 30, trials {trials}: UsageError: no, later_refuses.py line "),
    "mutates": ("encoding.scheme", "Mine(Sends):\n    def packet(self, k, x):\n        if k == 30:\n            x *= 2.0\n"
                "        return Packet(x, np.zeros(x.shape[1], bool))",
                "the scheme later_mutates:Mine failed in slot 30, trials {trials}: it changes in place what it is given "
                "(ValueError: "),
    "silences": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def step(self, k, belief, heard):\n        if k == 30:\n"
                 "            heard.z[:] = 0.0\n        return super().step(k, belief, heard)",
                 "eve's strategy later_silences:Mine failed in slot 30, trials {trials}: it changes in place what it is given "
                 "(ValueError: "),
    "acts": ("eavesdroppers.eve.strategy", "Mine(Naive):\n    def step(self, k, belief, heard):\n"
             "        after = super().step(k, belief, heard)\n"
             "        return after if k != 30 else after._replace(action=after.action + np.uint8(77))",
             "eve's strategy later_acts:Mine failed in slot 30, trials {trials}: the action of trial {first} is 78 after a "
             "packet was received; expected Action.STATE, INNOVATION or DISCARDED"),
    "hears": ("eavesdroppers.eve.strategy", _FOLLOWS.format("found.action[:] = 1"),
              "eve's strategy later_hears:Mine failed in slots {slots}, trials {trials}: slot "),
    "fates": ("legitimate.link.loss.model", "Mine(Bernoulli):\n    parameters = {}\n"
              "    def __init__(self): super().__init__(0.9)\n    def fates(self, first, uniforms):\n"
              "        return super().fates(first, uniforms) if first + len(uniforms) <= 32 else 1 / 0",
              "legitimate's link (later_fates:Mine) failed in slots {slots}, trials {trials}: ZeroDivisionError: "),
}  # fmt: skip
"""A failure of a class in a slot after those of the dry run → the entry, the class, the expected message."""


def later(evedrop: Evedrop, case: str) -> tuple[str, ...]:
    """Write the scenario and the class of a case; the changes that name it."""
    entry, body, _ = LATER[case]
    (evedrop.folder / f"later_{case}.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO.replace("slots = 40", "slots = 100\nfirst_trial = 5"))
    if entry == ENTRY["link"]:
        return ("--set", f'legitimate.link={{loss = {{model = "later_{case}:Mine"}}}}')
    if entry == ENTRY["delay"]:
        return ("--set", f'legitimate.link.delay={{model = "later_{case}:Mine"}}', "--set", "legitimate.window=3")
    return ("--set", f"{entry}=later_{case}:Mine")


OFTEN = ("packet", "uses", "block", "follow")
"""One case for each way into a class; the other cases use the same code."""


@pytest.mark.parametrize(
    "case", mostly_long(LATER, [*OFTEN, "fates", "nan_delays", "leaves", "file", "mutates", "acts", "hears"])
)
def test_what_breaks_in_a_later_slot_ends_a_study_in_memory(case: str, evedrop: Evedrop) -> None:
    """Status 3, as live, with class, slot and trials; and never an exit as if all were well."""
    changes = later(evedrop, case)
    assert evedrop("check", "mine.toml", *changes).status == 0
    done = evedrop("montecarlo", "mine.toml", "--trials", "20", "--out", "memory", *changes)
    assert done.status == 3
    assert LATER[case][2].format(trials="5 to 24", first=5, slots="32 to 63") in done.err
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
    assert any(
        LATER[case][2].format(trials=trial, first=trial.split()[0], slots="32 to 63") in done.err + done.out
        for trial in trials
    )
    assert "Traceback" not in done.err


@pytest.mark.thorough
@pytest.mark.parametrize("case", mostly_long(LATER, ["packet", "follow", "fates"]))
def test_what_breaks_in_a_later_slot_ends_a_live_run(case: str, evedrop: Evedrop) -> None:
    """Its process says the same as a study in memory; the slots of a block depend on how many packets had arrived."""
    changes = later(evedrop, case)
    done = evedrop("run", "mine.toml", "--view", "off", "--out", "live", *changes)
    assert done.status == 3
    message = re.escape(LATER[case][2].format(trials="5 to 7", first=5, slots="SLOTS")).replace("SLOTS", r"\d+ to \d+")
    assert re.search(message, done.err), done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    ("body", "change", "message"),
    [
        ("Mine(Bernoulli):\n    parameters = {}\n    chain = None\n    def __init__(self): super().__init__(0.9)\n"
         "    def quality_at(self, slots): return np.full(50, 0.9)[slots.start:slots.stop]",
         'legitimate.link={loss = {model = "stating:Mine"}}', "quality_at() of slots 0 to 99 has shape (50,)"),
        ("Mine(ConstantDelay):\n    parameters = {}\n    def __init__(self): super().__init__(1.0)\n"
         "    def arrived(self, lag): return (0.0, 1.0, 1.0, 1.0)[lag]",
         'legitimate={link = {quality = 0.9, delay = {model = "stating:Mine"}}, window = 6}',
         "arrived() of 0 to 99 raised IndexError"),
        ('Mine(Plain):\n    closed_forms = {"legitimate": lambda scheme, conditions: 1 / 0}',
         'encoding={scheme = "stating:Mine"}', "theory cannot ask a class: ZeroDivisionError"),
    ],
    ids=["quality_at", "arrived", "closed_forms"],
)  # fmt: skip
def test_what_a_class_states_is_checked_for_all_slots(evedrop: Evedrop, body: str, change: str, message: str) -> None:
    """Before anything is started, not at the end of the study."""
    (evedrop.folder / "stating.py").write_text(f"{HEAD}\n\nclass {body}\n")
    (evedrop.folder / "mine.toml").write_text(SCENARIO.replace("slots = 40", "slots = 100"))
    done = evedrop("check", "mine.toml", "--set", change)
    assert (done.status, message in done.err, "Traceback" in done.err) == (2, True, False), done.err

"""Text from others steers no terminal: control characters and those that change the direction of text are shown escaped."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evedrop.cli.console import StyledConsole
from evedrop.errors import ScenarioError
from evedrop.scenario.loading import load
from evedrop.scenario.progress_events import silent
from evedrop.simulate.montecarlo import simulate
from evedrop.system.output import Output, escaped, print_json
from tests.cli.terminal import Terminal
from tests.conftest import Evedrop

STEERING = [chr(one) for one in (*range(9), *range(11, 32), *range(127, 160))]
BIDIRECTIONAL = [chr(one) for one in (0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))]
EVIL = "\x1b]0;OWNED\x07\x1b[2J\x9b2J\u202egnp.exe\r"
SHOWN = r"\x1b]0;OWNED\x07\x1b[2J\x9b2J\u202egnp.exe\x0d"


@given(st.text(st.one_of(st.characters(exclude_categories=["Cs"]), st.sampled_from([*STEERING, *BIDIRECTIONAL]))))
def test_no_character_that_steers_is_left(text: str) -> None:
    """Whatever the text; the rest of it is as it was, and what is escaped once stays so."""
    shown = escaped(text)
    assert not set(shown) & {*STEERING, *BIDIRECTIONAL}
    assert escaped(shown) == shown
    if not set(text) & {*STEERING, *BIDIRECTIONAL}:
        assert shown == text


def test_output_is_escaped_and_styles_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """A console's own styles reach the stream; what it is given to draw does not steer."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = Terminal()
    output = Output(stream)
    output.write(f"{EVIL}\n")
    assert stream.getvalue() == f"{SHOWN}\n"
    stream.truncate(stream.seek(0))
    console = StyledConsole(output, force_terminal=True, color_system="standard", markup=False, highlight=False)
    console.print(EVIL, style="bold")
    # Rich leaves out a bell and a carriage return by itself.
    assert stream.getvalue() == "\x1b[1m" + SHOWN.replace(r"\x07", "").replace(r"\x0d", "") + "\x1b[0m\n"


def test_json_stays_json(capsys: pytest.CaptureFixture[str]) -> None:
    """Its own escapes are used, so that a program reads what was written."""
    print_json({"text": EVIL})
    out = capsys.readouterr().out
    assert escaped(out) == out
    assert json.loads(out) == {"text": EVIL}


@pytest.mark.parametrize("command", [["view", "run", "--table"], ["diff", "run", "other"], ["report", "run"]])
def test_the_summary_of_somebody_else(evedrop: Evedrop, command: list[str]) -> None:
    """Words of a summary are escaped where they are printed."""
    for name in ("run", "other"):
        scenario = load("eavesdroppers", {"slots": 6, "trials": 2, "expect": []})
        simulate(scenario, evedrop.folder / name, silent)
    path = evedrop.folder / "run" / "summary.json"
    summary = json.loads(path.read_text(encoding="utf-8"))
    text = json.dumps(evil_in(summary))
    path.write_text(text, encoding="utf-8")
    done = evedrop(*command)
    assert escaped(done.out + done.err) == done.out + done.err
    if command[0] == "view":
        assert "gnp.exe" in done.out + done.err


def evil_in(summary: dict[str, object]) -> dict[str, object]:
    """The summary with strange text in its title and its ending."""
    return {**summary, "scenario": f"title {EVIL}", "ended": f"ended {EVIL}"}


@pytest.mark.parametrize("command", [["check", "boom.toml"], ["montecarlo", "boom.toml", "--trials", "2"]])
def test_the_error_of_a_class(evedrop: Evedrop, command: list[str]) -> None:
    """The text of an exception that a class raises is escaped."""
    scenario = Path(evedrop.folder / "boom.toml")
    text = load("eavesdroppers", {"slots": 6, "expect": []}).to_toml()
    scenario.write_text(text.replace('scheme = "innovation"', 'scheme = "boom:Boom"'), encoding="utf-8")
    (evedrop.folder / "boom.py").write_text(f"raise RuntimeError({EVIL!r})\n", encoding="utf-8")
    done = evedrop(*command)
    assert done.status == 2
    assert r"\x1b]0;OWNED" in done.err
    assert escaped(done.out + done.err) == done.out + done.err


@pytest.mark.parametrize("character", BIDIRECTIONAL)
def test_titles_and_names_have_no_direction(character: str) -> None:
    """A character that reorders text is refused as other control characters are."""
    for change in ({"title": f"a{character}b"}, {"process.states": [f"a{character}", "b"]}, {f"a{character}": 1}):
        with pytest.raises(ScenarioError, match="control character"):
            load("eavesdroppers", change)

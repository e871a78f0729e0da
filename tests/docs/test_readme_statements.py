import re
import shlex
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.scenario.loading import load, parse
from evedrop.wire.file import example_wire

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """The README's code blocks in a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def test_scenario_is_one() -> None:
    """The scenario that the README shows is accepted as it stands."""
    (text,) = blocks("toml")
    assert parse(text, "README.md").receivers == ("legitimate", "antenna")


def test_what_is_steered_is_added_to_it(tmp_path: Path) -> None:
    """The plant and the controller that the README shows fit its scenario, and so do those of a new one fit that."""
    (tmp_path / "draught.csv").write_text("draught\n" + "0.1\n" * 2000)
    (text,) = blocks("toml")
    steered = re.search(r"```\n(\[plant\]\n.*?)```", README, re.S)
    assert steered is not None
    (tmp_path / "readme.toml").write_text(f"{text}\n{steered[1]}")
    new = (ROOT / "scenarios" / "_new.toml").read_text(encoding="utf-8")
    part = re.search(r"^# \[plant\]\n.*?^# input_weights.*?\n", new, re.S | re.M)
    assert part is not None
    uncommented = re.sub(r"^# (?=[\[a-z_]+(\]| =))", "", part[0], flags=re.M)
    (tmp_path / "new.toml").write_text(new.replace(part[0], uncommented))
    for name in ("readme", "new"):
        assert load(tmp_path / f"{name}.toml").controller is not None


def test_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The Python that the README shows runs, and prints a number and the columns."""
    (code,) = blocks("python")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})  # noqa: S102 - the page's own code
    error, columns = capsys.readouterr().out.splitlines()
    assert float(error) > 0.0
    assert "mean_squared_error" in columns


def test_every_command_is_one() -> None:
    """The parser takes each `evedrop` command that the README quotes."""
    lines = [line.removeprefix("$ ") for line in README.splitlines()]
    quoted = [shlex.split(line, comments=True) for line in lines if line.startswith("evedrop ")]
    assert len(quoted) >= 20
    for words in quoted:
        assert cli.parser_of(words[1]).parse_args(words[1:]).command is not None


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(((?!https?:)[^)]+)\)", README))))
def test_links_lead_somewhere(link: str) -> None:
    """Every document, picture and test that the README links to is there."""
    assert (ROOT / link.partition("#")[0]).is_file()


def test_every_guarantee_names_its_tests() -> None:
    """Each item of the list links to a test, or to a file of tests, that holds it."""
    _, _, guarantees = README.partition("## Guarantees\n")
    items = re.split(r"^- ", guarantees, flags=re.MULTILINE)[1:]
    assert len(items) == 6
    assert all(re.search(r"\[tests\]\(tests/[\w/]+\.py\)", item) for item in items)


@pytest.mark.parametrize("page", ["README.md", "docs/links.md"])
def test_a_run_over_a_wire_works_as_printed(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the example of a wire, as the line above it writes it; in memory, where it is quick."""
    (line,) = re.findall(
        r"^\$? ?evedrop (run .*--wire robot\.toml .*)$", (ROOT / page).read_text("utf-8"), re.MULTILINE
    )
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(example_wire(), encoding="utf-8")
    command, *words = shlex.split(line)
    assert command == "run"
    assert cli.main(["montecarlo", *words, "--trials", "20", "--workers", "1"]) == 0

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from evedrop.cli import main as cli
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.schemes import SCHEMES
from evedrop.scenario.loading import load, parse
from evedrop.studies.matchups import ATTACKERS
from evedrop.wire.file import example_wire, load_wire
from tests.conftest import LIMIT
from tests.wire.wire_links import key_fates

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """The README's code blocks in a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def test_scenario_is_one() -> None:
    """The scenario that the README shows is accepted as it stands."""
    (text,) = blocks("toml")
    assert parse(text, "README.md").receivers == ("legitimate", "antenna")


def test_what_is_steered_is_added_to_a_new_one(tmp_path: Path) -> None:
    """The plant and the controller of a new scenario, which stand there in comments, fit it."""
    (tmp_path / "draught.csv").write_text("draught\n" + "0.1\n" * 2000)
    new = (ROOT / "scenarios" / "_new.toml").read_text(encoding="utf-8")
    part = re.search(r"^# \[plant\]\n.*?^# input_weights.*?\n", new, re.S | re.M)
    assert part is not None
    uncommented = re.sub(r"^# (?=[\[a-z_]+(\]| =))", "", part[0], flags=re.M)
    (tmp_path / "new.toml").write_text(new.replace(part[0], uncommented))
    assert load(tmp_path / "new.toml").controller is not None


def test_the_class_keeps_the_rules_and_reads_the_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The eavesdropper that the README shows, checked and used as it says."""
    _, code = blocks("python")
    (scenario,) = blocks("toml")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thirds.py").write_text(code, encoding="utf-8")
    text = scenario.partition("[[expect]]")[0].replace('"smart"', '"thirds:Thirds"')
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    assert "`evedrop check --eavesdropper thirds:Thirds`" in README
    assert cli.main(["check", "--eavesdropper", "thirds:Thirds"]) == 0
    assert cli.main(["montecarlo", "mine.toml", "--trials", "5", "--slots", "50", "--workers", "1"]) == 0


@pytest.mark.thorough
def test_the_test_of_a_radio_passes(tmp_path: Path) -> None:
    """From the repository, as the README shows it; its function has six lines."""
    code, _ = blocks("python")
    _, _, body = code.partition("(evedrop_wire):\n")
    assert len(body.splitlines()) == 6
    (tmp_path / "test_radio.py").write_text(code, encoding="utf-8")
    words = [
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(tmp_path),
        str(tmp_path / "test_radio.py"),
    ]
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False, timeout=LIMIT
    )
    assert done.returncode == 0, done.stdout


def test_what_the_radio_always_loses(tmp_path: Path) -> None:
    """The numbers that the README names, by the fates of the example's link."""
    (tmp_path / "robot.toml").write_text(example_wire(), encoding="utf-8")
    plan = load_wire(tmp_path / "robot.toml")
    (radio,) = (link for link in plan.links if link.name == "radio")
    fates = key_fates(radio, "chatter/numbers", "put", plan.seed)
    lost = [number for number in range(77) if fates.next()[0] != 0]
    words = re.search(r"The first numbers missing are (\d+), (\d+) and (\d+) each time", README)
    assert words is not None
    assert [*map(int, words.groups())] == lost


def test_every_command_is_one() -> None:
    """The parser takes each `evedrop` command that the README quotes, in a block or in a line."""
    lines = [line.removeprefix("$ ") for line in README.splitlines()] + re.findall(r"`(evedrop [^`\n]+)`", README)
    quoted = [
        shlex.split(re.split(" (?:>|&&) ", line)[0], comments=True) for line in lines if line.startswith("evedrop ")
    ]
    assert len(quoted) >= 8
    for words in quoted:
        assert cli.parser_of(words[1]).parse_args(words[1:]).command is not None


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(((?!https?:)[^)]+)\)", README))))
def test_links_lead_somewhere(link: str) -> None:
    """Every document, picture and test that the README links to is there."""
    assert (ROOT / link.partition("#")[0]).is_file()


def test_every_guarantee_names_its_tests() -> None:
    """Each item of the list links to a test, or to a file of tests, that holds it."""
    _, _, guarantees = README.partition("## What is guaranteed\n")
    guarantees, _, _ = guarantees.partition("\n## ")
    _, *items = re.split(r"^- ", guarantees, flags=re.MULTILINE)
    assert len(items) == 6
    assert all(re.search(r"\[tests\]\(tests/[\w/]+\.py\)", item) for item in items)


def test_a_run_over_a_wire_works_as_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the example of a wire, as the line above it writes it; in memory, where it is quick."""
    (line,) = re.findall(
        r"^\$? ?evedrop (run .*--wire robot\.toml .*)$", (ROOT / "docs" / "links.md").read_text("utf-8"), re.MULTILINE
    )
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(example_wire(), encoding="utf-8")
    command, *words = shlex.split(line)
    assert command == "run"
    assert cli.main(["montecarlo", *words, "--trials", "20", "--workers", "1"]) == 0


def test_it_counts_what_there_is() -> None:
    """Schemes, eavesdroppers, and attacks on acknowledgements."""
    counts = re.search(r"\[(\d+) schemes\]\(docs/schemes\.md\) against (\d+) eavesdroppers and (\d+) attacks", README)
    assert counts is not None
    assert [*map(int, counts.groups())] == [len(SCHEMES), len(STRATEGIES.names), len(ATTACKERS)]


def test_the_first_page_is_short() -> None:
    """At most 150 lines."""
    assert len(README.splitlines()) <= 150


def test_the_description_of_the_package_leads_to_no_file() -> None:
    """Where the repository's files are not, a link keeps its words, and a picture is left out."""
    path = ROOT / "tools" / "hatch_build.py"
    spec = importlib.util.spec_from_file_location("hatch_build", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = module.without_files(README)
    assert set(re.findall(r"\]\((.{5})", text)) == {"https"}
    assert "(docs/" not in text
    assert "The tutorial goes on from here." in text
    assert "![" not in text

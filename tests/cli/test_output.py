"""A command whose output nobody reads, or has a narrow encoding: its status and its files are as always."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from evedrop.cli.commands import MODULES, ROLES
from evedrop.system.output import Output, print_json, standard_streams, wrapped
from tests.conftest import Evedrop
from tests.examples import mostly_long

WIRE = Path(__file__).parents[2] / "docs" / "examples" / "wire" / "radio.toml"
SMALL = ("--slots", "20", "--trials", "2")
FAILS = ("--set", "expect.0.below=1e-9")
COMMANDS = {
    "list": ("list",),
    "show": ("show", "eavesdroppers"),
    "new": ("new", "mine.toml"),
    "check": ("check", "eavesdroppers", "nothing"),
    "check a class": ("check", "--scheme", "innovation"),
    "run": ("run", "eavesdroppers", "--slots", "20", "--view", "off", *FAILS, "--out", "out"),
    "montecarlo": ("montecarlo", "eavesdroppers", *SMALL, *FAILS, "--out", "out"),
    "test": ("test", "fails.toml", "holds.toml", "--in-memory", "--trials", "2", "--junit", "junit.xml", "--out", "out"),
    "wire": ("wire", str(WIRE), "--for", "1", "--out", "out"),
    "compare": ("compare", "eavesdroppers", *SMALL, "--schemes", "plain", "--adversaries", "smart", "--out", "out"),
    "sweep": ("sweep", "eavesdroppers", *SMALL, "--over", "seed=1,2", "--out", "out"),
    "design": ("design", "numerical"),
    "design a schedule": ("design", "numerical", "--schedule", "3", "--max-trace", "0.1"),
    "cost": ("cost", "microgrid", "--slots", "130", "--trials", "2"),
    "learned": ("learned", "learning", "--slots", "9", "--trials", "2", "--set", "expect=[]"),
    "figures": ("figures", "figures"),
    "paper": ("paper", "crimson2023", "--quick", "--out", "papers"),
    "links": ("links", "fit", "link.csv"),
    "process": ("process", "fit", "states.csv"),
    "status": ("status", "study"),
    "view": ("view", "study", "--table"),
    "export": ("export", "study", "study.mcap"),
    "report": ("report", "study"),
    "diff": ("diff", "study", "other"),
    "docs": ("docs", "design"),
    "completion": ("completion", "bash"),
    "selftest": ("selftest",),
    "brief": ("brief", "numerical", "--out", "briefs"),
}  # fmt: skip
LEFT_OUT = {"demo", "link", "partition", "heal", "pause", "resume", "step", "health", "host", *ROLES}
"""Commands that do what another one does, or that need a run in progress, and compute nothing."""
FAILS_WITH = {"check": 2, "run": 1, "montecarlo": 1, "test": 1, "diff": 1, "status": 2, "wire": 1}
"""Command → its status, if it is not 0."""
USUAL = {
    *("list", "show", "new", "check", "run", "montecarlo", "test", "links", "process", "status", "view", "export"),
    *("report", "diff", "docs", "completion", "brief"),
}
"""Commands that `make test` tries; the studies among the others print and write as `montecarlo` does."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two studies that differ, scenarios that fail and hold, and recordings of a link and of states."""
    folder = tmp_path_factory.mktemp("inputs")
    for name, seed in (("study", "1"), ("other", "2")):
        assert Evedrop(folder)("montecarlo", "eavesdroppers", *SMALL, "--seed", seed, "--out", name).status == 0
        (folder / name / "report.html").unlink()
    (folder / "other" / "report.html").unlink(missing_ok=True)
    shown = Evedrop(folder)("show", "eavesdroppers").out.replace("slots = 5000", "slots = 20")
    (folder / "holds.toml").write_text(shown.replace("below = 0.01", "below = 1e9"), encoding="utf-8")
    (folder / "fails.toml").write_text(shown.replace("below = 0.01", "below = 1e-9"), encoding="utf-8")
    random = np.random.default_rng(1)
    np.savetxt(folder / "link.csv", random.integers(0, 2, 200), "%d", header="received", comments="")
    walk = np.cumsum(random.normal(size=(200, 2)), axis=0)
    np.savetxt(folder / "states.csv", walk, delimiter=",", header="x,y", comments="")
    return folder


def copied(inputs: Path, folder: Path) -> Evedrop:
    """A command in a copy of the inputs."""
    shutil.copytree(inputs, folder)
    return Evedrop(folder)


def files(evedrop: Evedrop) -> dict[str, bool]:
    """The files that a command left, and whether each of them contains something; names of its temporary files vary."""
    return {
        str(path.relative_to(evedrop.folder)): path.stat().st_size > 0
        for path in evedrop.folder.rglob("*")
        if path.is_file() and evedrop.temporary not in path.parents
    }


def test_every_command_is_listed() -> None:
    """A new command is tried here, too, or its author says why not."""
    assert {words[0] for words in COMMANDS.values()} | LEFT_OUT == {*MODULES}


@contextlib.contextmanager
def nobody() -> Iterator[io.TextIOWrapper]:
    """The write end of a pipe whose reader is gone."""
    ends = os.pipe()
    os.close(ends[0])
    with os.fdopen(ends[1], "w") as file:
        yield file


@pytest.mark.parametrize("name", mostly_long(COMMANDS, USUAL))
def test_the_output_changes_neither_status_nor_files(name: str, inputs: Path, tmp_path: Path) -> None:
    """Whether all of it is read, none of it, or in an encoding that has no Greek letters."""
    ordinary, unread, narrow = (copied(inputs, tmp_path / name) for name in ("ordinary", "unread", "narrow"))
    done = ordinary(*COMMANDS[name])
    with nobody() as output:
        alone = unread.process(*COMMANDS[name], stdout=output)
    with (
        contextlib.chdir(narrow.folder),
        (tmp_path / "said").open("w", encoding="ascii") as file,
        contextlib.redirect_stdout(file),
        contextlib.redirect_stderr(file),
    ):
        from evedrop.cli.main import main

        status = main(COMMANDS[name])
    expected = FAILS_WITH.get(name, 0)
    assert (done.status, alone.status, status) == (expected, expected, expected), alone.err
    assert files(unread) == files(narrow) == files(ordinary)
    assert "Traceback" not in alone.err
    printed = (tmp_path / "said").read_text(encoding="ascii")
    assert len(printed.splitlines()) >= len(done.out.splitlines())


SETTINGS = {
    "latin-1": {"PYTHONIOENCODING": "latin-1"},
    "no locale": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", mostly_long(SETTINGS, ["latin-1"]))
def test_an_output_in_latin_1_ends_no_run(name: str, inputs: Path, tmp_path: Path) -> None:
    """With the processes of a run, which inherit the setting, and with a locale without any encoding."""
    evedrop = copied(inputs, tmp_path / name)
    done = evedrop.begun(*COMMANDS["run"], env={**evedrop.environment, **SETTINGS[name]}, encoding="latin-1").end()
    assert (done.status, done.err) == (1, "")
    assert "|x-x_hat|" in done.out
    assert (evedrop.folder / "out" / "report.html").read_text(encoding="utf-8").endswith("</html>\n")


def test_what_a_class_prints_is_not_among_the_json(evedrop: Evedrop) -> None:
    """It goes to standard error."""
    (evedrop.folder / "chatty.py").write_text(
        "from evedrop.extend import Bernoulli\n\n\nclass Chatty(Bernoulli):\n    def __init__(self, **given):\n"
        "        print('I am made')\n        super().__init__(**given)\n"
    )
    words = ("montecarlo", "eavesdroppers", "--trials", "2", "--slots", "9", "--set", "expect=[]")
    link = 'legitimate.link={loss={model="chatty:Chatty", quality=0.8}}'
    done = evedrop.process(*words, "--set", link, "--json")
    assert done.status == 0
    assert "I am made" in done.err
    assert json.loads(done.out)["trials"] == 2


def test_json_in_any_encoding_has_the_same_content(tmp_path: Path) -> None:
    """Characters that the encoding lacks are escaped, as JSON escapes them."""
    value = {"μ_d": ["ü", "😀", 0.5]}
    for encoding in ("utf-8", "latin-1", "ascii"):
        with (tmp_path / encoding).open("w", encoding=encoding) as file, contextlib.redirect_stdout(file):
            print_json(value)
        assert json.loads((tmp_path / encoding).read_text(encoding=encoding)) == value


@pytest.mark.parametrize(
    ("encoding", "printed"),
    [
        ("utf-8", "μ_d, Ω ≥ |x − x̂|² ± ½ · 10⁻¹², ü, ₖ, ϕ, ✔✓✗, \\udcff"),
        ("latin-1", "mu_d, Omega >= |x - x_hat|² ± ½ · 10^-¹², ü, _k, \\u03d5, Vvx, \\udcff"),
        ("ascii", "mu_d, Omega >= |x - x_hat|^2 +/- \\xbd - 10^-12, \\xfc, _k, \\u03d5, Vvx, \\udcff"),
    ],
)
def test_a_character_that_the_encoding_lacks_is_spelled(encoding: str, printed: str, tmp_path: Path) -> None:
    """Greek letters by name, exponents and indices with a mark, all others by number; others stay as they are."""
    with (
        (tmp_path / "said").open("w", encoding=encoding) as file,
        contextlib.redirect_stdout(file),
        standard_streams(),
    ):
        sys.stdout.write("μ_d, Ω ≥ |x − x̂|² ± ½ · 10⁻¹², ü, ₖ, ϕ, ✔✓✗, \udcff")
    assert (tmp_path / "said").read_text(encoding=encoding) == printed


def test_text_after_an_error_is_lost() -> None:
    """A stream fails once; nothing is written later, and its length is what Python expects."""

    class Full(io.StringIO):
        written = 0

        def write(self, text: str) -> int:
            self.written += len(text)
            raise OSError(28, "No space left on device")

    full = Full()
    output = Output(full)
    assert [output.write("abc"), output.write("d")] == [3, 1]
    assert full.written == 3
    assert output.failed is not None


@pytest.mark.parametrize(("name", "status"), [("list", 2), ("montecarlo", 1)])
def test_a_full_disk_behind_the_output_is_named_and_costs_no_file(
    name: str, status: int, inputs: Path, tmp_path: Path
) -> None:
    """The status says so only if it would say that all is well."""
    evedrop = copied(inputs, tmp_path / "here")
    with Path("/dev/full").open("w") as full:
        done = evedrop.process(*COMMANDS[name], stdout=full)
    assert done.status == status
    assert done.err.startswith("evedrop: standard output: No space left on device; ")
    assert name == "list" or (evedrop.folder / "out" / "report.html").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("closed", mostly_long(["<&-", ">&-", "2>&-"], [">&-"]))
def test_a_stream_that_the_shell_closed_does_no_harm(closed: str, inputs: Path, tmp_path: Path) -> None:
    """A run has the status and the files that it always has."""
    evedrop = copied(inputs, tmp_path / "here")
    words = " ".join(COMMANDS["run"])
    shell = ["/bin/sh", "-c", f"exec {sys.executable} -m evedrop {words} {closed}"]
    done = subprocess.run(
        shell, cwd=evedrop.folder, env=evedrop.environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (1, "")
    assert (evedrop.folder / "out" / "report.html").exists()


@pytest.mark.parametrize("columns", [30, 40, 60])
def test_the_carets_below_a_line_of_a_file_are_seen(columns: int) -> None:
    """However narrow the terminal is: the beginning of the line is left out where it would push them off."""
    row = '   12 | encoding = { scheme = "scheduled", threshold = 4.0, mistaken = 0.55 }'
    carets = f"{' ' * row.index('mistaken')}^^^^^^^^"
    shown = wrapped(f"{row}\n      | {carets[8:]}", columns).split("\n")
    assert all(len(line) <= columns for line in shown)
    assert shown[0].startswith("   12 | …")
    assert shown[0][shown[1].index("^") : shown[1].rindex("^") + 1] == "mistaken"

"""Every table that a command prints can be written as CSV and as LaTeX."""

from __future__ import annotations

import ast
import csv
import itertools
import re
import shlex
from functools import cache
from importlib import import_module
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import evedrop.cli
from evedrop.cli.api import montecarlo, sweep
from evedrop.cli.commands import MODULES, ROLES
from evedrop.cli.options import tables
from evedrop.errors import RunError
from evedrop.model.metrics.text import estimate, finite_text, number_text
from evedrop.show.report.text_table import TextTable, csv_text, latex_escaped, latex_text
from tests.conftest import Evedrop

CLI = Path(evedrop.cli.__file__).parent
OF_OTHERS = {"demo", "run"}
"""Live commands, which print the closing report as `montecarlo` does."""
COMMANDS = {
    "montecarlo": "montecarlo eavesdroppers --trials 4 --slots 30 --set expect=[]",
    "sweep": "sweep eavesdroppers --over encoding.state_probability=0.3,0.6 --trials 4 --slots 30 --set expect=[]",
    "compare": "compare eavesdroppers --schemes plain,innovation --adversaries smart --trials 4 --slots 20 --set expect=[]",
    "design": "design eavesdroppers",
    "cost": "cost microgrid --trials 3 --slots 130 --set expect=[]",
    "learned": "learned learning --trials 4 --slots 9 --set expect=[]",
    "paper": "paper kennedy2022 --quick",
    "view": "view run --table",
}


@cache
def functions(module: str) -> tuple[dict[str, set[str]], dict[str, str]]:
    """The functions of a module of the command line with the names in them, and imported name → module."""
    tree = ast.parse((CLI / Path(*module.split(".")).with_suffix(".py")).read_text(encoding="utf-8"))
    inner = {
        node.name: {used.id for used in ast.walk(node) if isinstance(used, ast.Name)}
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
    }
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module is not None]
    ours = {
        name.name: node.module.removeprefix("evedrop.cli.")
        for node in imports
        for name in node.names
        if node.module is not None and node.module.startswith("evedrop.cli.")
    }
    return inner, ours


def prints_tables(module: str, name: str) -> bool:
    """Whether a function of the command line, or one that it names, makes a console for tables."""
    seen: set[tuple[str, str]] = set()
    waiting = [(module, name)]
    while waiting:
        place = waiting.pop()
        if place[1] == "terminal":
            return True
        if place not in seen:
            seen.add(place)
            inner, ours = functions(place[0])
            for used in inner.get(place[1], ()):
                waiting += [(place[0], used)] if used in inner else [(ours[used], used)] if used in ours else []
    return False


def test_every_command_that_prints_a_table_writes_it() -> None:
    """By the source of all commands: one that makes a console for tables takes --csv and --latex, and no other one does.

    Processes of a run take a brief and nothing else; the recorder among them prints the report, which `view --table` does again.
    """
    commands = [
        (module, command)
        for module in dict.fromkeys(MODULES.values())
        for command in import_module(f"evedrop.cli.commands.{module}").COMMANDS
    ]
    printing = {
        command.name for module, command in commands if prints_tables(f"commands.{module}", command.run.__name__)
    }
    assert {command.name for _, command in commands if tables in command.options} == printing - {*ROLES}
    assert printing - {*ROLES} == COMMANDS.keys() | OF_OTHERS


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.thorough
def test_tables_are_written(name: str, evedrop: Evedrop) -> None:
    """The rows on the terminal are in the file, numbers can be read, and LaTeX has nothing that it would stumble over."""
    if name == "view":
        assert evedrop(*shlex.split(COMMANDS["montecarlo"]), "--out", "run").status == 0
    done = evedrop(*shlex.split(COMMANDS[name]), "--csv", "a.csv", "--latex", "a.tex")
    assert done.status in {0, 1}, done.err
    files = sorted(evedrop.folder.glob("a*.csv"))
    assert files
    for file in files:
        heads, *rows = csv.reader(file.read_text(encoding="utf-8").splitlines())
        assert rows
        assert len(set(heads)) == len(heads)
        assert {len(row) for row in rows} == {len(heads)}
        assert not [cell for row in rows for cell in row if "±" in cell and cell[:1].isdigit() and "(" not in cell]
    text = (evedrop.folder / "a.tex").read_text(encoding="utf-8")
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == len(files)
    body = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("%"))
    assert body.isascii(), {character for character in body if not character.isascii()}
    for line in body.splitlines():
        plain = re.sub(r"\\[$_%&#{}]", "", line)
        assert plain.count("$") % 2 == 0, line
        assert plain.count("{") == plain.count("}"), line
        assert not re.search(r"[#%]|(?<!\\)_(?![{])", re.sub(r"\$[^$]*\$", "", plain)), line


@pytest.mark.long
def test_numbers_are_at_full_precision(evedrop: Evedrop) -> None:
    """The CSV of a sweep has the very numbers of sweep.parquet, and their standard errors in columns of their own."""
    assert evedrop(*shlex.split(COMMANDS["sweep"]), "--out", "swept", "--csv", "a.csv").status == 0
    rows = list(csv.DictReader((evedrop.folder / "a.csv").read_text(encoding="utf-8").splitlines()))
    table = pq.read_table(evedrop.folder / "swept" / "sweep.parquet").to_pylist()
    assert len(rows) == len(table)
    for row, exact in zip(rows, table, strict=True):
        assert row["peer"] == exact["peer"]
        assert float(row["mean error"]) == exact["mean_squared_error"]
        assert float(row["mean error standard error"]) == exact["mean_squared_error_standard_error"]


def test_a_table_of_one_of_several_eavesdroppers_names_it(evedrop: Evedrop) -> None:
    """The terminal has the name above the table; a file has nothing above it."""
    smart = '{strategy = "smart", link = {quality = 0.85}}'
    both = f"eavesdroppers={{near = {smart}, far = {smart}}}"
    design = ("design", "numerical", "--schedule", "3", "--max-trace", "0.004", "--set", both)
    assert evedrop(*design, "--csv", "a.csv").status == 0
    tables = [list(csv.DictReader((evedrop.folder / name).read_text().splitlines())) for name in ("a.csv", "a-2.csv")]
    assert [[row["against"] for row in table] for table in tables] == [["near"] * 3, ["far"] * 3]


def test_errors_by_direction_are_in_the_file_with_and_without_details(evedrop: Evedrop) -> None:
    """The terminal shows them with --verbose only."""
    study = shlex.split("montecarlo partial-encryption --trials 2 --slots 40 --set expect=[]")
    for verbose in ([], ["--verbose"]):
        assert evedrop(*study, *verbose, "--out", f"run{len(verbose)}", "--csv", f"a{len(verbose)}.csv").status == 0
    (short, whole) = ((evedrop.folder / f"a{verbose}-2.csv").read_text(encoding="utf-8") for verbose in (0, 1))
    assert short == whole
    assert short.startswith("receiver,direction,")


def by_hand() -> TextTable:
    """A table with everything that may be in one."""
    table = TextTable.headed(["receiver"], ["mean |x − x̂|²", "μ_d", "z"], ["words"], "The title")
    table.add("a_b & c", estimate(0.0123456789, 0.0004) + "*", finite_text(float("inf")), number_text(None), "–")
    table.add("", estimate(2.5e-7, None), number_text(0.1), number_text(-1.25, "+.2f"), "50 % {x}")
    return table


def test_csv_is_as_written_by_hand() -> None:
    """The whole text."""
    assert csv_text(by_hand()) == (
        "receiver,mean |x − x̂|²,mean |x − x̂|² standard error,mean |x − x̂|² note,μ_d,z,words\n"
        "a_b & c,0.0123456789,0.0004,*,inf,,\n"
        "a_b & c,2.5e-07,,,0.1,-1.25,50 % {x}\n"
    )


def test_latex_is_as_written_by_hand() -> None:
    """The whole text."""
    assert latex_text(by_hand()) == (
        "% The title\n"
        "\\begin{tabular}{lrrrl}\n"
        "\\hline\n"
        "receiver & mean $|$x $-$ $\\hat{x}|^{2}$ & $\\mu$\\_d & z & words \\\\\n"
        "\\hline\n"
        "a\\_b \\& c & 0.0123 $\\pm$ 0.0004* & $\\infty$ & -- & -- \\\\\n"
        " & 2.5e-07 & 0.1 & -1.25 & 50 \\% \\{x\\} \\\\\n"
        "\\hline\n"
        "\\end{tabular}\n"
    )


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("λ₁", r"$\lambda_{1}$"),
        ("10⁻³", "10$^{-3}$"),
        ("Ω ≥ ε", r"$\Omega$ $\geq$ $\epsilon$"),
        ("x̄ á", r"$\bar{x}$ á"),
        (r"C:\~^", r"C:\textbackslash{}\textasciitilde{}\textasciicircum{}"),
        ("(0.1, 1] ∪ $5 #1", r"(0.1, 1] $\cup$ \$5 \#1"),
        ("Ο ο Α", "$O$ $o$ $A$"),
    ],
)
def test_text_is_escaped(text: str, latex: str) -> None:
    """Greek letters, indices, accents, and LaTeX's own characters."""
    assert latex_escaped(text) == latex


def test_a_verdict_is_a_word_in_latex() -> None:
    """Its mark needs a package, or a font; elsewhere a question mark is a question mark."""
    table = TextTable.headed(["verdict"], [])
    for text in ("✔ perfectly secret", "✓ secret", "? cannot tell yet", "✗ not secret", "what? it"):
        table.add(text)
    rows = [line for line in latex_text(table).splitlines() if line.endswith("\\\\")][1:]
    assert [row.removesuffix(" \\\\") for row in rows] == [
        "perfectly secret",
        "secret",
        "cannot tell yet",
        "not secret",
        "what? it",
    ]


def test_the_table_of_a_run_has_verdicts_and_ratios_but_no_digests_in_latex(tmp_path: Path) -> None:
    """As that of a sweep; the legitimate estimator has neither, and a sensor that measures has a second ratio."""
    for scenario, ratios in (
        ("eavesdroppers", ["times the error"]),
        ("measured", ["times the error", "times the true error"]),
    ):
        results = montecarlo(scenario, trials=20, slots=40, expect=[])
        (path,) = results.to_csv(tmp_path / f"{scenario}.csv")
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        assert list(rows[0])[-2 - len(ratios) :] == ["verdict", *ratios, "digest"]
        for row in rows:
            secrecy = results.secrecy.get(row["receiver"])
            assert row["times the error"] == (
                "" if secrecy is None or secrecy.verdict is None else secrecy.verdict.times
            )
        heads = results.to_latex(tmp_path / f"{scenario}.tex").read_text().splitlines()[3]
        assert heads.endswith(" & ".join(["verdict", *ratios]) + r" \\")


def test_a_narrow_terminal_changes_no_file(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a narrow terminal leaves out is in the file."""
    words = shlex.split(COMMANDS["montecarlo"])
    texts = []
    for columns in ("200", "40"):
        monkeypatch.setattr("evedrop.cli.report.sys.stdout.isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", columns)
        assert evedrop(*words, "--csv", f"{columns}.csv").status == 0
        texts.append((evedrop.folder / f"{columns}.csv").read_text())
    assert texts[0] == texts[1]


def test_misuse_is_refused(evedrop: Evedrop) -> None:
    """Together with --json there is no table; a file that cannot be written is named."""
    done = evedrop("design", "eavesdroppers", "--json", "--csv", "a.csv")
    assert (done.status, "leave --json or these out" in done.err) == (2, True), done.err
    done = evedrop("design", "eavesdroppers", "--latex", "no/a.tex")
    assert (done.status, "no/a.tex cannot be written" in done.err) == (2, True), done.err


def test_both_tables_in_one_file_are_refused(evedrop: Evedrop) -> None:
    """One would replace the other, also by another name of the same file."""
    (evedrop.folder / "there").mkdir()
    done = evedrop("design", "numerical", "--csv", "same", "--latex", "there/../same")
    assert (done.status, done.err) == (2, "evedrop: --csv and --latex are both same; give two files\n")
    assert not (evedrop.folder / "same").exists()


def test_python_writes_them_too(tmp_path: Path) -> None:
    """`to_csv` and `to_latex` of results."""
    run = montecarlo("eavesdroppers", trials=4, slots=20, expect=[])
    swept = sweep("eavesdroppers", {"slots": [10, 20]}, trials=4, expect=[])
    for i, results in enumerate((run, swept)):
        (path,) = results.to_csv(tmp_path / f"{i}.csv")
        rows = list(itertools.islice(csv.reader(path.read_text(encoding="utf-8").splitlines()), 3))
        assert len(rows) == 3
        assert r"\begin{tabular}" in results.to_latex(tmp_path / f"{i}.tex").read_text()


def test_a_table_that_cannot_be_written_is_refused_at_the_start(evedrop: Evedrop) -> None:
    """Before anything is simulated; a file of a results folder that the command makes is written."""
    small = ("montecarlo", "eavesdroppers", "--trials", "2", "--slots", "9", "--set", "expect=[]")
    for option in ("--csv", "--latex"):
        done = evedrop(*small, "--out", "out", option, "nowhere/table")
        assert (done.status, done.out) == (2, "")
        assert done.err.startswith(
            "evedrop: nowhere/table cannot be written (No such file or directory); give another file"
        )
    assert not (evedrop.folder / "out").exists()
    assert evedrop(*small, "--out", "out", "--csv", "out/table.csv", "--latex", "table.tex").status == 0
    assert (evedrop.folder / "out/table.csv").exists()
    assert (evedrop.folder / "table.tex").exists()


def test_a_table_that_is_not_written_does_not_hide_an_error(evedrop: Evedrop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error decides the status, and the other file is written."""
    (evedrop.folder / "bad.csv").touch()
    small = ("montecarlo", "eavesdroppers", "--trials", "2", "--slots", "9", "--set", "expect=[]")

    def fail(*_: object) -> None:
        (evedrop.folder / "bad.csv").unlink()
        (evedrop.folder / "bad.csv").mkdir()
        raise RunError("it failed")

    monkeypatch.setattr("evedrop.cli.report.report_page", fail)
    done = evedrop(*small, "--csv", "bad.csv", "--latex", "table.tex")
    assert done.status == 3
    assert "warning: bad.csv cannot be written (Is a directory)" in done.err
    assert "evedrop: it failed" in done.err
    assert (evedrop.folder / "table.tex").read_text(encoding="utf-8")


def test_a_row_that_begins_with_a_bracket_is_no_length() -> None:
    r"""LaTeX takes [ after \\ for a length, and * for a form, also on the next line: values of a sweep may be lists."""
    table = TextTable.headed(["process.Q"], ["mean error"])
    for value in ("[[1.0]]", "[[2.0]]", "*"):
        table.add(value, number_text(0.5))
    lines = latex_text(table).splitlines()
    assert len(lines) == 9
    for before, after in itertools.pairwise(lines):
        assert not (before.endswith(r"\\") and after.startswith(("[", "*")))

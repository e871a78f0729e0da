"""The papers: `evedrop paper` reproduces one, `evedrop figures` draws the founding paper's figures."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.command import command, flag, option, together
from evedrop.cli.options import as_json, tables
from evedrop.cli.parser import print_names
from evedrop.errors import UsageError
from evedrop.system.output import print_json

if TYPE_CHECKING:
    from evedrop.studies.papers.reproduction import Reproduction


_PAPERS = together(
    option("name", "NAME", "the paper; without it, a list of all papers", nargs="?"),
    flag("--quick", "simulate little: seconds, and larger standard errors"),
    option("--out", "FOLDER", "also write NAME.json and NAME.md there", type=Path),
)


@command((_PAPERS, as_json, tables), section="study", example="paper luecke2022", page="papers")
def paper(options: argparse.Namespace) -> int:
    """Compare the numbers of a published paper with ours.

    Lists the papers if none is named. Returns 1 if a number differs and nothing explains it.
    """
    from evedrop.studies.papers import paper as paper_of
    from evedrop.studies.papers import reproduce

    if options.name is None:
        _list(options.json)
        return 0
    paper_of(options.name)
    if options.out is not None:  # before the numbers are computed
        with _writable(options.out):
            options.out.mkdir(parents=True, exist_ok=True)
    reproduction = reproduce(options.name, options.quick, lambda text: print(text, file=sys.stderr))
    if options.out is not None:
        _write(reproduction, options.out)
    if options.json:
        print_json(reproduction.as_dict())
    else:
        _print(reproduction)
    return 1 if reproduction.differing else 0


def _list(as_json: bool) -> None:
    from evedrop.studies.papers import PAPERS

    papers = {
        name: {key: getattr(its, key) for key in ("title", "authors", "published")} for name, its in PAPERS.items()
    }
    if as_json:
        print_json(papers)
    else:
        print_names({name: "{authors}: {title}. {published}".format_map(its) for name, its in papers.items()})


def _write(reproduction: Reproduction, folder: Path) -> None:
    text = json.dumps(reproduction.as_dict(), indent=2, ensure_ascii=False)
    with _writable(folder):
        (folder / f"{reproduction.name}.json").write_text(f"{text}\n", encoding="utf-8")
        (folder / f"{reproduction.name}.md").write_text(reproduction.as_markdown(), encoding="utf-8")


@contextmanager
def _writable(folder: Path) -> Iterator[None]:
    """Raise UsageError where the folder cannot be written."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{folder} cannot be written ({error.strerror}); give another folder") from error


def _print(reproduction: Reproduction) -> None:
    """Print the table, and below it a line for each reason."""
    from evedrop.cli.report import terminal
    from evedrop.show.report.text_table import TextTable

    console = terminal()
    console.say(f"{reproduction.title} · {reproduction.authors} · {reproduction.published}")
    words, numbers = ["where", "what"], ["theirs", "ours", "tolerance"]
    table = TextTable.headed(words, numbers, ["verdict"], wrapped=[*words, *numbers])
    reasons: dict[str, int] = {}
    for row in reproduction.rows:
        note = f" [{reasons.setdefault(row.reason, len(reasons) + 1)}]" if row.reason else ""
        table.add(row.where, row.quantity, row.their_text, row.our_text, row.tolerance or "–", f"{row.verdict}{note}")
    console.show(table, tight=True)
    for reason, number in reasons.items():
        console.say(f"[{number}] {reason}")
    console.say(
        f"{', '.join(f'{verdict}: {count}' for verdict, count in reproduction.counts.items())}. {reproduction.scope}"
    )
    if reproduction.quick:
        console.say("these are quick estimates: without --quick the standard errors are smaller")


_FIGURES = together(
    option("folder", "DIR", nargs="?", type=Path, default=Path("figures")),
    flag("--full", "simulate the paper's 1000 trials of a day; takes minutes, not seconds"),
)


@command((_FIGURES,), section="study", example="figures paper/", page="papers")
def figures(options: argparse.Namespace) -> int:
    """Draw the figures of kennedy2022, and a table of its numbers and ours."""
    from evedrop.studies.papers.kennedy2022 import Size
    from evedrop.studies.papers.kennedy2022 import figures as draw

    size = Size(microgrid_trials=1000) if options.full else Size()
    with _writable(options.folder):
        print(draw(options.folder, lambda text: print(text, file=sys.stderr), size))
    return 0


COMMANDS = (paper, figures)

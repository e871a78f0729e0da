"""The papers: `evedrop paper` reproduces one, `evedrop figures` draws the founding paper's figures."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from evedrop.cli.options import Command, as_json
from evedrop.cli.parser import print_names
from evedrop.cli.tables import tables
from evedrop.errors import UsageError
from evedrop.system.output import print_json

if TYPE_CHECKING:
    from evedrop.studies.papers.reproduction import Reproduction


def paper(options: argparse.Namespace) -> int:
    """Compute the numbers of a paper; list the papers if none is named. 1 if a number differs and nothing explains it."""
    from evedrop.studies.papers import paper as paper_of
    from evedrop.studies.papers import reproduce

    if options.name is None:
        _list(options.json)
        return 0
    paper_of(options.name)
    if options.out is not None:
        _made(options.out)
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

    if as_json:
        papers = {
            name: {"title": paper_class.title, "authors": paper_class.authors, "published": paper_class.published}
            for name, paper_class in PAPERS.items()
        }
        print_json(papers)
        return
    print_names(
        {
            name: f"{paper_class.authors}: {paper_class.title}. {paper_class.published}"
            for name, paper_class in PAPERS.items()
        }
    )


def _made(folder: Path) -> None:
    """Create the folder, if necessary, before the numbers are computed."""
    with _writable(folder):
        folder.mkdir(parents=True, exist_ok=True)


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


def _papers(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", metavar="NAME", help="the paper; without it, a list of all papers")
    parser.add_argument("--quick", action="store_true", help="simulate little: seconds, and larger standard errors")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="also write NAME.json and NAME.md there")


def figures(options: argparse.Namespace) -> int:
    """Draw the paper's figures."""
    from evedrop.studies.papers.kennedy2022 import Size
    from evedrop.studies.papers.kennedy2022 import figures as draw

    try:
        report = draw(
            options.folder,
            lambda text: print(text, file=sys.stderr),
            Size(microgrid_trials=1000) if options.full else Size(),
        )
    except OSError as error:
        raise UsageError(f"{options.folder} cannot be written ({error.strerror}); give another folder") from error
    print(report)
    return 0


def _figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", type=Path, default=Path("figures"), metavar="DIR")
    parser.add_argument(
        "--full", action="store_true", help="simulate the paper's 1000 trials of a day; takes minutes, not seconds"
    )


COMMANDS = (
    Command(
        "paper",
        paper,
        "compare the numbers of a published paper with ours",
        (_papers, as_json, tables),
        section="study",
        example="paper luecke2022",
        page="papers",
    ),
    Command(
        "figures",
        figures,
        "draw the figures of the paper, and a table of its numbers and ours",
        (_figures,),
        section="study",
        example="figures paper/",
        page="papers",
    ),
)

"""`evedrop docs` and `evedrop completion`: the pages of the documentation, and completion for shells."""

from __future__ import annotations

import argparse
from importlib import resources
from pathlib import Path

from evedrop.cli.command import command, option
from evedrop.cli.parser import print_names
from evedrop.cli.plain_formulas import plain
from evedrop.errors import UsageError
from evedrop.system.hints import near

_SHELLS = ("bash", "zsh", "fish")


_PAGE = option("page", "PAGE", "the page, or a folder of pages, as evedrop docs lists it", nargs="?")


@command((_PAGE,), section="inspect", example="docs view")
def docs(options: argparse.Namespace) -> int:
    """Print a page of the documentation, or list the pages."""
    pages = _pages()
    if options.page is None:
        print_names({name: _title(path) for name, path in pages.items()})
        return 0
    name = str(options.page).removesuffix(".md")
    inside = {page: _title(path) for page, path in pages.items() if page.startswith(f"{name}/")}
    if name not in pages and inside:
        print_names(inside)
        return 0
    if name not in pages:
        raise UsageError(f"there is no page {name}{near(name, pages) or '; evedrop docs lists them'}")
    text = pages[name].read_text(encoding="utf-8")
    print(plain(text) if "$" in text else text, end="")
    return 0


_SHELL = option("shell", "SHELL", "bash, zsh or fish", choices=_SHELLS)


@command((_SHELL,), section="inspect", example="completion bash >> ~/.bashrc")
def completion(options: argparse.Namespace) -> int:
    """Print what makes a shell complete commands and options."""
    from argcomplete.shell_integration import shellcode

    print(shellcode(["evedrop"], shell=options.shell))
    return 0


def _pages() -> dict[str, Path]:
    """Name → file of each page, those of subfolders after the rest."""
    folder = Path(str(resources.files("evedrop"))) / "docs"
    pages = {str(path.relative_to(folder).with_suffix("")): path for path in folder.rglob("*.md")}
    return dict(sorted(pages.items(), key=lambda item: (item[0].count("/"), item[0])))


def _title(path: Path) -> str:
    first = path.read_text(encoding="utf-8").partition("\n")[0]
    return first.lstrip("# ")


COMMANDS = (docs, completion)

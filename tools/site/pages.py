"""Hooks of MkDocs: pages that the program makes, formulas as MathML, links that work in the repository and on the site."""

from __future__ import annotations

import html
import posixpath
import re
from collections.abc import Collection
from html.parser import HTMLParser
from pathlib import Path, PurePosixPath
from typing import Any

from commands import commands_page
from gallery import gallery_page, scenario_files, scenario_pages, scenarios_page
from keys import keys_page
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from python_page import python_page
from screens import screens_page

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
_OF_THE_ROOT = {
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
}
"""Pages outside docs/, and their names on the site."""
_FRONT = {"README.md": "index.md"}
"""Links to README lead to the front page of the site."""
_COPIED = ("site.css", "logo.svg")

_OF_THE_REPOSITORY = re.compile(r"\[([^\]\n]+)\]\(((?:tests/|CITATION\.cff)[^)#\n]*)\)")
"""A link to a file that the repository has and the site has not."""

_ENTRY = re.compile(r"(^```.*?^```|`[^`\n]*`)|\]\[", re.DOTALL | re.MULTILINE)
"""The middle of M[i][j], which would be read as a link, outside of code."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in docs/."""
    made = {there: (ROOT / name).read_text(encoding="utf-8") for name, there in _OF_THE_ROOT.items()}
    made |= {
        "index.md": (HERE / "front.md").read_text(encoding="utf-8"),
        "gallery.md": gallery_page(),
        "screens.md": screens_page(),
        "reference/scenario-keys.md": keys_page(),
        "reference/commands.md": commands_page(),
        "reference/scenarios.md": scenarios_page(),
        "reference/evedrop.md": python_page(),
        "reference/extend.md": "# The module `evedrop.extend`\n\n::: evedrop.extend\n",
    }
    made |= dict(scenario_pages())
    made |= {name: (HERE / name).read_text(encoding="utf-8") for name in _COPIED}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    for address, path in scenario_files():
        files.append(File.generated(config, address, content=path.read_bytes()))
    for drawing in [file for file in files if file.src_uri.endswith(".svg") and _BY_THE_SYSTEM in file.content_string]:
        text = drawing.content_string
        files.remove(drawing)
        for suffix, chosen in ((".svg", "@media all"), ("-light.svg", "@media not all")):
            address = drawing.src_uri.removesuffix(".svg") + suffix
            files.append(File.generated(config, address, content=text.replace(_BY_THE_SYSTEM, chosen)))
    return files


_BY_THE_SYSTEM = "@media (prefers-color-scheme: dark)"
"""How a drawing chooses its colours; on the site, a reader can choose another theme than the system's."""


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Make links between docs/ and the folder above it, as they are in the repository, lead to the site's."""
    up = "../" * page.file.src_uri.count("/")
    for name, there in (_OF_THE_ROOT | _FRONT).items():
        markdown = re.sub(rf"\]\((?:\.\./)*{re.escape(name)}(?=[)#])", f"]({up}{there}", markdown)
    if page.file.src_uri in _OF_THE_ROOT.values():
        markdown = re.sub(r"\]\(docs/", "](", markdown)
        markdown = _OF_THE_REPOSITORY.sub(_named, markdown)
    markdown = re.sub(r"^```golden .*$", "```text", markdown, flags=re.MULTILINE)
    return _ENTRY.sub(lambda match: match[1] or "]&#91;", markdown)


def _named(link: re.Match[str]) -> str:
    """The words of a link, with the path of the file that it leads to in the repository."""
    words, path = link[1], link[2]
    return words if path in words else f"{words} (`{path}`)"


def on_page_content(page_html: str, page: Page, files: Files, **_: Any) -> str:
    """Write formulas as MathML, which browsers show without a script; let pictures open large, and follow the theme."""
    page_html = re.sub(
        r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', _formula, page_html, flags=re.DOTALL
    )
    folder = PurePosixPath(page.file.dest_uri).parent
    there = {file.dest_uri for file in files}
    return _PICTURE.sub(lambda match: match[1] or _opening_large(match[2], match[3], folder, there), page_html)


_PICTURE = re.compile(r'(<a\b(?:(?!</a>).)*</a>)|(<img\b[^>]*?\bsrc="([^":]+)"[^>]*>)', re.DOTALL)
"""A link with all that is in it; or else a picture, and its address."""


def _opening_large(picture: str, address: str, folder: PurePosixPath, there: Collection[str]) -> str:
    """A picture that leads to itself; also that of the light theme, NAME-light.png, if there is one beside it."""
    light = re.sub(r"(\.\w+)$", r"-light\1", address)
    if posixpath.normpath(folder / light) not in there:
        return f'<a class="large" href="{address}">{picture}</a>'
    return "".join(
        f'<a class="large" href="{place}">{picture.replace(address, f"{place}#only-{theme}")}</a>'
        for place, theme in ((address, "dark"), (light, "light"))
    )


def _formula(match: re.Match[str]) -> str:
    display = "block" if match[2] == "[" else "inline"
    tex = (
        _UNSIZED.sub("", html.unescape(match[3]))
        .replace(r"\arg", r"\operatorname{arg}")
        .replace(r"\top", r"\mathsf{T}")
    )
    made = convert(tex, display=display)
    if unknown := re.search(r"\\[a-zA-Z]+", made):
        raise PluginError(f"{tex}: {unknown[0]} is not known to latex2mathml; write it in another way")
    return f'<{match[1]} class="formula">{made}</{match[1]}>'


_UNSIZED = re.compile(r"\\[bB]igg?[lr]?(?=\\[lr](?:floor|ceil))")
"""Sizes of delimiters that latex2mathml takes without a size only."""


def layers(source: str, *_: Any, **__: Any) -> str:
    """The drawing of the packages as rows of packages: the script that draws Mermaid's would come from another host."""
    rows = (re.findall(r"\[(\w+)\]", line) for line in source.splitlines() if "-->" not in line)
    return '<div class="layers">{}</div><p>The site shows the layers without the arrows.</p>'.format(
        "".join(
            "<p>{}</p>".format(" ".join(f"<code>{html.escape(name)}</code>" for name in row)) for row in rows if row
        )
    )


_LOADS = {"src", "href", "srcset", "data", "poster"}


class _Requests(HTMLParser):
    """Finds what a page loads from other hosts."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Everything but a link that a reader follows is loaded by itself."""
        given = {name: value or "" for name, value in attrs}
        if tag != "a" and given.get("rel") != "canonical":
            self.found += [
                value for name, value in given.items() if name in _LOADS and re.match(r"(https?:)?//", value)
            ]


def on_post_build(config: MkDocsConfig, **_: Any) -> None:
    """Fail if a page or a style sheet loads anything from another host."""
    site = Path(config.site_dir)
    for page in site.rglob("*.html"):
        requests = _Requests()
        requests.feed(page.read_text(encoding="utf-8"))
        if requests.found:
            raise PluginError(f"{page}: loads {', '.join(requests.found)}; pages may ask no other host for anything")
    for sheet in site.rglob("*.css"):
        if addresses := re.findall(
            r"(?:url\(|@import )[\"']?((?:https?:)?//[^)\"']+)", sheet.read_text(encoding="utf-8")
        ):
            raise PluginError(f"{sheet}: loads {', '.join(addresses)}; pages may ask no other host for anything")

"""The page of a report: one file without scripts, which asks no other host for anything.

It is readable in a light and a dark theme, on a narrow and a wide screen, on paper, with the keyboard, and by screen readers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version

from evedrop.show.report.markup import Node, element, written
from evedrop.show.view import palette
from evedrop.show.view.palette import hexadecimal


@dataclass(frozen=True)
class Part:
    """A section of the page."""

    title: str
    nodes: Sequence[Node]

    @property
    def anchor(self) -> str:
        """Its name in links."""
        return self.title.lower().replace(" ", "-")


@dataclass(frozen=True)
class Page:
    """The contents of a report."""

    title: str
    about: str
    """What was run, and how much of it, in a line."""
    outcome: str
    """The outcome in a sentence."""
    good: bool | None
    """Whether the outcome is good; None if there is nothing to judge."""
    parts: Sequence[Part]

    @property
    def html(self) -> str:
        """The page as an HTML document."""
        head = element(
            "head",
            element("meta", charset="utf-8"),
            element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("meta", name="color-scheme", content="light dark"),
            element("meta", name="generator", content=f"Evedrop {version('evedrop')}"),
            element("title", f"{self.title}: {self.outcome}"),
            element("style", _STYLE),
        )
        links = [element("li", element("a", part.title, href=f"#{part.anchor}")) for part in self.parts]
        mark = {True: "✓ ", False: "✕ ", None: ""}[self.good]
        kind = {True: "good", False: "bad", None: "open"}[self.good]
        body = element(
            "body",
            element("a", "Skip to the results", href="#results", class_="skip"),
            element(
                "header",
                element("h1", self.title),
                element("p", self.about, class_="about"),
                element("p", element("span", mark, aria_hidden="true"), self.outcome, class_=f"outcome {kind}"),
                element("nav", element("ul", *links), aria_label="Sections"),
            ),
            element("main", *map(_section, self.parts), id="results"),
            element("footer", element("p", f"Written by Evedrop {version('evedrop')}.")),
        )
        return written(element("html", head, body, lang="en"))


def _section(part: Part) -> Node:
    heading = element("h2", part.title, id=part.anchor)
    return element("section", heading, *part.nodes, aria_labelledby=part.anchor)


_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
_GOOD, _BAD = hexadecimal(palette.BLUE), hexadecimal(palette.RED)
_STYLE = f"""
:root {{ --ground: #fff; --ink: #16191d; --dim: #5a6068; --line: #d5d9de; --shade: #f4f5f7; --link: {_GOOD};
  --good: {_GOOD}; --bad: {_BAD}; }}
@media (prefers-color-scheme: dark) {{ :root {{ --ground: {hexadecimal(palette.GROUND)}; --ink: {hexadecimal(palette.TRUTH)};
  --dim: #a3a9b2; --line: #3a3f47; --shade: #1b1f25; --link: #8dbbfb; --good: #8dbbfb; --bad: #ff8f84; }} }}
@media print {{ :root {{ --ground: #fff; --ink: #000; --dim: #444; --line: #bbb; --shade: #fff; --link: #000;
  --good: {_GOOD}; --bad: {_BAD}; }} nav, .skip {{ display: none; }} section, figure, tr {{ break-inside: avoid; }}
  .scroll {{ overflow: visible !important; }} body {{ font-size: 10pt; }} }}
* {{ box-sizing: border-box; }}
html {{ -webkit-text-size-adjust: 100%; }}
body {{ margin: 0 auto; padding: 1rem; max-width: 76rem; background: var(--ground); color: var(--ink);
  font: 1rem/1.5 system-ui, "Segoe UI", "Liberation Sans", sans-serif; overflow-wrap: anywhere; print-color-adjust: exact; }}
h1 {{ font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0; }}
h2 {{ font-size: 1.2rem; margin: 2rem 0 0.5rem; padding-top: 0.5rem; border-top: 1px solid var(--line); }}
h3 {{ font-size: 1rem; margin: 1.2rem 0 0.3rem; }}
a {{ color: var(--link); }}
:focus-visible {{ outline: 3px solid var(--link); outline-offset: 2px; }}
.skip {{ position: absolute; left: -99rem; }}
.skip:focus {{ left: 1rem; background: var(--ground); padding: 0.5rem; }}
.about, .axis, figcaption, footer {{ color: var(--dim); }}
.outcome {{ font-size: 1.15rem; font-weight: 600; margin: 0.5rem 0; padding: 0.5rem 0.8rem; background: var(--shade);
  border-left: 0.4rem solid var(--dim); }}
.good {{ border-color: var(--good); }} .bad {{ border-color: var(--bad); }}
nav ul {{ display: flex; flex-wrap: wrap; gap: 0.2rem 1.2rem; padding: 0; list-style: none; }}
ul {{ padding-left: 1.2rem; }} li {{ margin: 0.2rem 0; }}
.scroll {{ overflow-x: auto; margin: 0.2rem 0 0.8rem; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.92rem; }}
.caption {{ color: var(--dim); font-size: 0.92rem; margin: 0.8rem 0 0; }}
.marked {{ list-style: none; padding: 0; }} .marked .mark {{ display: inline-block; width: 1.4rem; font-weight: 700; }}
th, td {{ padding: 0.25rem 0.7rem; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line);
  overflow-wrap: normal; }}
th:first-child {{ padding-left: 0; }}
th, td {{ white-space: nowrap; }}
tbody th {{ font-weight: 500; }}
.number {{ text-align: right; }}
pre {{ background: var(--shade); padding: 0.6rem; overflow-x: auto; white-space: pre-wrap; font-size: 0.9rem; margin: 0.5rem 0; }}
code {{ font-family: ui-monospace, "Liberation Mono", monospace; font-size: 0.92em; }}
summary {{ cursor: pointer; color: var(--link); }}
.chart {{ margin: 1rem 0; }}
.plot {{ position: relative; height: 19rem; margin: 0.3rem 0.6rem 1.7rem 4rem;
  border: solid var(--line); border-width: 0 0 1px 1px; }}
.plot svg {{ position: absolute; inset: 0; width: 100%; height: 100%; }}
.plot path {{ fill: none; vector-effect: non-scaling-stroke; stroke-linejoin: round; }}
.plot .grid {{ stroke: var(--line); stroke-width: 1; }}
.plot .curve {{ stroke-width: 2; }}
.plot .theory {{ stroke: var(--ink); stroke-width: 1.3; stroke-dasharray: 1 5; stroke-linecap: round; }}
.plot .bar {{ stroke-width: 2; }}
.plot .mark {{ stroke-width: 9; stroke-linecap: round; }}
.plot path.band {{ opacity: 0.25; stroke: none; }}
.plot span {{ position: absolute; font-size: 0.8rem; color: var(--dim); line-height: 1; white-space: nowrap; }}
.plot .y {{ right: 100%; padding-right: 0.4rem; transform: translateY(-50%); }}
.plot .x {{ top: 100%; padding-top: 0.4rem; transform: translateX(-50%); }}
.axis {{ font-size: 0.85rem; }} .below {{ text-align: center; }}
.key {{ display: inline-block; margin-right: 1.2rem; }}
.swatch {{ display: inline-block; width: 1.1rem; height: 0.7rem; margin-right: 0.4rem; border: 1px solid var(--line); }}
.strip {{ display: block; width: 100%; height: 1.1rem; image-rendering: pixelated; margin: 0.15rem 0;
  border: 1px solid var(--line); }}
.verdict {{ text-align: center; }} .verdict b {{ display: block; }}
"""

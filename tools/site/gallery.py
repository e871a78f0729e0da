"""The gallery: a card for each built-in scenario, a page for each, and the list of them in the reference.

Cards are filtered by style sheets alone: each has classes, and radio buttons hide those without the chosen entry.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from gallery_pictures import Kept, kept

from evedrop import Scenario
from evedrop.scenarios import built_in_text, shipped

_LEARNED = re.compile(r"\A# What you learn: (?P<words>(?:.+\n)(?:# .+\n)*)")
_HEAD = """---
hide: [navigation, toc]
---

# Gallery

Each card shows a built-in scenario: above, the truth (ring) and where each receiver believes it to be; below, how far off each of
them is. A card leads to pictures, the verdict and a recording for Rerun's viewer, which is not embedded: it is tens of megabytes.
"""
_WIRE = """<a class="card wire" href="wire/tutorial.html"><img alt="" loading="lazy" src="wire_view.png">
<span class="card-title">A wire between programs</span>
<span class="card-learned">What bursts, delay and a partition do to messages between two unchanged programs.</span>
<span class="card-tags">wire</span></a>
"""
_FILTERS = {
    "all": "all",
    "attack": "attacks",
    "links": "bursts, delay, distance",
    "faults": "faults",
    "closed-loop": "closed loop",
    "wire": "wire",
}
_LOSSES_AS_USUAL = "bernoulli"


@dataclass(frozen=True)
class Entry:
    """A built-in scenario in the gallery."""

    name: str
    title: str
    learned: str
    """What one learns from it, a sentence or two."""
    scheme: str
    kinds: tuple[str, ...]
    """Those of `_FILTERS` that it belongs to."""


@cache
def entries() -> tuple[Entry, ...]:
    """All of them, by name."""
    made = []
    for name in sorted(shipped()):
        scenario = Scenario.load(name)
        made.append(Entry(name, scenario.title, learned(name), scenario.encoding.scheme, tuple(_kinds(scenario))))
    return tuple(made)


def learned(name: str) -> str:
    """What one learns from a built-in scenario, as the first lines of its file say it."""
    match = _LEARNED.match(built_in_text(name))
    if match is None:
        raise ValueError(f"{name}.toml does not begin with `# What you learn: …`")
    return " ".join(match["words"].replace("\n# ", " ").split())


def _kinds(scenario: Scenario) -> Iterator[str]:
    acknowledgements = scenario.acknowledgements
    attacked = acknowledgements is not None and acknowledgements.attack != "none"
    if attacked or any(event.kind in {"jam", "spoof"} for event in scenario.event):
        yield "attack"
    if scenario.controller is not None:
        yield "closed-loop"
    if scenario.nemesis is not None or any(event.kind not in {"jam", "spoof", "note"} for event in scenario.event):
        yield "faults"
    links = scenario.links.values()
    if any(link.delay or link.correlation or link.loss_spec["model"] != _LOSSES_AS_USUAL for link in links):
        yield "links"


def gallery_page() -> str:
    """The page of cards in Markdown."""
    schemes = sorted({entry.scheme for entry in entries()})
    parts = [_HEAD, '<div class="gallery">', *_choice("kind", _FILTERS)]
    parts += _choice("scheme", {"all": "all", **{scheme: scheme for scheme in schemes}})
    parts += [
        '<div class="cards">',
        *map(_card, sorted(entries(), key=_place)),
        _WIRE,
        "</div>",
        "</div>\n",
        f"<style>{_rules(schemes)}</style>",
    ]
    return "\n".join(parts)


def _place(entry: Entry) -> tuple[int, bool, str]:
    """The order of cards: secrecy as such, beginning with the demo, then by kind in the order of the filters."""
    return (list(_FILTERS).index((*entry.kinds, "all")[0]), entry.name != "vehicle", entry.name)


def _choice(group: str, choices: dict[str, str]) -> Iterator[str]:
    yield f'<fieldset class="filters"><legend>{group}</legend>'
    for value, words in choices.items():
        checked = " checked" if value == "all" else ""
        yield f'<label><input type="radio" name="{group}" id="{group}-{value}"{checked}>{words}</label>'
    yield "</fieldset>"


def _rules(schemes: list[str]) -> str:
    """Hide the cards that are not of the chosen kind, or not of the chosen scheme."""
    classes = [("kind", kind, kind) for kind in _FILTERS if kind != "all"]
    classes += [("scheme", scheme, f"scheme-{scheme}") for scheme in schemes]
    return "".join(
        f".gallery:has(#{group}-{value}:checked) .card:not(.{name}){{display:none}}" for group, value, name in classes
    )


def _card(entry: Entry) -> str:
    pictures = "".join(_moving(entry.name, theme) for theme in ("dark", "light"))
    tags = " · ".join([entry.scheme, *(_FILTERS[kind] for kind in entry.kinds)])
    return (
        f'<a class="card {" ".join(entry.kinds)} scheme-{entry.scheme}" href="gallery/{entry.name}.html">{pictures}\n'
        f'<span class="card-title">{html.escape(entry.title)}</span>\n'
        f'<span class="card-learned">{_spoken(entry.learned)}</span>\n<span class="card-tags">{tags}</span></a>'
    )


def _moving(name: str, theme: str) -> str:
    """The picture of a card in a theme; one that does not move for readers who want less motion."""
    ending = f"{'' if theme == 'dark' else '-light'}.svg#only-{theme}"
    still = f'<source media="(prefers-reduced-motion: reduce)" srcset="gallery/{name}-still{ending}">'
    picture = f'<img alt="" loading="lazy" width="320" height="180" src="gallery/{name}{ending}">'
    return f"<picture>{still}{picture}</picture>"


def _spoken(text: str) -> str:
    """A sentence in HTML, with code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


def scenario_pages() -> Iterator[tuple[str, str]]:
    """The path of each scenario's page, and the page in Markdown."""
    for entry in entries():
        yield f"gallery/{entry.name}.md", _page(entry, kept(entry.name))


def _page(entry: Entry, made: Kept) -> str:
    trials = "1 trial" if made.trials == 1 else f"{made.trials} trials"
    verdict = f"> {made.verdict}" if made.verdict else "> No eavesdropper listens: there is no verdict on secrecy."
    size = (made.folder / "recording.rrd").stat().st_size / 1e6
    return f"""---
hide: [navigation, toc]
---

[Gallery](../gallery.md)

# {entry.title}

**{entry.learned}**

{verdict}

{made.slots:,} slots, {trials}, in memory. Live, with the view:

```text
evedrop run {entry.name}
```

![Pictures of a run of {entry.name}]({entry.name}-run.png)

[Recording of the view]({entry.name}.rrd) ({size:.1f} MB). Open it with Rerun's viewer, which is installed with Evedrop:

```text
rerun {entry.name}.rrd
```

## The scenario

`evedrop show {entry.name}` prints it, and `evedrop new mine.toml --from {entry.name}` copies it.
[Scenario keys](../reference/scenario-keys.md) describes each key.

```toml
{built_in_text(entry.name).rstrip()}
```
"""


def scenario_files() -> Iterator[tuple[str, Path]]:
    """The address of each picture and recording on the site, and its file."""
    for entry in entries():
        folder = kept(entry.name).folder
        for theme in ("", "-light"):
            yield f"gallery/{entry.name}{theme}.svg", folder / f"card{theme}.svg"
            yield f"gallery/{entry.name}-still{theme}.svg", folder / f"card-still{theme}.svg"
            yield f"gallery/{entry.name}-run{theme}.png", folder / f"run{theme}.png"
        yield f"gallery/{entry.name}.rrd", folder / "recording.rrd"


def scenarios_page() -> str:
    """The list of built-in scenarios for the reference, in Markdown."""
    rows = [
        f"| [`{entry.name}`](../gallery/{entry.name}.md) | {entry.title} | {entry.learned} | `{entry.scheme}` |"
        for entry in entries()
    ]
    return "\n".join([
        "# Built-in scenarios",
        "",
        "`evedrop list` prints their names, `evedrop show NAME` a scenario with comments that say what to look for, and",
        "`evedrop run NAME` runs entry. The [gallery](../gallery.md) shows them.",
        "",
        "| name | title | what you learn | scheme |",
        "|---|---|---|---|",
        *rows,
        "",
    ])  # fmt: skip

"""The gallery: every built-in scenario with its description, its command and a picture of its results.

The pictures are made in memory, some hundreds of thousand trial-slots each, and kept in build/gallery for as long as neither the
scenario nor the program changes.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from picture_folder import PICTURES, program_digest

from evedrop import Scenario, montecarlo
from evedrop.scenarios import built_in_text, shipped

_TRIAL_SLOTS = 200_000
_MOST_TRIALS = 200
_MOST_SLOTS = 5_000  # of the day in a house
_LEAST_DESCRIPTION = 60
_THIS = Path(__file__).read_bytes()
_HEAD = """# Gallery

Every built-in scenario, with errors, packets and estimates of a study in memory of at most 5000 slots.
`evedrop show NAME` prints a scenario, with comments that say what to look for; `evedrop run NAME` runs it live.
[Results](results.md) and [the view](view.md) explain the metrics and colours.
"""


def gallery_page() -> str:
    """The page in Markdown."""
    parts = [_HEAD]
    for name in sorted(shipped()):
        title = Scenario.load(name).title
        parts += [f"## {name}\n", f"**{title}.** {description(name)}\n", f"```text\nevedrop run {name}\n```\n"]
        parts += [f"![Errors, packets and estimates of {name}](gallery/{name}.png)\n"]
    return "\n".join(parts)


def description(name: str) -> str:
    """The first sentence of a scenario's comment, and the next ones if it is very short."""
    comment = re.search(r"^#(?:.+\n#)*.+\n", built_in_text(name), re.MULTILINE)
    if comment is None:
        return ""
    sentences = re.split(r"(?<=[.!?]) (?=[A-Z`])", " ".join(re.sub("^# ?", "", comment[0], flags=re.MULTILINE).split()))
    text = sentences.pop(0)
    while len(text) < _LEAST_DESCRIPTION and sentences:
        text += f" {sentences.pop(0)}"
    return text


def pictures() -> dict[str, bytes]:
    """The picture of each scenario, as PNG."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    return {name: _picture(name) for name in sorted(shipped())}


def _picture(name: str) -> bytes:
    kept = PICTURES / f"{hashlib.sha256(program_digest() + _THIS + built_in_text(name).encode()).hexdigest()[:16]}.png"
    if not kept.exists():
        slots = min(Scenario.load(name).slots, _MOST_SLOTS)
        results = montecarlo(name, trials=min(_MOST_TRIALS, _TRIAL_SLOTS // slots), slots=slots)
        new = kept.with_suffix(".new")
        results.plot().savefig(new, format="png", dpi=80)
        new.replace(kept)
    return kept.read_bytes()

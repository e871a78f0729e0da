import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_cited_section_exists() -> None:
    """Wherever code cites a section of docs/mathematics.md, the document has a heading of that name."""
    text = (ROOT / "docs" / "mathematics.md").read_text(encoding="utf-8")
    headings = {heading.lower() for heading in re.findall(r"^## (.+)$", text, re.MULTILINE)}
    cited = 0
    for path in sorted((ROOT / "emulator").rglob("*.py")):
        for section in re.findall(r"docs/mathematics\.md, ([A-Za-z][\w ]*\w)", path.read_text(encoding="utf-8")):
            name = section.lower()
            assert any(name == h or name.startswith(h) for h in headings), f"{path.name} cites “{section}”"
            cited += 1
    assert cited > 20

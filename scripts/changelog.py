"""Move the fragments of changelog.d/ below "## Unreleased" of CHANGELOG.md, and remove them."""

from __future__ import annotations

import sys
from pathlib import Path

HEADING = "## Unreleased\n"


def collect(root: Path) -> int:
    """How many fragments were moved.

    Raises:
        ValueError: a fragment is no list, or CHANGELOG.md has no heading; nothing is changed.
    """
    fragments = sorted(p for p in (root / "changelog.d").glob("*.md") if p.name != "README.md")
    texts = [path.read_text(encoding="utf-8").strip() for path in fragments]
    for path, text in zip(fragments, texts, strict=True):
        if any(not line.startswith(("- ", "  ")) for line in text.splitlines()) or not text:
            raise ValueError(f"{path}: expected bullets, lines that start with '- ' or two spaces")
    log = root / "CHANGELOG.md"
    before, heading, after = log.read_text(encoding="utf-8").partition(HEADING)
    if not heading:
        raise ValueError(f"{log} has no line {HEADING.strip()!r}")
    if texts:
        scratch = log.with_suffix(".new")
        added = "\n".join(texts)
        scratch.write_text(f"{before}{heading}\n{added}\n{after.lstrip()}", encoding="utf-8")
        scratch.replace(log)
    for path in fragments:
        path.unlink()
    return len(fragments)


if __name__ == "__main__":
    try:
        print(f"{collect(Path(__file__).parents[1])} fragments moved")
    except ValueError as error:
        sys.exit(f"error: {error}")

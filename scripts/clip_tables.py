"""The tables of docs/reference/clip.md, made from the constants that the checker obeys.

    python scripts/clip_tables.py

A test compares the page with the code.
"""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import BaseModel

from hoigs.core.clip_folder.format import FILES, ArraySpec, ClipHeader, ViewsHeader

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "clip.md"


def tables() -> dict[str, str]:
    """Markdown by marker name."""
    return {
        "header": _keys(ClipHeader),
        "files": _files(),
        "arrays": _arrays(),
        "views": _keys(ViewsHeader),
    }


def with_tables(text: str) -> str:
    """`text` with everything between `<!-- name -->` and `<!-- /name -->` made anew.

    Raises:
        ValueError: a marker is absent.
    """
    for name, table in tables().items():
        parts = re.split(f"(?<=<!-- {name} -->).*?(?=<!-- /{name} -->)", text, flags=re.DOTALL)
        if len(parts) != 2:
            raise ValueError(f"expected one pair of markers {name}, found {len(parts) - 1}")
        text = f"{parts[0]}\n{table}\n{parts[1]}"
    return text


def _keys(model: type[BaseModel]) -> str:
    rows = ["| key | | meaning |", "|---|---|---|"]
    for name, field in model.model_fields.items():
        need = "required" if field.is_required() or name in ("format", "version") else "optional"
        rows.append(f"| `{name}` | {need} | {field.description} |")
    return "\n".join(rows)


def _files() -> str:
    rows = ["| file | needed | what | when it is absent |", "|---|---|---|---|"]
    rows += [f"| `{s.pattern}` | {s.when} | {s.meaning} | {s.maker} |" for s in FILES]
    return "\n".join(rows)


def _arrays() -> str:
    rows = ["| file | array | shape | type | meaning |", "|---|---|---|---|---|"]
    for spec in FILES:
        for array in spec.arrays:
            need = " (optional)" if array.optional else ""
            cells = (f"`{spec.pattern}`", f"`{array.name}`{need}", _shape(array), array.kind)
            rows.append(f"| {' | '.join(cells)} | {array.meaning.replace('|', '∣')} |")
    return "\n".join(rows)


def _shape(array: ArraySpec) -> str:
    return f"[{', '.join(map(str, array.shape))}]" if array.shape else "scalar"


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")

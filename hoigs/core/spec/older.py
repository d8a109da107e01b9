"""Names that specs of version 0.1 used, read as the present ones.

A run folder keeps the spec that it was trained with, so what `hoigs train` wrote before a rename
must still open.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hoigs.core.spec.loader import Document, Place

OLD, NEW = "prior", "initializer"  # of an entity's block, and the kind of its component


def with_present_names(document: Document) -> Document:
    """`document` with the keys that specs have today; positions in the file are kept."""
    model = document.data.get("model")
    blocks = model.items() if isinstance(model, dict) else ()
    old = {name for name, block in blocks if isinstance(block, dict) and OLD in block}
    if not old:
        return document

    def place(at: Place) -> Place:
        renamed = len(at) > 2 and at[0] == "model" and at[1] in old and at[2] == OLD
        return (*at[:2], NEW, *at[3:]) if renamed else at

    return replace(
        document,
        data=document.data | {"model": {name: _block(block) for name, block in blocks}},
        keys={place(at): where for at, where in document.keys.items()},
        values={place(at): where for at, where in document.values.items()},
    )


def _block(block: Any) -> Any:
    if not isinstance(block, dict) or OLD not in block:
        return block
    part = block[OLD]
    if isinstance(part, dict) and isinstance(part.get("use"), str):
        kind, _, name = part["use"].partition(":")
        part = part | {"use": f"{NEW if kind == OLD else kind}:{name}"}
    return {NEW if key == OLD else key: part if key == OLD else v for key, v in block.items()}

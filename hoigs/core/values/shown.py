"""How values show themselves: one line in a terminal, a table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any

from torch import Tensor

SHOWN = 4  # entries of a list or mapping that are written out


def one_line(value: Any) -> str:
    """`repr` of a dataclass with the type and shape of tensors in place of their numbers."""
    parts = (f"{f.name}={_brief(getattr(value, f.name))}" for f in fields(value) if f.repr)
    return f"{type(value).__name__}({', '.join(parts)})"


def _brief(value: Any) -> str:
    if isinstance(value, Tensor):
        if value.numel() == 1:
            return f"{value.detach().item():g}" if value.is_floating_point() else str(value.item())
        place = "" if value.device.type == "cpu" else f" on {value.device}"
        kind = str(value.dtype).removeprefix("torch.")
        return f"{kind}{list(value.shape)}{place}"
    if isinstance(value, Mapping):
        shown = [f"{k!r}: {_brief(v)}" for k, v in list(value.items())[:SHOWN]]
        return "{" + ", ".join(shown + ["..."] * (len(value) > SHOWN)) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) > SHOWN:
        return f"<{len(value)} entries>"
    shown_as_class = isinstance(value, type) or not is_dataclass(value)
    return repr(value) if shown_as_class else one_line(value)


def html_table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    notes: Sequence[str] = (),
) -> str:
    """A table for `_repr_html_` with notes below it, all text escaped."""
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows
    )
    return (
        f"<table><caption><b>{escape(title)}</b></caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        + "".join(f"<p>{escape(note)}</p>" for note in notes)
    )

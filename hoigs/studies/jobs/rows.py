"""Rows of methods that a study trains, and tables of them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One method, or one variant of one.

    Attributes:
        label: for reports. spec: name or file, perhaps @PROFILE; None if there is nothing to run.
        settings: "a.b=value", overrides of the spec.
        clip_settings: settings added to the name of a built-in clip; other clips lack this row.
        paper: the corresponding rows of paper.yaml, "TABLE/ROW".
        why: with spec None, why there is nothing to run.
    """

    label: str
    spec: str | None
    settings: tuple[str, ...] = ()
    clip_settings: str = ""
    paper: tuple[str, ...] = ()
    why: str = ""


@dataclass(frozen=True)
class TableSet:
    """A table: its rows, in order."""

    name: str
    title: str
    rows: tuple[Row, ...]

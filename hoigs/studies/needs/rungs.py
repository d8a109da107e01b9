"""Ladders of rungs, cheapest first: which changes to a spec are tried, read from YAML."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.spec_loader import load_yaml

BUILTIN = Path(__file__).with_name("ladders.yaml")

Kind = Literal["scene", "human", "object", "pair"]
Region = Literal["own", "background", "contact"]
Overrides = dict[str, Any]  # dotted key of a spec to its value


class Rung(ComponentConfig):
    """One step of a ladder: what it changes in the spec.

    Attributes:
        name: for tables. why: what a scene has that needs this rung, "because …".
        overrides: dotted keys of a spec and their values. `{scene}`, `{human}` and `{object}` stand
            for the model blocks of that kind.
        times: dotted keys of numbers, and what their value so far is multiplied with: a rung that
            is smaller than the spec, whatever the spec has. Keys that the spec has not are left.
        afterwards: laid over the answer where this rung is chosen, and over no trial: what takes a
            longer training than a trial to be worth it.
        cost: of one step of a trial, where a step of the full spec costs 1
            (`benchmarks/rung_costs.py` measures it).
    """

    name: str
    overrides: Overrides = Field(default_factory=dict)
    times: dict[str, float] = Field(default_factory=dict)
    afterwards: Overrides = Field(default_factory=dict)
    cost: float = Field(1.0, gt=0)
    why: str


class Ladder(ComponentConfig):
    """Rungs for one part of a spec.

    Attributes:
        name: for tables, and for `unless` of later ladders.
        kind: trials model entities of this kind alone, each block of it in turn; a "pair" humans
            and objects.
        region: where trials are scored. "own": visible pixels of the entity; "background": of no
            entity; "contact": of objects, and of humans within a twentieth of the image of them.
        rungs: cheapest first.
        share: of the search's budget, against the other ladders.
        least: dB within which a cheaper rung is taken; None goes by the search's settings.
        price: dB that a rung must bring for every doubling of the trial's trained numbers.
        during: laid under each rung while it is tried, and no longer.
        unless: ladder to rungs; a ladder is left out where one of these has been chosen.
        else_cheapest: a ladder that is left out takes its first rung, else it changes nothing.
    """

    name: str
    kind: Kind
    region: Region = "own"
    rungs: tuple[Rung, ...] = Field(min_length=2)
    share: float = Field(1.0, gt=0)
    least: float | None = Field(None, ge=0)
    price: float = Field(0.0, ge=0)
    during: Overrides = Field(default_factory=dict)
    unless: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    else_cheapest: bool = False


class _File(ComponentConfig):
    ladders: tuple[Ladder, ...]


def load_ladders(path: Path | None = None) -> tuple[Ladder, ...]:
    """The ladders of a file, or those that come with hoigs.

    Raises:
        HoigsError: the file is absent or no ladders; what is wrong, a line each.
    """
    path = path or BUILTIN
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise HoigsError(f"{path}: no ladders to read: {error.strerror}") from error
    try:
        found = _File.model_validate(load_yaml(text, str(path)).data).ladders
    except ValidationError as error:
        lines = [f"{path} {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise HoigsError("\n".join(lines)) from error
    _check(found, path)
    return found


def _check(ladders: Sequence[Ladder], path: Path) -> None:
    before: dict[str, list[str]] = {}
    for ladder in ladders:
        names = [rung.name for rung in ladder.rungs]
        if len(set(names)) < len(names) or ladder.name in before:
            raise HoigsError(
                f"{path} {ladder.name}: ladders and their rungs need names of their own"
            )
        for other, rungs in ladder.unless.items():
            if other not in before:
                near = did_you_mean(other, before)
                raise HoigsError(f"{path} {ladder.name}.unless: no ladder {other!r} above it{near}")
            for name in rungs:
                if name not in before[other]:
                    near = did_you_mean(name, before[other])
                    raise HoigsError(
                        f"{path} {ladder.name}.unless: {other} has no rung {name!r}{near}"
                    )
        before[ladder.name] = names


def expanded(overrides: Mapping[str, Any], blocks: Mapping[str, Sequence[str]]) -> Overrides:
    """Overrides with `{kind}` in their keys replaced by each block of that kind.

    Keys of a kind that has no block go.
    """
    found: Overrides = {}
    for key, value in overrides.items():
        keys = [key]
        for kind, names in blocks.items():
            mark = "{" + kind + "}"
            keys = [k.replace(mark, name) for k in keys for name in (names if mark in k else [""])]
        found |= dict.fromkeys(keys, value)
    return found


def multiplied(times: Mapping[str, float], tree: Mapping[str, Any]) -> Overrides:
    """`Rung.times`, its blocks expanded, as overrides of a spec.

    Args:
        tree: the spec so far, as `Spec.model_dump` gives it.

    Raises:
        HoigsError: what stands at a key is no number.
    """
    found: Overrides = {}
    for key, factor in times.items():
        value: Any = tree
        for step in key.split("."):
            value = value.get(step) if isinstance(value, Mapping) else None
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise HoigsError(f"{key}: {value!r} cannot be taken {factor:g} times; it is no number")
        found[key] = max(1, round(value * factor)) if isinstance(value, int) else value * factor
    return found


def laid(below: Mapping[str, Any], over: Mapping[str, Any]) -> Overrides:
    """Two sets of overrides as one: a key replaces what stood at it and below it, and reaches into
    a block above it.

    Raises:
        HoigsError: a key below one that has been set to null.
    """
    result = dict(below)
    for key, value in over.items():
        result = {k: v for k, v in result.items() if not k.startswith(f"{key}.")}
        holder = next((k for k in result if key.startswith(f"{k}.")), None)
        if holder is None:
            result[key] = value
            continue
        block = result[holder]
        if not isinstance(block, dict):
            raise HoigsError(f"{key}: {holder} has been set to {block!r}, which has no settings")
        result[holder] = _within(block, key.removeprefix(f"{holder}.").split("."), value)
    return result


def _within(block: dict[str, Any], place: Sequence[str], value: Any) -> dict[str, Any]:
    first, *rest = place
    inner = _within(dict(block.get(first) or {}), rest, value) if rest else value
    return {**block, first: inner}


def as_settings(overrides: Mapping[str, Any]) -> list[str]:
    """Overrides as `Spec.load` takes them: "a.b=value"."""
    return [f"{key}={json.dumps(value)}" for key, value in overrides.items()]

"""Search spaces: which changes to a spec are tried, as candidates from the cheapest; from YAML."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.files.regular_file import regular_file
from hoigs.core.spec.loader import load_yaml

BUILTIN = Path(__file__).with_name("search_spaces.yaml")

Kind = Literal["scene", "human", "object", "pair"]
Region = Literal["own", "background", "contact"]
Overrides = dict[str, Any]  # dotted key of a spec to its value


class Candidate(ComponentConfig):
    """One model to try: what it changes in the spec."""

    name: str
    """For tables."""
    overrides: Overrides = Field(default_factory=dict)
    """Dotted keys of a spec and their values. `{scene}`, `{human}` and `{object}` stand for the
    model blocks of that kind."""
    times: dict[str, float] = Field(default_factory=dict)
    """Dotted keys of numbers, and the factor that their present value is multiplied by. Keys that
    the spec does not have are ignored."""
    afterwards: Overrides = Field(default_factory=dict)
    """Overrides of the answer if this candidate is chosen, but of no trial: settings that need a
    longer training."""
    cost: float = Field(default=1.0, gt=0)
    """Of one step of a trial, where a step of the full spec costs 1
    (`benchmarks/candidate_costs.py` measures it)."""
    why: str
    """What a scene has that needs this candidate, "because …"."""


class SearchSpace(ComponentConfig):
    """Candidates for one part of a spec."""

    name: str
    """For tables, and for `unless` of later search spaces."""
    kind: Kind
    """Trials model entities of this kind alone, each block of it in turn; a "pair" humans and
    objects."""
    region: Region = "own"
    """Where trials are scored. "own": visible pixels of the entity; "background": of no entity;
    "contact": of objects, and of humans within a twentieth of the image of them."""
    candidates: tuple[Candidate, ...] = Field(min_length=2)
    """Cheapest first."""
    share: float = Field(default=1.0, gt=0)
    """Of the search's budget, relative to the other search spaces."""
    least: float | None = Field(default=None, ge=0)
    """dB within which a cheaper candidate is taken; None takes `Settings.least`."""
    min_gain: float = Field(default=0.0, ge=0)
    """dB that a candidate must gain for every doubling of the trial's parameters."""
    during: Overrides = Field(default_factory=dict)
    """Overrides of every trial, below those of its candidate."""
    unless: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    """Search space to candidates; this space is skipped where one of these was chosen."""
    else_cheapest: bool = False
    """A skipped space takes its first candidate; otherwise it changes nothing."""


class _File(ComponentConfig):
    search_spaces: tuple[SearchSpace, ...]


def load_search_spaces(path: Path | None = None) -> tuple[SearchSpace, ...]:
    """The search spaces of a file, by default those that come with hoigs.

    Raises:
        HoigsError: the file cannot be read or is invalid; each error on a line.
    """
    path = path or BUILTIN
    try:
        text = regular_file(path).read_text(encoding="utf-8")
    except OSError as error:
        raise HoigsError(
            f"{path}: the file of search spaces cannot be read: {error.strerror}"
        ) from error
    try:
        found = _File.model_validate(load_yaml(text, str(path)).data).search_spaces
    except ValidationError as error:
        lines = [f"{path} {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise HoigsError("\n".join(lines)) from error
    _check(found, path)
    return found


def _check(search_spaces: Sequence[SearchSpace], path: Path) -> None:
    before: dict[str, list[str]] = {}
    for space in search_spaces:
        names = [candidate.name for candidate in space.candidates]
        if len(set(names)) < len(names) or space.name in before:
            raise HoigsError(
                f"{path} {space.name}: search spaces and their candidates need unique names"
            )
        for other, candidates in space.unless.items():
            if other not in before:
                near = did_you_mean(other, before)
                raise HoigsError(
                    f"{path} {space.name}.unless: no search space {other!r} above it{near}"
                )
            for name in candidates:
                if name not in before[other]:
                    near = did_you_mean(name, before[other])
                    raise HoigsError(
                        f"{path} {space.name}.unless: {other} has no candidate {name!r}{near}"
                    )
        before[space.name] = names


def expanded(overrides: Mapping[str, Any], blocks: Mapping[str, Sequence[str]]) -> Overrides:
    """Overrides with `{kind}` in their keys replaced by each block of that kind.

    Keys of a kind without a block are dropped.
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
    """`Candidate.times`, its blocks expanded, as overrides of a spec.

    Args:
        tree: the spec so far, as `Spec.model_dump` gives it.

    Raises:
        HoigsError: the value at a key is not a number.
    """
    found: Overrides = {}
    for key, factor in times.items():
        value: Any = tree
        for step in key.split("."):
            value = value.get(step) if isinstance(value, Mapping) else None
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise HoigsError(
                f"{key}: {value!r} cannot be multiplied by {factor:g}: it is not a number"
            )
        found[key] = max(1, round(value * factor)) if isinstance(value, int) else value * factor
    return found


def merged(below: Mapping[str, Any], over: Mapping[str, Any]) -> Overrides:
    """Two sets of overrides as one: a key of `over` replaces that key and the keys below it, and
    changes one setting of a block that was set as a whole.

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

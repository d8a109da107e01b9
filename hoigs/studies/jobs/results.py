"""What studies train, and the numbers of it: rows, measures, their spread and protocol."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.evaluation.protocol import NotComputed, Protocol, Value, from_json
from hoigs.studies.jobs.cost import Cost

# Rows of methods that a study trains.


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


Measure = tuple[str, str, str]  # view or "geometry", "time", "size"; region or part; metric
ALL_CLIPS = "mean of all clips"


@dataclass(frozen=True)
class Spread:
    """One number over seeds. std is the sample's (n - 1); None with one seed."""

    mean: float
    std: float | None
    values: tuple[float, ...]

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        return Spread(mean(values), stdev(values) if len(values) > 1 else None, tuple(values))


def measures_of(scores: Mapping[str, Any]) -> dict[Measure, Value]:
    """Every number of an evaluation.json, or why there is none."""
    found: dict[Measure, Value] = {
        (s["view"], s["region"], s["metric"]): from_json(s["value"]) for s in scores["scores"]
    }
    for name, value in scores["geometry"].items():
        found["geometry", "", name] = from_json(value)
    timing = scores["timing"]
    for name in ("deform_ms", "raster_ms", "total_ms"):
        reason = timing.get("not_computed")
        found["time", "", name] = NotComputed(reason) if reason else float(timing[name])
    for name in ("gaussians", "parameters", "megabytes"):
        found["size", "", name] = float(sum(part[name] for part in scores["size"]))
    return found


# The protocol of a run's numbers: evaluation, timing and energy meter, in sentences.

VIEW = "test frames"


def protocol_of(scores: Mapping[str, Any], cost: Cost) -> tuple[str, ...]:
    """How the numbers of an evaluation were measured, in sentences."""
    views = [s for s in scores["scores"] if s["view"] == VIEW]
    sentences = Protocol(**views[0]["protocol"]).footnotes()
    timing = scores["timing"]
    if "not_computed" not in timing:
        sentences.append(
            f"Rendering: median of {timing['frames']} frames after {timing['warmup']}, "
            f"{timing['width']}x{timing['height']}, {timing['rasterizer']} on {timing['device']}; "
            f"{timing['note']}."
        )
    sentences.append(
        f"Training: seconds of all steps, checkpoints included, previews not; "
        f"{cost.runs_at_once} run{'s' if cost.runs_at_once > 1 else ''} at a time."
    )
    if cost.source:
        sentences.append(f"Joules: {cost.source}; previews included.")
    if cost.memory_source:
        sentences.append(f"Memory: {cost.memory_source}; previews included.")
    return tuple(sentences)


# Variants of specs as `--specs` of `hoigs study` declares them.

KEY = re.compile(r"\+(?=[A-Za-z_][\w.-]*=)")


def parse_variants(text: str) -> list[Row]:
    """`--specs`: specs with commas between, each `[LABEL=]SPEC[+KEY=VALUE…]`.

    "hoigs,mine.yaml,hoigs+model.object.deformation.use=deformation:acme-bounce" are three.

    Raises:
        HoigsError: none is named, or two have the same label.
    """
    variants = [_variant(part.strip()) for part in _split(text) if part.strip()]
    if not variants:
        raise HoigsError("--specs names no spec; give some: --specs hoigs,4dgs@matched,mine.yaml")
    labels = [v.label for v in variants]
    for variant in variants:
        if labels.count(variant.label) > 1:
            raise HoigsError(
                f'two specs are called "{variant.label}" in --specs; name them: '
                f"first={definition(variant)}"
            )
    return variants


def definition(row: Row) -> str:
    """A variant as `--specs` has it, without its label."""
    return "+".join([str(row.spec), *row.settings])


def _variant(text: str) -> Row:
    head, *settings = KEY.split(text)
    label, named, spec = head.rpartition("=")
    if not spec.strip() or (named and not label.strip()):
        raise HoigsError(f'--specs: "{text}" is no [LABEL=]SPEC[+KEY=VALUE…]')
    spec = spec.strip()
    return Row(label.strip() or _label(spec, settings), spec, tuple(s.strip() for s in settings))


def _label(spec: str, settings: Sequence[str]) -> str:
    """ "hoigs + acme-bounce" of what swaps a component, "hoigs + cap=500" of another setting."""
    name = Path(spec).stem if spec.partition("@")[0].endswith((".yaml", ".yml", ".toml")) else spec
    words = [name]
    for setting in settings:
        key, _, value = setting.partition("=")
        last = key.rpartition(".")[2]
        words.append(value.strip().rpartition(":")[2] if last == "use" else f"{last}={value}")
    return " + ".join(words)


def _split(text: str) -> list[str]:
    """At commas that no bracket encloses: `a,b+entities=[human,object]` are two."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{(") - (letter in "]})")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts

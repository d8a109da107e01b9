"""The protocol of a run's numbers: evaluation, timing and energy meter, in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hoigs.evaluation.protocol import Protocol
from hoigs.studies.jobs.cost import Cost

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

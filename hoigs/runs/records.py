"""What the JSON files of a run hold: the content that is checked when they are read back."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Text = Annotated[str, Field(pattern=r"^[^\x00]*$")]
Count = Annotated[int, Field(ge=0, le=2**31 - 1, strict=True)]


class _Record(BaseModel):
    """Keys beyond the declared ones are kept: later versions may write more."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class ReaderRecord(_Record):
    """The reader of a run's clip."""

    use: Text
    settings: dict[str, Any]


class ClipRecord(_Record):
    """The clip of a run; `path` is relative to the run."""

    path: Text
    name: Text = ""
    reader: ReaderRecord | None = None


class FaultRecord(_Record):
    """A defect of the clip that training tolerated."""

    what: Text
    do: Text


class Provenance(_Record):
    """provenance.json."""

    clip: ClipRecord
    versions: dict[str, Any] = {}
    command: str = ""
    components: dict[str, Any] = {}
    allow_faults: bool = False
    clip_faults: list[FaultRecord] = []
    clip_provenance: dict[str, Any] = {}


class SamplerRecord(_Record):
    """Frames that are left of the present epoch."""

    queue: list[Count]


class CheckpointRecord(_Record):
    """step_000123.json beside a checkpoint's tensors."""

    version: int
    step: Count
    time_s: Annotated[float, Field(ge=0)]
    counts: dict[str, Count]
    spec_name: str
    model_hash: str
    sampler: SamplerRecord | None = None
    skipped: list[tuple[int, str]] = []


class StreamRecord(_Record):
    """One tensor of a compact checkpoint."""

    shape: list[Count]
    dtype: str
    crc32: Annotated[int, Field(ge=0, strict=True)]
    bits: Literal[8, 16] | None = None


class CompactRecord(CheckpointRecord):
    """The same of a compact checkpoint."""

    tensors: dict[str, StreamRecord]
    composed: list[str]


class StepRecord(BaseModel):
    """The part of a line of metrics.jsonl that resuming needs."""

    step: Count


class MetricsRecord(StepRecord):
    """A line of metrics.jsonl; the PSNR of equal images is infinite."""

    time_s: Annotated[float, Field(ge=0)]
    loss: float
    losses: dict[str, float] = {}
    counts: dict[str, Count] = {}
    psnr: dict[str, float] = {}

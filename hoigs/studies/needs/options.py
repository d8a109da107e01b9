"""Options of `hoigs needs`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from hoigs.training.options import FitOptions


class NeedsOptions(FitOptions):
    """How a spec is reduced to what a clip needs."""

    spec: str | Path = "hoigs"
    """The spec to reduce: a name or a file."""
    out: Path | str | None = None
    """Folder of the answer; default: runs/needs-CLIP."""
    least: Annotated[float, Field(ge=0)] = 0.1
    """Ignore gains below this, dB."""
    share: float = 0.05
    """Share of the training frames to hold back (at least 3 frames), below 0.5."""
    smallest: bool = True
    """Try also what is cheaper in ways that only a whole training shows the loss of; without, the
    search is short and the answer close to the whole spec."""
    search_spaces: Path | str | None = None
    """A YAML file of search spaces in place of hoigs's own."""
    allow_faults: bool = False
    """Continue without masks, images and depth that are missing or broken."""

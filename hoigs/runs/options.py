"""Options that several verbs share: where and how a model is run, and which run is opened."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from hoigs.core.options import Flag, Options

if TYPE_CHECKING:
    from hoigs.runs.loaded_run import LoadedRun


class ModelOptions(Options):
    """Of everything that runs a model."""

    rasterizer: str | None = None
    """Rasterizer: warp, torch, oracle or a plugin; default: the spec's."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda if available."""
    plugins: Annotated[tuple[Path | str, ...], Flag("--plugin")] = ()
    """Also load this Python file as a plugin; its code runs."""


class RunOptions(ModelOptions):
    """Of everything that opens a trained run."""

    clip: str | Path | None = None
    """The clip, if it was moved: a folder or builtin:NAME."""

    def open(self, run: Path | str, *, pixels: bool = True) -> LoadedRun:
        """`LoadedRun.open` with these options; errors as it has them."""
        from hoigs.runs.loaded_run import LoadedRun

        return LoadedRun.open(
            run, clip=self.clip, rasterizer=self.rasterizer, device=self.device,
            plugins=self.plugins, pixels=pixels,
        )  # fmt: skip

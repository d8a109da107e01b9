"""prior:sds: the sides that no frame shows, by score distillation from a diffusion model.

The object prior of HOIGS (Sec. "Object Initialization": DreamScene4D and DreamGaussian). The
weights are the user's own; none come with hoigs, and none were at hand when this was written: it
has been run with tiny pipelines of random weights, and with a denoiser whose optimum is known.
"""

from __future__ import annotations

import hashlib
import math
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor

from hoigs.core.clip import Clip, ObjectTrack
from hoigs.core.context import BuildContext
from hoigs.core.errors import HoigsError
from hoigs.core.prior import ObjectPrior
from hoigs.core.rasterizer import Rasterizer
from hoigs.plugins.priors.alignment import AlignmentConfig, PlacingConfig, align, most_seen
from hoigs.plugins.priors.diffusion import Denoiser
from hoigs.plugins.priors.distil import (
    DistillationConfig,
    Reference,
    distil,
    orbit_camera,
    reference_view,
)
from hoigs.plugins.priors.pipelines import (
    Condition,
    TextDenoiser,
    ViewDenoiser,
    check_pipeline,
    pipeline_files,
)

GUIDANCE = {"text": 100.0, "zero123": 5.0, "stable-zero123": 5.0}  # DreamFusion; DreamGaussian
SOURCES = ("diffusion.py", "distil.py", "pipelines.py", "sds.py")


class SdsPriorConfig(PlacingConfig):
    """Settings of `prior:sds`; beside them those of where it goes."""

    path: Path = Field(description="folder of a diffusers pipeline, with .safetensors weights")
    condition: Condition = Field(default="text", description="what the pipeline is told")
    prompt: str = Field(default="", description='condition: text: what it is, "a brown box"')
    negative_prompt: str = Field(default="", description="condition: text: what it is not")
    guidance: float | None = Field(
        default=None, ge=1, description="classifier-free; by default 100 for text, else 5"
    )
    distillation: DistillationConfig = DistillationConfig()
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto", description="that distils; auto: CUDA where there is some"
    )
    half: bool | None = Field(default=None, description="float16; by default on CUDA")
    cache: bool = Field(default=True, description="keep the shape in $HOIGS_CACHE, ~/.cache/hoigs")

    @model_validator(mode="after")
    def _text_needs_words(self) -> SdsPriorConfig:
        if self.condition == "text" and not self.prompt.strip():
            raise ValueError('condition: text needs a prompt, such as "a brown cardboard box"')
        return self


class SdsPrior(ObjectPrior):
    """Gaussians distilled from a diffusion model and the object's best view, aligned by S.

    Composing a model again, as rendering and resuming do, takes the shape from the cache, whose key
    covers the settings, the seed, the reference and the pipeline's files (names, sizes, times).

    Args:
        settings: as SdsPriorConfig describes them. rasterizer: that draws the views.

    Raises:
        HoigsError, PluginError: at `initialise`, a pipeline that is absent or cannot be loaded, or
            diffusers not installed.
    """

    def __init__(self, settings: SdsPriorConfig, rasterizer: Rasterizer, *, seed: int = 0) -> None:
        self.settings, self.rasterizer, self.seed = settings, rasterizer, seed

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        if context.rasterizer is None:
            raise ValueError("prior:sds draws: its BuildContext needs a rasterizer")
        return cls(config, context.rasterizer, seed=context.seed)

    def initialise(self, clip: Clip, entity: str) -> ObjectTrack:
        s = self.settings
        at = most_seen(clip, entity) if s.reference is None else s.reference
        if at >= len(clip):
            raise ValueError(f"reference {at}: the clip has {len(clip)} frames")
        check_pipeline(s.path, s.condition)
        view = reference_view(clip, entity, at, 256)
        kept = self._cache_file(view)
        if s.cache and kept.is_file():
            points, colors = _load(kept)
        else:
            points, colors = self._generate(view)
            if s.cache:
                _save(kept, points, colors)
        placing = {k: getattr(s, k) for k in PlacingConfig.model_fields}
        alignment = AlignmentConfig(**{**placing, "space": "camera", "reference": at})
        why = f"distilled from {s.path.name} ({s.condition}) and frame {at}"
        return align(points, colors, clip, entity, alignment, provenance=why)

    def device(self) -> torch.device:
        """Where it is distilled: CUDA if there is one and the rasterizer draws there."""
        if self.settings.device != "auto":
            return torch.device(self.settings.device)
        usable = torch.cuda.is_available() and "cuda" in self.rasterizer.capabilities.devices
        return torch.device("cuda" if usable else "cpu")

    def denoiser(self, view: Reference) -> Denoiser:
        """The pipeline, loaded and told what to make."""
        s, device = self.settings, self.device()
        shared: dict[str, Any] = {
            "guidance": GUIDANCE[s.condition] if s.guidance is None else s.guidance,
            "half": device.type == "cuda" if s.half is None else s.half,
            "device": device,
        }
        if s.condition == "text":
            return TextDenoiser(s.path, s.prompt, s.negative_prompt, **shared)
        above = math.radians(s.distillation.elevation_degrees)
        return ViewDenoiser(s.path, view.image, s.condition, above, **shared)

    def _generate(self, view: Reference) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """Points in the axes of the reference camera, and their colours."""
        denoiser, settings = self.denoiser(view), self.settings.distillation
        with torch.enable_grad():
            made = distil(
                denoiser, self.rasterizer, view, settings, seed=self.seed, device=self.device()
            )
        if len(made) < 4:
            raise HoigsError(
                f"{len(made)} of {settings.count} Gaussians are left after {settings.steps} steps: "
                "the distillation has failed; other weights, guidance or prompt may help"
            )
        turn = orbit_camera(torch.zeros(3), settings, 8).world_to_camera[:3, :3]
        return made.means.cpu() @ turn.mT, made.colors.cpu().clamp(0, 1)

    def _cache_file(self, view: Reference) -> Path:
        """Its name covers everything that the shape depends on."""
        unused = {*PlacingConfig.model_fields, "cache", "device", "path"}
        digest = hashlib.sha256(self.settings.model_dump_json(exclude=unused).encode())
        digest.update(f"{self.seed} {type(self.rasterizer).__qualname__}".encode())
        digest.update(pipeline_files(self.settings.path).encode())
        for tensor in (view.image, view.mask):
            digest.update(np.ascontiguousarray(tensor.numpy()).tobytes())
        for name in SOURCES:
            digest.update(Path(__file__).with_name(name).read_bytes())
        named = os.environ.get("HOIGS_CACHE")
        root = Path(named).expanduser() if named else Path.home() / ".cache" / "hoigs"
        return root / "priors" / f"sds-{digest.hexdigest()[:16]}.npz"


def _save(path: Path, points: Float[Tensor, "P 3"], colors: Float[Tensor, "P 3"]) -> None:
    """All or nothing: written beside, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, scratch = tempfile.mkstemp(prefix=".sds-", suffix=".npz", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, points=points.numpy(), colors=colors.numpy())
        Path(scratch).replace(path)
    except BaseException:
        Path(scratch).unlink(missing_ok=True)
        raise


def _load(path: Path) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            points, colors = (torch.from_numpy(file[k]).float() for k in ("points", "colors"))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise HoigsError(f"{path} is damaged ({error}); delete it, it is made again") from error
    return points, colors

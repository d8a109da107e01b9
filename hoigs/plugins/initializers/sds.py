"""initializer:sds: unseen sides of an object, by score distillation from a diffusion model.

HOIGS (Sec. "Object Initialization") initializes objects with DreamScene4D and DreamGaussian. The
weights are the user's own. No real weights were available for testing: the tests run tiny pipelines
of random weights, and a denoiser whose optimum is known.
"""

from __future__ import annotations

import hashlib
import math
import os
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.initializer import ObjectInitializer
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.system.files import written_whole
from hoigs.core.system.npz import load_arrays
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.plugins.initializers.alignment import (
    AlignmentConfig,
    PlacingConfig,
    align,
    reference_frame,
)
from hoigs.plugins.initializers.sds_distillation import (
    Denoiser,
    DistillationConfig,
    Reference,
    distil,
    orbit_camera,
    reference_view,
)
from hoigs.plugins.initializers.sds_pipelines import (
    Condition,
    TextDenoiser,
    ViewDenoiser,
    check_pipeline,
    pipeline_files,
)

GUIDANCE = {"text": 100.0, "zero123": 5.0, "stable-zero123": 5.0}  # DreamFusion; DreamGaussian
SOURCES = ("sds.py", "sds_distillation.py", "sds_pipelines.py")


class SdsInitializerConfig(PlacingConfig):
    """Settings of `initializer:sds`, with those of the object's placement."""

    path: Path = Field(description="folder of a diffusers pipeline, with .safetensors weights")
    condition: Condition = Field(default="text", description="what the pipeline is conditioned on")
    prompt: str = Field(
        default="", description='for condition: text, what the object is, "a brown box"'
    )
    negative_prompt: str = Field(
        default="", description="for condition: text, what the object is not"
    )
    guidance: float | None = Field(
        default=None,
        ge=1,
        description="classifier-free guidance scale; by default 100 for text, else 5",
    )
    distillation: DistillationConfig = DistillationConfig()
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto", description="where to distil; auto: CUDA where it is available"
    )
    half: bool | None = Field(default=None, description="compute in float16; by default on CUDA")
    cache: bool = Field(
        default=True, description="keep the shape in $HOIGS_CACHE or ~/.cache/hoigs"
    )

    @model_validator(mode="after")
    def _text_needs_words(self) -> SdsInitializerConfig:
        if self.condition == "text" and not self.prompt.strip():
            raise ValueError('condition: text needs a prompt, such as "a brown cardboard box"')
        return self


class SdsInitializer(ObjectInitializer):
    """Gaussians distilled from a diffusion model and the object's best view, aligned by S.

    Composing a model again, as rendering and resuming do, takes the shape from the cache, whose key
    covers the settings, the seed, the reference and the pipeline's files (names, sizes, times).

    Args:
        rasterizer: draws the views of the distillation.

    Raises:
        HoigsError, PluginError: at `initialize`, a pipeline that is absent or cannot be loaded, or
            diffusers not installed.
    """

    Config: ClassVar = SdsInitializerConfig
    config: SdsInitializerConfig

    def __init__(
        self, config: SdsInitializerConfig, *, rasterizer: Rasterizer, seed: int = 0
    ) -> None:
        super().__init__(config)
        self.rasterizer, self.seed = rasterizer, seed

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        if context.rasterizer is None:
            raise ValueError("initializer:sds renders: its BuildContext needs a rasterizer")
        return cls(config, rasterizer=context.rasterizer, seed=context.seed)

    def initialize(self, clip: Clip, entity: str) -> ObjectTrack:
        s = self.config
        at = reference_frame(s, clip, entity)
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
        if self.config.device != "auto":
            return torch.device(self.config.device)
        usable = torch.cuda.is_available() and "cuda" in self.rasterizer.capabilities.devices
        return torch.device("cuda" if usable else "cpu")

    def denoiser(self, view: Reference) -> Denoiser:
        """The pipeline, loaded, with its condition."""
        s, device = self.config, self.device()
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
        denoiser, settings = self.denoiser(view), self.config.distillation
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
        digest = hashlib.sha256(self.config.model_dump_json(exclude=unused).encode())
        digest.update(f"{self.seed} {type(self.rasterizer).__qualname__}".encode())
        digest.update(pipeline_files(self.config.path).encode())
        for tensor in (view.image, view.mask):
            digest.update(np.ascontiguousarray(tensor.numpy()).tobytes())
        for name in SOURCES:
            digest.update(Path(__file__).with_name(name).read_bytes())
        named = os.environ.get("HOIGS_CACHE")
        root = Path(named).expanduser() if named else Path.home() / ".cache" / "hoigs"
        return root / "initializers" / f"sds-{digest.hexdigest()[:16]}.npz"


def _save(path: Path, points: Float[Tensor, "P 3"], colors: Float[Tensor, "P 3"]) -> None:
    """All or nothing: written beside, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path, path.with_name(f".{path.stem}.{os.getpid()}.npz")) as part:
        np.savez_compressed(part, points=points.numpy(), colors=colors.numpy())


def _load(path: Path) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    try:
        file = load_arrays(path, ("points", "colors"))
        points, colors = (torch.from_numpy(file[k]).float() for k in ("points", "colors"))
    except (OSError, ValueError, KeyError) as error:
        raise HoigsError(f"{path} is damaged ({error}); delete it and run again") from error
    return points, colors

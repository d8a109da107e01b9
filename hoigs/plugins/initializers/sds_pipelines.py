"""Diffusers pipelines on disk as denoisers. Weights are the user's: none come with hoigs.

Parts are loaded one by one by their own classes, from safetensors only, so that no code and no
pickle of a downloaded folder is ever run; whatever else the folder holds is not read.
"""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import HoigsError, PluginError
from hoigs.plugins.initializers.sds_distillation import Denoiser

Condition = Literal["text", "zero123", "stable-zero123"]
PARTS: dict[str, tuple[str, ...]] = {
    "text": ("unet", "vae", "scheduler", "tokenizer", "text_encoder"),
    "zero123": ("unet", "vae", "scheduler", "image_encoder"),
    "stable-zero123": ("unet", "vae", "scheduler", "image_encoder"),
}
PROJECTIONS = ("cc_projection", "clip_camera_projection")  # image and camera to the UNet's tokens
CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


def check_pipeline(path: Path, condition: Condition) -> None:
    """Raise HoigsError when a folder lacks what `condition` needs; loads nothing."""
    if not path.is_dir():
        raise HoigsError(
            f"{path}: no such folder; expected a diffusers pipeline that you have downloaded, with "
            f"{', '.join(PARTS[condition])} in it"
        )
    absent = [part for part in PARTS[condition] if not (path / part).is_dir()]
    if condition != "text" and not any((path / name).is_dir() for name in PROJECTIONS):
        absent.append(" or ".join(PROJECTIONS))
    if absent:
        raise HoigsError(
            f"{path}: no {', '.join(absent)} in it; condition: {condition} needs a diffusers "
            f"pipeline with {', '.join(PARTS[condition])}"
        )
    for part in PARTS[condition]:
        if part not in ("scheduler", "tokenizer") and not list((path / part).glob("*.safetensors")):
            raise HoigsError(
                f"{path / part}: no .safetensors file; other formats may run code when they are "
                "read: save the pipeline again with safe_serialization=True"
            )


def _libraries() -> tuple[ModuleType, ModuleType]:
    try:
        import diffusers
        import transformers
    except ImportError as error:
        raise PluginError(
            f"initializer:sds needs diffusers and transformers ({error}); pip install 'hoigs[sds]'"
        ) from error
    return diffusers, transformers


class PipelineDenoiser(Denoiser):
    """UNet, autoencoder and noise schedule of a latent diffusion pipeline; frozen.

    Args:
        path: the pipeline's folder. guidance: classifier-free, 1 is none. half: float16.

    Raises:
        PluginError: diffusers or transformers is not installed.
        HoigsError: the folder lacks a part, or one cannot be loaded.
    """

    condition: Condition

    def __init__(
        self, path: str | Path, *, guidance: float, device: torch.device | str, half: bool = False
    ) -> None:
        self.path, self.guidance, self.device = Path(path), guidance, torch.device(device)
        self.dtype = torch.float16 if half else torch.float32
        check_pipeline(self.path, self.condition)
        self.diffusers, self.transformers = _libraries()
        self.unet = self.load(self.diffusers.UNet2DConditionModel, "unet")
        self.vae = self.load(self.diffusers.AutoencoderKL, "vae")
        schedule = self.load(self.diffusers.DDPMScheduler, "scheduler")
        self.alphas = schedule.alphas_cumprod.to(self.device)
        self.kind = str(schedule.config.prediction_type)
        if self.kind not in ("epsilon", "v_prediction"):
            raise HoigsError(
                f"{self.path}/scheduler: prediction_type is {self.kind}, expected epsilon or "
                "v_prediction"
            )
        factor = 2 ** (len(self.vae.config.block_out_channels) - 1)
        self.size = int(self.unet.config.sample_size) * factor

    def load(self, kind: Any, part: str) -> Any:
        """One part of the pipeline: from this disk only, frozen, on the device."""
        settings: dict[str, Any] = {"local_files_only": True}
        is_model = isinstance(kind, type) and issubclass(kind, torch.nn.Module)
        if is_model:
            settings |= {"use_safetensors": True, "torch_dtype": self.dtype}
        try:
            loaded = kind.from_pretrained(str(self.path / part), **settings)
        except Exception as error:  # its loaders raise anything on a damaged folder
            reason = f"{type(error).__name__}: {error}"
            raise HoigsError(f"{self.path / part} cannot be loaded: {reason}") from error
        return loaded.to(self.device).eval().requires_grad_(False) if is_model else loaded

    def encode(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        latents = self.vae.encode((2 * images - 1).to(self.dtype)).latent_dist.mode()
        return (latents * self.vae.config.scaling_factor).float()

    def predict(
        self, noisy: Float[Tensor, "B C h w"], step: int, views: Float[Tensor, "B 3"]
    ) -> Float[Tensor, "B C h w"]:
        with_it, without = self.tokens(views)
        beside, empty = self.beside(noisy)
        inputs = torch.cat((torch.cat((noisy, beside), 1), torch.cat((noisy, empty), 1)))
        steps = torch.full((len(inputs),), step, device=noisy.device)
        tokens = torch.cat((with_it, without))
        output = self.unet(inputs.to(self.dtype), steps, encoder_hidden_states=tokens).sample
        wanted, plain = output.float().chunk(2)
        guess = plain + self.guidance * (wanted - plain)
        if self.kind == "v_prediction":  # v = sqrt(a) eps - sqrt(1 - a) x
            alpha = self.alphas[step]
            guess = alpha.sqrt() * guess + (1 - alpha).sqrt() * noisy
        return guess

    @abstractmethod
    def tokens(
        self, views: Float[Tensor, "B 3"]
    ) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "B L D"]]:
        """What the UNet attends to, with the condition and without."""

    def beside(
        self, noisy: Float[Tensor, "B C h w"]
    ) -> tuple[Float[Tensor, "B c h w"], Float[Tensor, "B c h w"]]:
        """Channels laid beside the latents, with the condition and without; none by default."""
        return noisy[:, :0], noisy[:, :0]


class TextDenoiser(PipelineDenoiser):
    """Stable Diffusion 1 or 2: conditioned by words, which also name the side that is seen.

    The prompt gets ", front view", ", side view" or ", back view" by azimuth (DreamFusion, sec.
    3.2: view-dependent conditioning).
    """

    condition: Condition = "text"
    white = False

    def __init__(self, path: str | Path, prompt: str, negative: str = "", **settings: Any) -> None:
        super().__init__(path, **settings)
        self.tokenizer = self.load(self.transformers.CLIPTokenizer, "tokenizer")
        self.text_encoder = self.load(self.transformers.CLIPTextModel, "text_encoder")
        texts = [f"{prompt}, {side} view" for side in ("front", "side", "back")]
        self.sides = self._embedded([*texts, negative])

    @torch.no_grad()
    def _embedded(self, texts: list[str]) -> Float[Tensor, "T L D"]:
        ids = self.tokenizer(
            texts,
            padding="max_length",
            max_length=self.tokenizer.model_max_length,
            truncation=True,
            return_tensors="pt",
        ).input_ids
        return self.text_encoder(ids.to(self.device))[0]

    def tokens(
        self, views: Float[Tensor, "B 3"]
    ) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "B L D"]]:
        turned = views[:, 1].abs()
        side = (turned > math.pi / 3).long() + (turned > 2 * math.pi / 3).long()
        return self.sides[side], self.sides[3:].expand(len(views), -1, -1)


class ViewDenoiser(PipelineDenoiser):
    """Zero-1-to-3 (Liu et al. 2023) or Stable Zero123: conditioned by the reference and the view.

    Tokens are the image's CLIP embedding and the relative view, projected; the image's latents
    stand beside the noisy ones.

    Args:
        image: the reference on white, RGB in [0, 1].
        elevation: angle of the reference camera above the object, radians; read by stable-zero123.
    """

    def __init__(
        self,
        path: str | Path,
        image: Float[Tensor, "H W 3"],
        condition: Condition = "zero123",
        elevation: float = 0.0,
        **settings: Any,
    ) -> None:
        self.condition, self.elevation = condition, elevation
        super().__init__(path, **settings)
        encoder = self.load(self.transformers.CLIPVisionModelWithProjection, "image_encoder")
        picture = image.permute(2, 0, 1)[None].to(self.device)
        self.weight, self.bias = self._projection()
        with torch.no_grad():
            self.image_tokens = encoder(self._for_clip(picture, encoder)).image_embeds
            whole = torch.nn.functional.interpolate(picture, (self.size, self.size), mode="area")
            latents = self.vae.encode((2 * whole - 1).to(self.dtype)).latent_dist.mode()
        self.latents = latents.float()  # not scaled, as the models were trained

    def _for_clip(self, picture: Tensor, encoder: Any) -> Tensor:
        side = encoder.config.image_size
        small = torch.nn.functional.interpolate(
            picture, (side, side), mode="bicubic", antialias=True
        ).clamp(0, 1)
        mean, std = (small.new_tensor(v)[:, None, None] for v in (CLIP_MEAN, CLIP_STD))
        return ((small - mean) / std).to(self.dtype)

    def _projection(self) -> tuple[Tensor, Tensor]:
        """Weight [D, E + 4] and bias [D] of the layer that joins image and camera."""
        from safetensors.torch import load_file

        folder = next(self.path / name for name in PROJECTIONS if (self.path / name).is_dir())
        files = sorted(folder.glob("*.safetensors"))
        tensors = list(load_file(files[0]).values()) if files else []
        weights = [t for t in tensors if t.dim() == 2]
        biases = [t for t in tensors if t.dim() == 1]
        if len(weights) != 1 or len(biases) != 1:
            raise HoigsError(f"{folder}: expected one weight and one bias in a .safetensors file")
        return tuple(t.to(self.device, self.dtype) for t in (weights[0], biases[0]))  # type: ignore[return-value]

    def tokens(
        self, views: Float[Tensor, "B 3"]
    ) -> tuple[Float[Tensor, "B L D"], Float[Tensor, "B L D"]]:
        last = views[:, 2]
        if self.condition == "stable-zero123":
            last = torch.full_like(last, math.pi / 2 - self.elevation)
        where = torch.stack((views[:, 0], views[:, 1].sin(), views[:, 1].cos(), last), 1)
        joined = torch.cat((self.image_tokens.expand(len(views), -1), where.to(self.dtype)), 1)
        tokens = torch.nn.functional.linear(joined, self.weight, self.bias)[:, None]
        return tokens, torch.zeros_like(tokens)

    def beside(
        self, noisy: Float[Tensor, "B C h w"]
    ) -> tuple[Float[Tensor, "B c h w"], Float[Tensor, "B c h w"]]:
        latents = self.latents.expand(len(noisy), -1, -1, -1)
        return latents, torch.zeros_like(latents)


def pipeline_files(path: Path) -> str:
    """Names, sizes and times of a pipeline's files: what a result made with it depends on."""
    files = sorted(p for p in path.rglob("*") if p.is_file())
    rows = [(str(p.relative_to(path)), p.stat().st_size, p.stat().st_mtime_ns) for p in files]
    return json.dumps(rows)

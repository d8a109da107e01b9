"""Models of transformers, from a folder on disk or from the hub. Weights are the user's.

Only classes of the installed library are used and only safetensors are read: neither code nor
pickles of a checkpoint are ever run.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import torch
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.environments import hub
from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.interfaces.estimator import VideoRequest
from hoigs.plugins.estimators.common.frame_files import absent

_HUB = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
Device = Literal["auto", "cpu", "cuda"]


class ModelConfig(ComponentConfig):
    """Settings that the estimators with models of transformers share."""

    checkpoint: str = Field(
        description="folder of a transformers model, relative to the video's folder, or its name "
        "on the Hugging Face hub, from where it is downloaded once; mind its licence"
    )
    device: Device = Field(
        default="auto", description="where to compute; 'auto': CUDA where it is available"
    )
    half: bool = Field(
        default=False, description="compute in float16, with half the memory; for CUDA"
    )


def library(key: str) -> ModuleType:
    """transformers.

    Raises:
        PluginError: it is not installed.
    """
    try:
        import transformers
    except ImportError as error:
        raise PluginError(
            f"{key} needs transformers ({error}); pip install 'hoigs[estimators]'"
        ) from error
    return transformers


def device_of(device: Device) -> torch.device:
    """The device of a setting; "auto" is CUDA where there is one."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(device)


def place_of(checkpoint: str, video: VideoRequest, key: str) -> str:
    """A folder's path, or that in the hub's cache of a name on the hub, which is downloaded where
    it is not there yet.

    Raises:
        HoigsError: neither, or a folder that holds no model with safetensors; or the hub's cannot
            be had.
    """
    folder = video.resolve(Path(checkpoint))
    if not folder.is_dir():
        if _HUB.fullmatch(checkpoint):
            return str(hub.fetched(checkpoint))
        raise HoigsError(
            f"{key}: {absent(folder)}; expected the folder of a transformers model, with "
            "config.json and .safetensors in it, or a name on the hub, such as owner/model"
        )
    lacking = [] if (folder / "config.json").is_file() else ["config.json"]
    if not list(folder.glob("*.safetensors")):
        lacking.append("*.safetensors (other formats may run code when they are read)")
    if lacking:
        raise HoigsError(f"{key}: {folder} is no transformers model; it lacks {lacking}")
    return str(folder)


def load(kind: Any, place: str, key: str, **settings: Any) -> Any:
    """`kind.from_pretrained(place)`.

    Raises:
        HoigsError: it cannot be loaded, or the checkpoint has not all of the model's weights.
    """
    is_model = "Model" in kind.__name__ or issubclass(kind, torch.nn.Module)
    if is_model:
        settings |= {"use_safetensors": True, "output_loading_info": True}
    try:
        loaded = kind.from_pretrained(place, **settings)
    except Exception as error:  # its loaders raise anything on a damaged or unknown checkpoint
        reason = f"{type(error).__name__}: {error}"
        raise HoigsError(f"{key}: {place} cannot be loaded by {kind.__name__}: {reason}") from error
    if not is_model:
        return loaded
    model, report = loaded
    # counters of batches have no effect in inference, and older checkpoints have none
    missing = sorted(k for k in report["missing_keys"] if not k.endswith("num_batches_tracked"))
    if missing:  # transformers would fill them with random numbers
        raise HoigsError(
            f"{key}: {place} lacks {len(missing)} weights of {type(model).__name__}, such as "
            f"{missing[0]}: it is another kind of model"
        )
    return model


def ready(model: Any, device: torch.device, half: bool) -> Any:
    """The model for inference."""
    model = model.to(device).eval().requires_grad_(False)
    return model.half() if half else model


def to_model(inputs: Any, model: Any) -> dict[str, Any]:
    """A processor's tensors on the model's device, in its precision."""
    return {
        name: value.to(model.device, model.dtype if value.is_floating_point() else None)
        for name, value in inputs.items()
        if isinstance(value, torch.Tensor)
    }

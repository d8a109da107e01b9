"""LPIPS v0.1 (Zhang et al. 2018) in plain torch.

The package ships AlexNet's weights (`metrics/data`). `find_weights` tries, in this order, the given
path, the environment variable HOIGS_LPIPS_WEIGHTS, and the package's own for AlexNet; for VGG-16
torchvision's download cache, whose backbone needs the heads of an installed `lpips` package.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.errors import HoigsError
from hoigs.core.system.files import regular_file
from hoigs.core.system.npz import load_arrays
from hoigs.metrics.inputs import check_pair

Net = Literal["alex", "vgg"]
VARIABLE = "HOIGS_LPIPS_WEIGHTS"
SHIPPED = Path(__file__).parent / "data" / "lpips_alex.npz"
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
MIN_SIZE = 32  # AlexNet's two poolings leave nothing of smaller images


@dataclass(frozen=True)
class _Stack:
    """A backbone: `conv` rows are (torchvision index, stride, padding)."""

    convs: tuple[tuple[int, int, int], ...]
    pool: tuple[int, int]  # kernel, stride
    pool_before: tuple[int, ...]  # convolutions that are fed a pooled input
    taps: tuple[int, ...]  # convolutions after whose ReLU features are compared
    checkpoint: str  # torchvision's file name


_VGG_INDEX = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
STACKS: dict[str, _Stack] = {
    "alex": _Stack(
        convs=((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)),
        pool=(3, 2),
        pool_before=(1, 2),
        taps=(0, 1, 2, 3, 4),
        checkpoint="alexnet-owt-*.pth",
    ),
    "vgg": _Stack(
        convs=tuple((i, 1, 1) for i in _VGG_INDEX),
        pool=(2, 2),
        pool_before=(2, 4, 7, 10),
        taps=(1, 3, 6, 9, 12),
        checkpoint="vgg16-*.pth",
    ),
}


@dataclass(frozen=True)
class FoundWeights:
    """Where LPIPS weights are, or why there are none.

    Attributes:
        location: a file, or None. reason: how it was found, or why nothing was.
        heads: the linear heads, where they are a file of their own.
    """

    location: str | None
    reason: str
    heads: str | None = None


def find_weights(path: Path | str | None = None, net: Net = "alex") -> FoundWeights:
    """Find weights; the file itself is read by `Lpips.load`.

    Args:
        path: an .npz with `conv{i}_w`, `conv{i}_b`, `lin{i}` (any float type), or torchvision's
            checkpoint (.pth).
        net: backbone whose weights are searched for in torchvision's cache.

    Raises:
        HoigsError: `path` is given and there is no such file.
    """
    if path is not None:
        if not Path(path).is_file():
            raise HoigsError(f"LPIPS weights {path}: no such file")
        return _with_heads(Path(path), net, "given")
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).is_file():
            return FoundWeights(None, f"{VARIABLE} names {named}, where no file is")
        return _with_heads(Path(named), net, f"from {VARIABLE}")
    if net == "alex":
        return FoundWeights(str(SHIPPED), "shipped with hoigs, half precision")
    cache = Path(torch.hub.get_dir()) / "checkpoints"
    for file in sorted(cache.glob(STACKS[net].checkpoint)):
        return _with_heads(file, net, "in torchvision's cache")
    return FoundWeights(
        None,
        f"no LPIPS weights of {net}: give --lpips-weights FILE or set {VARIABLE}; "
        f"torchvision's {STACKS[net].checkpoint} is not in {cache} either",
    )


def _with_heads(file: Path, net: Net, how: str) -> FoundWeights:
    """Torchvision's checkpoints lack the heads, which the `lpips` package carries."""
    if file.suffix == ".npz":
        return FoundWeights(str(file), how)
    spec = importlib.util.find_spec("lpips")  # only looked up: importing it needs torchvision
    for folder in (spec.submodule_search_locations or []) if spec else []:
        for heads in (Path(folder) / "weights" / "v0.1").glob(f"{net}.pth"):
            return FoundWeights(str(file), how, str(heads))
    return FoundWeights(
        None, f"{file.name} is {how}, but LPIPS's own heads are not: pip install lpips"
    )


class Lpips(nn.Module):
    """The learned perceptual distance; lower is more alike.

    Inputs are RGB in [0, 1], channels last; they are brought to [-1, 1], as the network expects
    and as ExAvatar and HOSNeRF do. Differentiable in the images; the weights are frozen.

    Args:
        net: backbone. arrays: `conv{i}_w [O,I,k,k]`, `conv{i}_b [O]`, `lin{i} [O]`.
        source: where the weights came from, for protocols.
    """

    def __init__(self, net: Net, arrays: dict[str, Tensor], source: str = "") -> None:
        super().__init__()
        self.net: Net = net
        self.source = source
        self.stack = STACKS[net]
        for key in _keys(self.stack):
            if key not in arrays:
                raise HoigsError(f"LPIPS weights for {net}: array {key} is absent")
            # detached copies in full precision: the file may be half
            self.register_buffer(key, arrays[key].detach().float().clone(), persistent=False)
        self.register_buffer("shift", torch.tensor(SHIFT).reshape(3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).reshape(3, 1, 1), persistent=False)

    @classmethod
    def load(cls, found: FoundWeights) -> Lpips:
        """Read what `find_weights` found.

        Raises:
            HoigsError: nothing was found, or the file is not what it should be.
        """
        if found.location is None:
            raise HoigsError(found.reason)
        file = Path(found.location)
        arrays = _read_npz(file) if file.suffix == ".npz" else _read_checkpoint(file, found.heads)
        return cls("vgg" if "conv12_w" in arrays else "alex", arrays, found.reason)

    def forward(
        self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]
    ) -> Float[Tensor, ""]:
        """Distance of two images: the mean over pixels of each layer, summed over layers."""
        return torch.stack([d.mean() for d in self._layers(image, target)]).sum()

    def map(
        self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]
    ) -> Float[Tensor, "H W"]:
        """Distance at each pixel: each layer's map brought to full size bilinearly, summed."""
        size = (max(image.shape[0], MIN_SIZE), max(image.shape[1], MIN_SIZE))
        resize = torch.nn.functional.interpolate
        layers = [
            resize(d[None], size, mode="bilinear", align_corners=False)[0, 0]
            for d in self._layers(image, target)
        ]
        return torch.stack(layers).sum(0)[: image.shape[0], : image.shape[1]]

    def _layers(self, image: Tensor, target: Tensor) -> list[Tensor]:
        """Weighted squared difference of unit features of each layer, [1, h, w]."""
        features = self._features(torch.stack((image, target)))
        distances = []
        for layer, (a, b) in enumerate(features):
            head = self.get_buffer(f"lin{layer}")
            distances.append(((_unit(a) - _unit(b)).square() * head[:, None, None]).sum(0)[None])
        return distances

    def _features(self, images: Tensor) -> list[Tensor]:
        shift, scale = self.get_buffer("shift"), self.get_buffer("scale")
        x = (2 * images.permute(0, 3, 1, 2) - 1 - shift) / scale
        x = _at_least(x, MIN_SIZE)
        features = []
        for i, (_, stride, padding) in enumerate(self.stack.convs):
            if i in self.stack.pool_before:
                x = torch.nn.functional.max_pool2d(x, *self.stack.pool)
            weight, bias = self.get_buffer(f"conv{i}_w"), self.get_buffer(f"conv{i}_b")
            x = torch.nn.functional.conv2d(x, weight, bias, stride, padding).relu()
            if i in self.stack.taps:
                features.append(x)
        return features


def lpips(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], net: Net = "alex"
) -> Float[Tensor, ""]:
    """The distance of two images by the weights that `find_weights` finds, on their device.

    The network is loaded at the first call and kept; make an `Lpips` to give weights of your own.

    Raises:
        ValueError: the images have other shapes.
        HoigsError: there are no weights of this net.
    """
    check_pair(image, target)
    return _loaded(net).to(image.device)(image, target)


@functools.lru_cache(maxsize=2)
def _loaded(net: Net) -> Lpips:
    return Lpips.load(find_weights(net=net))


def _keys(stack: _Stack) -> list[str]:
    convs = range(len(stack.convs))
    heads = range(len(stack.taps))
    return [f"conv{i}_{p}" for i in convs for p in "wb"] + [f"lin{i}" for i in heads]


def _read_npz(file: Path) -> dict[str, Tensor]:
    try:
        return {key: torch.from_numpy(values) for key, values in load_arrays(file).items()}
    except (OSError, ValueError) as error:
        raise HoigsError(f"LPIPS weights {file} cannot be read: {error}") from error


def _read_tensors(file: Path) -> dict[str, Tensor]:
    """A .pth of other libraries: these files are what users have. Tensors only, no code is run;
    onto the CPU, since they may have been saved from a GPU that is not here."""
    try:
        return torch.load(regular_file(file), map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise HoigsError(f"LPIPS weights {file} cannot be read: {error}") from error


def _read_checkpoint(file: Path, heads: str | None) -> dict[str, Tensor]:
    """A torchvision backbone and the heads of the `lpips` package, as tensors only."""
    if heads is None:
        raise HoigsError(f"LPIPS weights {file}: a backbone without heads; pip install lpips")
    backbone = _read_tensors(file)
    first = backbone.get("features.0.weight")
    if first is None:
        raise HoigsError(
            f"LPIPS weights {file}: no features.0.weight; expected torchvision's "
            "AlexNet or VGG-16 checkpoint, or an .npz"
        )
    net = "alex" if first.shape[-1] == 11 else "vgg"
    arrays = {}
    for i, (index, _, _) in enumerate(STACKS[net].convs):
        arrays[f"conv{i}_w"] = backbone[f"features.{index}.weight"]
        arrays[f"conv{i}_b"] = backbone[f"features.{index}.bias"]
    linear = _read_tensors(Path(heads))
    for i in range(len(STACKS[net].taps)):
        arrays[f"lin{i}"] = linear[f"lin{i}.model.1.weight"].flatten()
    return arrays


def _unit(features: Tensor) -> Tensor:
    """Features over their norm along channels; zero stays zero, with a finite gradient."""
    norm = (features.square().sum(0, keepdim=True) + 1e-20).sqrt()
    return features / (norm + 1e-10)


def _at_least(images: Tensor, size: int) -> Tensor:
    """Images grown to at least `size` by repeating their last row and column."""
    height, width = images.shape[-2:]
    grow = (0, max(0, size - width), 0, max(0, size - height))
    return torch.nn.functional.pad(images, grow, mode="replicate") if any(grow) else images

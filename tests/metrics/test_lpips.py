"""LPIPS against torchvision's and lpips' own layer definitions, its files, and its reasons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hoigs.core.errors import HoigsError
from hoigs.metrics.lpips import STACKS, VARIABLE, FoundWeights, Lpips, find_weights

VGG_WIDTHS = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
ALEX_SHAPES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))


@pytest.fixture(autouse=True)
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No weights by environment, and an empty torchvision cache."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    cache = tmp_path / "torch" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    return cache


def random_arrays(net: str) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    shapes = ALEX_SHAPES
    if net == "vgg":
        inputs = (3, *VGG_WIDTHS[:-1])
        shapes = tuple((o, i, 3) for o, i in zip(VGG_WIDTHS, inputs, strict=True))
    arrays = {}
    for i, (out, inner, k) in enumerate(shapes):
        bound = (2 / (inner * k * k)) ** 0.5
        arrays[f"conv{i}_w"] = bound * torch.randn(out, inner, k, k, generator=generator)
        arrays[f"conv{i}_b"] = 0.1 * torch.randn(out, generator=generator)
    for i, tap in enumerate(STACKS[net].taps):
        arrays[f"lin{i}"] = torch.rand(shapes[tap][0], generator=generator)
    return arrays


def torchvision_features(net: str) -> nn.Sequential:
    """`torchvision.models.alexnet().features` and `vgg16().features`, copied by definition."""
    if net == "alex":
        return nn.Sequential(
            nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
            nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
        )  # fmt: skip
    layers: list[nn.Module] = []
    before = 3
    for width in (
        64,
        64,
        "M",
        128,
        128,
        "M",
        256,
        256,
        256,
        "M",
        512,
        512,
        512,
        "M",
        512,
        512,
        512,
    ):
        if width == "M":
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(before, int(width), 3, padding=1), nn.ReLU()]
            before = int(width)
    return nn.Sequential(*layers)


def checkpoint(net: str, arrays: dict[str, Tensor]) -> dict[str, Tensor]:
    state = {}
    for i, (index, _, _) in enumerate(STACKS[net].convs):
        state[f"features.{index}.weight"] = arrays[f"conv{i}_w"]
        state[f"features.{index}.bias"] = arrays[f"conv{i}_b"]
    return state


@torch.no_grad()
def reference_lpips(net: str, arrays: dict[str, Tensor], a: Tensor, b: Tensor) -> float:
    """richzhang/PerceptualSimilarity, lpips.py, written out."""
    features = torchvision_features(net)
    state = {k.removeprefix("features."): v for k, v in checkpoint(net, arrays).items()}
    features.load_state_dict(state)
    taps = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}[net]
    shift = torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[None, :, None, None]
    x, y = ((2 * i.permute(2, 0, 1)[None] - 1 - shift) / scale for i in (a, b))
    total = 0.0
    for index, layer in enumerate(features[: taps[-1] + 1]):
        x, y = layer(x), layer(y)
        if index in taps:
            unit = [f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10) for f in (x, y)]
            weights = arrays[f"lin{taps.index(index)}"][None, :, None, None]
            total += float(((unit[0] - unit[1]).square() * weights).sum(1).mean())
    return total


def images(size: tuple[int, int] = (48, 56)) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    x = torch.rand(*size, 3, generator=generator)
    return x, (x + 0.2 * torch.randn(*size, 3, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize(
    ("net", "size"), [("alex", (48, 56)), ("vgg", (48, 56)), ("alex", (32, 32))]
)
def test_agrees_with_the_reference_layers(net: str, size: tuple[int, int]) -> None:
    arrays = random_arrays(net)
    x, y = images(size)
    ours = Lpips(net, arrays)(x, y)  # type: ignore[arg-type]
    assert float(ours) == pytest.approx(reference_lpips(net, arrays, x, y), rel=1e-4)


def test_map_averages_to_the_distance_and_shows_where() -> None:
    lpips = Lpips("alex", random_arrays("alex"))
    x, _ = images((128, 128))
    y = x.clone()
    y[:32, :32] = 1 - y[:32, :32]
    where = lpips.map(x, y)
    assert where.shape == (128, 128)
    assert float(where.mean()) == pytest.approx(float(lpips(x, y)), rel=0.2)
    assert float(where[:24, :24].mean()) > 4 * float(where[-24:, -24:].mean())


def test_gradients_are_finite_even_for_equal_images() -> None:
    lpips = Lpips("alex", random_arrays("alex"))
    x, y = images()
    image = x.clone().requires_grad_(True)
    lpips(image, y).backward()
    assert image.grad is not None and float(image.grad.abs().sum()) > 0
    image.grad = None
    distance = lpips(image, x)
    distance.backward()
    assert distance.item() == 0.0
    assert image.grad is not None and torch.isfinite(image.grad).all()


def test_black_features_do_not_break_the_gradient() -> None:
    arrays = {k: torch.zeros_like(v) for k, v in random_arrays("alex").items()}
    image = torch.zeros(40, 40, 3, requires_grad=True)
    Lpips("alex", arrays)(image, torch.ones(40, 40, 3)).backward()
    assert image.grad is not None and torch.isfinite(image.grad).all()


def test_small_images_are_grown_by_their_last_rows_and_columns() -> None:
    arrays = random_arrays("alex")
    lpips = Lpips("alex", arrays)
    x, y = images((9, 20))
    rows, columns = torch.arange(32).clamp_max(8), torch.arange(32).clamp_max(19)
    grown = reference_lpips("alex", arrays, x[rows][:, columns], y[rows][:, columns])
    assert float(lpips(x, y)) == pytest.approx(grown, rel=1e-4)
    assert lpips.map(x, y).shape == (9, 20)


class Harmful:
    """What a checkpoint of pickled code does when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return Path.touch, (self.mark,)


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    file, mark = tmp_path / "vgg16.pth", tmp_path / "was run"
    torch.save({"features.0.weight": Harmful(mark)}, file)
    with pytest.raises(HoigsError, match="vgg16"):
        Lpips.load(FoundWeights(str(file), "given", str(file)))
    assert not mark.exists()


def test_shipped_weights_rank_damage() -> None:
    lpips = Lpips.load(find_weights())
    assert "shipped" in lpips.source
    assert lpips.net == "alex"
    ramp = torch.linspace(0, 1, 64)
    target = torch.stack(
        (ramp.expand(64, 64), ramp[:, None].expand(64, 64), ramp.expand(64, 64).flip(1)), -1
    )
    noise = torch.randn(64, 64, 3, generator=torch.Generator().manual_seed(0))
    scores = [float(lpips((target + s * noise).clamp(0, 1), target)) for s in (0, 0.02, 0.1, 0.4)]
    assert scores[0] == 0.0
    assert scores == sorted(scores)
    assert 0.3 < scores[-1] < 2.0  # heavy noise on a smooth image: LPIPS-alex is near 1
    brighter = float(lpips((target * 0.9).clamp(0, 1), target))
    assert brighter < scores[2]  # a dimmer image looks more alike than a noisy one


def test_reasons_when_there_are_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = find_weights(net="vgg")
    assert found.location is None and VARIABLE in found.reason and "vgg16" in found.reason
    with pytest.raises(HoigsError, match="vgg"):
        Lpips.load(found)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "gone.npz"))
    assert "gone.npz" in find_weights().reason
    with pytest.raises(HoigsError, match=r"typo\.npz"):
        find_weights(tmp_path / "typo.npz")


def test_npz_round_trip_and_damage(tmp_path: Path) -> None:
    arrays = random_arrays("vgg")
    file = tmp_path / "vgg.npz"
    np.savez(file, **{k: v.numpy() for k, v in arrays.items()})
    lpips = Lpips.load(find_weights(file))
    x, y = images()
    assert lpips.net == "vgg"
    torch.testing.assert_close(lpips(x, y), Lpips("vgg", arrays)(x, y))
    del arrays["lin2"]
    np.savez(file, **{k: v.numpy() for k, v in arrays.items()})
    with pytest.raises(HoigsError, match="lin2"):
        Lpips.load(find_weights(file))
    file.write_bytes(b"not a zip")
    with pytest.raises(HoigsError, match=r"vgg\.npz"):
        Lpips.load(find_weights(file))


def test_torchvision_cache_with_the_heads_of_the_lpips_package(
    nowhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = random_arrays("vgg")
    torch.save(checkpoint("vgg", arrays), nowhere / "vgg16-397923af.pth")
    if not find_weights(net="vgg").location:  # without the package it says so
        assert "pip install lpips" in find_weights(net="vgg").reason
    package = tmp_path / "site" / "lpips" / "weights" / "v0.1"
    package.mkdir(parents=True)
    (tmp_path / "site" / "lpips" / "__init__.py").touch()
    heads = {f"lin{i}.model.1.weight": arrays[f"lin{i}"][None, :, None, None] for i in range(5)}
    torch.save(heads, package / "vgg.pth")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    found = find_weights(net="vgg")
    assert found.location is not None and "cache" in found.reason
    x, y = images()
    torch.testing.assert_close(Lpips.load(found)(x, y), Lpips("vgg", arrays)(x, y))

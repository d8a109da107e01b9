"""SSIM by Warp kernels against its float64 twin in torch and kornia: values and gradients."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hoigs.core.errors import DerivativeError
from hoigs.metrics.kernels import ssim as function
from hoigs.metrics.kernels import ssim as kernels
from hoigs.metrics.ssim import ssim, ssim_map

NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, NO_CUDA])


@pytest.fixture(params=["cpu", "portable", CUDA])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The CPU's kernel; CUDA's kernels run on the CPU; CUDA."""
    if request.param == "portable":
        from hoigs.metrics.kernels.tiles import TileKernels

        monkeypatch.setattr(function, "_kernels", lambda _: TileKernels())
    return torch.device("cuda" if request.param == "cuda" else "cpu")


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def noisy(*shape: int, seed: int = 7) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(*shape, generator=generator)
    return x, (x + 0.1 * torch.randn(*shape, generator=generator)).clamp(0, 1)


def smooth(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Ramps and waves, as renders have between edges, and the same a little shifted."""
    y, x = torch.meshgrid(torch.arange(height) / 40, torch.arange(width) / 40, indexing="ij")
    waves = torch.stack((torch.sin(3 * x + y), torch.cos(x * y), torch.sin(x) + y / 4), -1)
    return 0.5 + 0.2 * waves, 0.5 + 0.2 * torch.roll(waves, (1, 2), (0, 1)) + 0.01


def masked() -> tuple[Tensor, Tensor]:
    """An entity alone on a plain ground, the render differing only inside its mask."""
    target, render = noisy(60, 50, 3)
    ground = torch.tensor([0.9, 0.1, 0.4])
    mask = torch.zeros(60, 50, 1, dtype=torch.bool)
    mask[20:45, 15:30] = True
    return torch.where(mask, render, ground), torch.where(mask, target, ground)


def twin(image: Tensor, target: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Value and gradient in torch."""
    x = image.detach().clone().to(dtype).requires_grad_()
    value = ssim(x, target.to(dtype))
    return value.detach(), torch.autograd.grad(value, x)[0]


def ours(image: Tensor, target: Tensor, device: torch.device) -> tuple[Tensor, Tensor]:
    """Value and gradient of the kernels."""
    x = image.detach().clone().to(device).requires_grad_()
    value = kernels.mean_ssim(x, target.to(device))
    return value.detach().cpu(), torch.autograd.grad(value, x)[0].cpu()


def distance(actual: Tensor, wanted: Tensor) -> float:
    return float((actual.double() - wanted).norm() / wanted.norm())


def assert_agrees(
    image: Tensor,
    target: Tensor,
    device: torch.device,
    limit: float = 1e-5,
    value_limit: float = 1e-6,
) -> None:
    value, gradient = ours(image, target, device)
    exact, exact_gradient = twin(image, target, torch.float64)
    assert float(value) == pytest.approx(float(exact), abs=value_limit)
    assert distance(gradient, exact_gradient) < limit
    cosine = torch.cosine_similarity(gradient.double().flatten(), exact_gradient.flatten(), dim=0)
    assert float(cosine) > 1 - 1e-7


SHAPES = [
    (1, 1, 1),
    (1, 40, 3),  # one pixel high, narrower than the window
    (40, 1, 3),
    (4, 6, 2),
    (33, 65, 3),  # tiles and vectors cut by the edges
    (3, 24, 40, 3),  # batch
    (2, 2, 13, 12, 1),
    (20, 30, 4),  # more channels than the CPU kernel takes at once
    (12, 9, 7),
    (7, 400, 3),  # several strips
    (300, 260, 3),  # several bands and cores
]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_value_map_and_gradient_are_those_of_the_twin(
    shape: tuple[int, ...], device: torch.device
) -> None:
    image, target = noisy(*shape)
    assert_agrees(image, target, device)
    found = kernels.ssim_map(image.to(device), target.to(device)).cpu()
    torch.testing.assert_close(
        found.double(), ssim_map(image.double(), target.double()), atol=2e-6, rtol=0
    )


def test_masked_and_unlike_images(device: torch.device) -> None:
    assert_agrees(*masked(), device)
    assert_agrees(noisy(40, 40, 3, seed=1)[0], noisy(40, 40, 3, seed=2)[0], device)


GREY, BLACK = torch.full((40, 50, 3), 0.5), torch.zeros(40, 50, 3)
PLAIN = {
    "smooth": smooth(70, 90),
    "black render": (BLACK, smooth(40, 50)[0]),
    "black target": (noisy(40, 50, 3)[0], BLACK),
    "flat": (GREY, GREY - 0.3),
    "flat and near": (GREY, GREY - 0.01),
    "white and black": (BLACK + 1, BLACK),
}


@pytest.mark.parametrize("name", PLAIN)
def test_plain_images_lose_little(name: str, device: torch.device) -> None:
    """Without texture float32 loses digits in E[x^2] - E[x]^2; the twin in float32 loses as many.

    That is 1e-5 to 1e-3 of the gradient and 1e-5 of the value, in either. Where images are nearly
    alike, the kernels' sums and differences keep ten times more.
    """
    image, target = PLAIN[name]
    lost = distance(twin(image, target, torch.float32)[1], twin(image, target, torch.float64)[1])
    limit = {"smooth": 0.5, "flat and near": 0.2}.get(name, 2.0) * lost
    assert_agrees(image, target, device, max(2e-5, limit), value_limit=3e-5)


def test_equal_images_score_one_and_have_no_gradient(device: torch.device) -> None:
    for image in (noisy(30, 40, 3)[0], torch.zeros(30, 40, 3), torch.ones(30, 40, 3)):
        value, gradient = ours(image, image.clone(), device)
        assert float(value) == pytest.approx(1.0, abs=1e-6)
        assert float(gradient.abs().max()) < 1e-9


def test_kornia_agrees_away_from_the_border(device: torch.device) -> None:
    from kornia.metrics import ssim as kornia_ssim

    image, target = noisy(48, 60, 3)
    x = image.double().requires_grad_()
    planes = (x.permute(2, 0, 1)[None], target.double().permute(2, 0, 1)[None])
    theirs = kornia_ssim(*planes, 11, eps=0.0, padding="valid")  # 5 pixels less on each side
    theirs.sum().backward()
    found = kernels.ssim_map(image.to(device), target.to(device)).cpu()[5:-5, 5:-5]
    torch.testing.assert_close(
        found.double(), theirs[0].permute(1, 2, 0).detach(), atol=2e-6, rtol=0
    )
    gradient = ours(image, target, device)[1] * image.numel()
    inner = (slice(10, -10), slice(10, -10))  # pixels that no window at the border sees
    assert x.grad is not None
    error = (gradient.double() - x.grad)[inner].norm() / x.grad[inner].norm()
    assert float(error) < 1e-5


def test_strided_images(device: torch.device) -> None:
    image, target = noisy(30, 44, 6)
    assert_agrees(image.transpose(0, 1)[..., ::2], target.transpose(0, 1)[..., ::2], device)
    rgba, other = noisy(4, 20, 25)
    assert_agrees(rgba.permute(1, 2, 0)[..., :3], other.permute(1, 2, 0)[..., :3], device)


def test_it_takes_its_place_in_a_larger_loss(device: torch.device) -> None:
    image, target = noisy(24, 30, 3)
    found = []
    for dtype, backend in ((torch.float32, "warp"), (torch.float64, "torch")):
        x = image.clone().to(device, dtype).requires_grad_()
        y = target.to(device, dtype)
        loss = 0.8 * (x - y).abs().mean() + 0.2 * (1 - ssim(x.sigmoid(), y, backend))
        loss.backward()
        assert x.grad is not None
        found.append(x.grad.double())
    assert distance(found[0], found[1]) < 1e-5


def test_twice_run_is_bitwise_equal(device: torch.device) -> None:
    image, target = noisy(150, 170, 3)
    first, second = ours(image, target, device), ours(image, target, device)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


@pytest.mark.usefixtures("threads")
def test_cores_do_not_change_a_bit() -> None:
    image, target = noisy(330, 260, 3)
    torch.set_num_threads(1)
    wanted = ours(image, target, torch.device("cpu"))
    for count in (2, 3, 5):
        torch.set_num_threads(count)
        found = ours(image, target, torch.device("cpu"))
        assert torch.equal(found[0], wanted[0])
        assert torch.equal(found[1], wanted[1])


def test_a_broken_pixel_reaches_its_windows_and_no_further(device: torch.device) -> None:
    image, target = noisy(40, 50, 3)
    image[20, 25, 1] = float("nan")
    found = kernels.ssim_map(image.to(device), target.to(device)).cpu()
    broken = torch.zeros(40, 50, 3, dtype=torch.bool)
    broken[15:26, 20:31, 1] = True
    assert torch.equal(found.isnan(), broken)


def test_backward_twice_and_without_graph(device: torch.device) -> None:
    image, target = (x.to(device) for x in noisy(20, 30, 3))
    x = image.clone().requires_grad_()
    loss = kernels.mean_ssim(x, target)
    once = torch.autograd.grad(loss, x, retain_graph=True)[0]
    assert torch.equal(once, torch.autograd.grad(loss, x)[0])
    with torch.no_grad():
        assert torch.equal(kernels.mean_ssim(x, target), loss.detach())
        assert not kernels.mean_ssim(x, target).requires_grad
    x = image.clone().requires_grad_()
    loss = kernels.mean_ssim(x, target) * x.sum()
    gradient = torch.autograd.grad(loss, x, create_graph=True)[0]
    with pytest.raises(DerivativeError, match="SSIM"):
        gradient.sum().backward()


def test_what_it_cannot_do_it_refuses(device: torch.device) -> None:
    x, y = (z.to(device) for z in noisy(12, 14, 3))
    with pytest.raises(ValueError, match=r"float64.*backend=\"torch\""):
        ssim(x.double(), y.double(), backend="warp")
    with pytest.raises(ValueError, match=r"target requires a gradient.*detach"):
        ssim(x, y.requires_grad_(), backend="warp")
    y = y.detach()
    with pytest.raises(ValueError, match=r"not its map"):
        kernels.ssim_map(x.clone().requires_grad_(), y)
    with pytest.raises(ValueError, match=r"at least one pixel"):
        kernels.mean_ssim(x[:0], y[:0])
    with pytest.raises(ValueError, match=r"\(12, 14, 3\), target \(5, 14, 3\).*equal"):
        kernels.mean_ssim(x, y[:5])
    with pytest.raises(ValueError, match="backend is 'kornia'"):
        ssim(x, y, backend="kornia")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"on meta"):
        kernels.mean_ssim(x.to("meta"), y.to("meta"))


def test_importing_is_light() -> None:
    code = """
import sys
import hoigs.metrics.ssim, hoigs.metrics.kernels.ssim
assert "warp" not in sys.modules
"""
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, check=False)
    assert done.returncode == 0


def test_where_the_cpu_kernel_does_not_compile_others_say_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from hoigs.metrics.kernels import strips, tiles

    def fail(*arguments: object) -> Tensor:
        raise Exception("CPU kernel build failed with error code -1")

    with monkeypatch.context() as broken:
        broken.setattr(strips, "_run", fail)
        with pytest.warns(UserWarning, match=r"build failed.*slower.*train\.loss\.ssim: torch"):
            found = function._cpu_kernels()
    assert isinstance(found, tiles.TileKernels)
    assert isinstance(function._cpu_kernels(), strips.StripKernels)


@pytest.mark.slow
def test_the_cpu_kernel_runs_without_avx512(tmp_path: Path) -> None:
    """The same figures from the kernel compiled for a processor with AVX2."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("processors of another family")
    code = f"""
import sys, torch, warp
warp.config.cpu_compiler_flags = "-target-cpu haswell"
warp.config.kernel_cache_dir = {str(tmp_path)!r}
sys.path.insert(0, "tests/metrics")
from test_warp_ssim import assert_agrees, noisy
for shape in ((300, 260, 3), (7, 400, 3), (2, 33, 65, 1)):
    assert_agrees(*noisy(*shape), torch.device("cpu"))
"""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-W", "error::UserWarning", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_kernels_compile_for_cuda(tmp_path: Path) -> None:
    """No GPU is needed to compile; to run them see the tests on "cuda"."""
    from hoigs.core.system.quiet_warp import wp
    from hoigs.metrics.kernels import tiles as tile_kernels

    wp.compile_aot_module(tile_kernels, arch=80, module_dir=str(tmp_path))
    assert list(tmp_path.glob("*.cubin")) or list(tmp_path.glob("*.ptx"))


@pytest.mark.gpu
@NO_CUDA
def test_cuda_follows_the_current_stream_and_never_waits() -> None:
    image, target = (x.to("cuda") for x in noisy(300, 400, 3))
    x = image.clone().requires_grad_()
    wanted = torch.autograd.grad(kernels.mean_ssim(x, target), x)[0]
    torch.cuda.synchronize()
    side = torch.cuda.Stream()
    torch.cuda.set_sync_debug_mode("error")
    try:
        with torch.cuda.stream(side):
            late = torch.zeros_like(image)
            torch.cuda._sleep(50_000_000)  # whoever works on another stream reads zeros
            late.copy_(image)
            late.requires_grad_()
            found = torch.autograd.grad(kernels.mean_ssim(late, target), late)[0]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    torch.cuda.synchronize()
    assert torch.equal(found, wanted)

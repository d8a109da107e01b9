"""What is particular to the Warp backend; what it shares is in the conformance tests."""

from __future__ import annotations

import copy
import gc
import pickle
import platform
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import pytest
import torch
from raster_scenes import (
    CUT,
    RAW,
    a_camera,
    assert_close_gradient,
    assert_same_picture,
    clear_of_cutoffs,
    forged,
    front_camera,
    images,
    random_scene,
)
from torch import Tensor

from hoigs.core.errors import DerivativeError, RenderError
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.rasterizers.warp import WarpConfig, WarpRasterizer


def gradients(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    camera: Camera,
    request: RenderRequest | None = None,
) -> dict[str, Tensor]:
    """Gradients of a fixed random weighting of every image, by raw field and by pose."""
    leaves = gaussians.map(lambda x: x.clone().requires_grad_())
    view = camera.world_to_camera.clone().requires_grad_()
    output = rasterizer.render(leaves, forged(camera, world_to_camera=view), request)
    generator = torch.Generator().manual_seed(1)
    loss = torch.zeros((), dtype=output.color.dtype)
    for image in images(output).values():
        loss = loss + (image * torch.randn(image.shape, generator=generator)).sum()
    loss.backward()
    found = {name: getattr(leaves, name).grad for name in RAW}
    return {**found, "pose": view.grad}


def test_schedulers_and_threads_agree_bit_for_bit() -> None:
    scene, camera = random_scene(2500), a_camera(150, 90)  # enough for several chunks and tiles
    request = RenderRequest(features=torch.randn(2500, 3))
    first = WarpRasterizer(WarpConfig(scheduler="serial", threads=1))
    picture, gradient = first.render(scene, camera, request), gradients(first, scene, camera)
    for scheduler, threads in (("threads", 2), ("threads", 5), ("auto", 2), ("auto", 3)):
        other = WarpRasterizer(WarpConfig(scheduler=scheduler, threads=threads))
        for name, image in images(other.render(scene, camera, request)).items():
            assert torch.equal(image, images(picture)[name]), (scheduler, threads, name)
        for name, value in gradients(other, scene, camera).items():
            assert torch.equal(value, gradient[name]), (scheduler, threads, name)


def test_native_and_portable_kernels_agree() -> None:
    torch.manual_seed(0)
    scene, camera = random_scene(800), a_camera(131, 77)
    request = RenderRequest(features=torch.randn(800, 5), background=torch.rand(77, 131, 3))
    clear = clear_of_cutoffs(scene, camera, request)
    pictures = [
        images(WarpRasterizer(WarpConfig(cpu_kernels=kernels)).render(scene, camera, request))
        for kernels in ("native", "portable")
    ]
    for name, image in pictures[0].items():
        torch.testing.assert_close(image[clear], pictures[1][name][clear], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("channels", [15, 16, 17, 33])
def test_features_beyond_one_pass(channels: int) -> None:
    scene, camera = random_scene(60), a_camera()
    torch.manual_seed(0)
    values = torch.randn(60, channels)
    request = RenderRequest(features=values)
    clear = clear_of_cutoffs(scene, camera, request)
    assert_same_picture(
        WarpRasterizer().render(scene, camera, request), CUT.render(scene, camera, request), clear
    )
    weights = torch.randn(*clear.shape, channels) * clear[..., None]
    for absolute in (False, True):
        found = []
        for rasterizer in (WarpRasterizer(), CUT):
            leaves = [values, scene.means] + [torch.zeros(60, 2)] * absolute
            leaves = [x.clone().requires_grad_() for x in leaves]
            fields = {"features": leaves[0]} | (
                {"absolute_gradients": leaves[2]} if absolute else {}
            )
            output = rasterizer.render(
                scene.replace(means=leaves[1]), camera, request.replace(**fields)
            )
            assert output.features is not None
            ((output.features * weights).sum() + output.color[clear].sum()).backward()
            found.append([x.grad for x in leaves])
        for name, actual, wanted in zip(("features", "means", "absolute_gradients"), *found):
            assert wanted is not None
            assert_close_gradient(name, actual, wanted)


@pytest.mark.parametrize("kernels", ["native", "portable"])
def test_needles_lose_no_precision(kernels: str) -> None:
    """Splats hundreds of times longer than wide: conics in float32 would cancel."""
    scene = random_scene(200)
    scales = torch.tensor([0.5, 0.002, 0.002]).log().expand(200, 3)
    scene, camera = scene.replace(log_scales=scales), a_camera(90, 70)
    smooth = RenderRequest(min_alpha=0.0, min_transmittance=0.0, low_pass=0.05)
    wanted = gradients(OracleRasterizer(), scene, camera, smooth)
    actual = gradients(WarpRasterizer(WarpConfig(cpu_kernels=kernels)), scene, camera, smooth)
    for name in wanted:
        assert_close_gradient(name, actual[name], wanted[name])


def test_splats_larger_than_tiles_lose_no_precision() -> None:
    """Down the columns of large splats alpha is multiplied along, 64 rows and more."""
    scene = random_scene(60)
    scene, camera = scene.replace(log_scales=scene.log_scales + 1.2), a_camera(150, 150)
    smooth = RenderRequest(min_alpha=0.0, min_transmittance=0.0)
    wanted = gradients(OracleRasterizer(), scene, camera, smooth)
    actual = gradients(WarpRasterizer(), scene, camera, smooth)
    for name, value in wanted.items():
        assert (actual[name] - value).norm() < 1e-5 * value.norm(), name


@pytest.mark.parametrize("size", [(1, 1), (1, 200), (200, 1), (16, 64), (17, 65), (300, 140)])
def test_tiles_cover_images_of_any_size(size: tuple[int, int]) -> None:
    scene = random_scene(150)
    camera = a_camera(*size)
    clear = clear_of_cutoffs(scene, camera, RenderRequest())
    assert_same_picture(WarpRasterizer().render(scene, camera), CUT.render(scene, camera), clear)


def test_an_image_beyond_32_bits_is_refused() -> None:
    with pytest.raises(RenderError, match=r"50000x50000 pixels .*Camera\.cropped"):
        WarpRasterizer().render(random_scene(2), front_camera(50_000, 50_000))


def test_threads_of_the_caller_do_not_disturb_each_other() -> None:
    rasterizer = WarpRasterizer(WarpConfig(scheduler="threads", threads=2))
    scenes = [random_scene(1500, seed=seed) for seed in range(4)]
    camera = a_camera(120, 80)
    alone = [gradients(rasterizer, scene, camera) for scene in scenes]
    together: dict[int, list[dict[str, Tensor]]] = {}

    def work(index: int) -> None:
        together[index] = [gradients(rasterizer, scenes[index], camera) for _ in range(5)]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for index, results in together.items():
        for result in results:
            for name, value in result.items():
                assert torch.equal(value, alone[index][name]), (index, name)


def test_renders_share_no_memory_and_keep_none() -> None:
    rasterizer, camera = WarpRasterizer(), a_camera()
    scene = random_scene().map(lambda x: x.requires_grad_())
    first = rasterizer.render(scene, camera)
    kept = {name: image.detach().clone() for name, image in images(first).items()}
    rasterizer.render(scene.map(lambda x: x.detach() + 0.1), camera)
    for name, image in images(first).items():
        assert torch.equal(image, kept[name])
    gone = [weakref.ref(image) for image in images(first).values()]
    first.color.sum().backward()
    del first, image
    gc.collect()
    assert all(reference() is None for reference in gone)


def test_backward_may_run_twice() -> None:
    scene = random_scene().map(lambda x: x.requires_grad_())
    loss = WarpRasterizer().render(scene, a_camera()).color.square().sum()
    once = torch.autograd.grad(loss, scene.means, retain_graph=True)[0]
    assert torch.equal(once, torch.autograd.grad(loss, scene.means)[0])


def test_copies_carry_the_settings() -> None:
    rasterizer = WarpRasterizer(WarpConfig(scheduler="auto", threads=1))
    before = rasterizer.render(random_scene(20), a_camera())
    for copied in (copy.deepcopy(rasterizer), pickle.loads(pickle.dumps(rasterizer))):
        assert copied.config == rasterizer.config
        assert torch.equal(copied.render(random_scene(20), a_camera()).color, before.color)


def test_capture_needs_cuda() -> None:
    with pytest.raises(RenderError, match="are on cpu, expected a CUDA device"):
        WarpRasterizer().capture(random_scene(5), a_camera())


def test_cached_validation_misses_no_change() -> None:
    """Inputs that passed are cached by shapes, types and numbers; each of these must count."""
    rasterizer, scene, camera = WarpRasterizer(), random_scene(5), a_camera()
    rasterizer.render(scene, camera)
    for wrong in (
        (forged(scene, quats=scene.quats[:4]), camera, RenderRequest()),
        (forged(scene, quats=scene.quats.double()), camera, RenderRequest()),
        (scene, forged(camera, K=camera.K[:2]), RenderRequest()),
        (scene, forged(camera, width=0), RenderRequest()),
        (scene, camera, RenderRequest(near=-1.0)),
        (scene, camera, RenderRequest(features=torch.zeros(6, 2))),
    ):
        with pytest.raises(RenderError):
            rasterizer.render(*wrong)


def test_report_names_what_runs() -> None:
    report = WarpRasterizer(WarpConfig(scheduler="threads")).backend_report()
    assert report["scheduler"] == "threads"
    assert report["cpu_kernels"] == "native"
    assert "vectors of" in report["cpu_kernels_reason"]
    assert report["warp"]


def test_without_openmp_threads_are_used_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    from hoigs.rasterizers.warp.cpu import workers

    def fail(self: object) -> None:
        raise OSError("no libgomp in sight")

    monkeypatch.setattr(workers.OpenMPWorkers, "__init__", fail)
    report = WarpRasterizer(WarpConfig(scheduler="auto")).backend_report()
    assert report["scheduler"] == "threads"
    assert "no libgomp in sight" in report["scheduler_reason"]
    with pytest.raises(RenderError, match=r"no libgomp in sight.*threads"):
        WarpRasterizer(WarpConfig(scheduler="openmp")).backend_report()


def test_where_native_kernels_do_not_compile_portable_ones_run_with_a_warning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from hoigs.rasterizers.warp.cpu import workers as choose

    def fail() -> int:
        raise Exception("CPU kernel build failed with error code -1")

    monkeypatch.setattr(choose, "vector_lanes", fail)
    rasterizer = WarpRasterizer()
    with pytest.warns(UserWarning, match="build failed.*portable"):
        report = rasterizer.backend_report()
    assert report["cpu_kernels"] == "portable"
    assert "build failed" in report["cpu_kernels_reason"]
    with pytest.raises(RenderError, match=r"build failed.*cpu_kernels=\"portable\""):
        WarpRasterizer(WarpConfig(cpu_kernels="native")).backend_report()


@pytest.mark.slow
@pytest.mark.parametrize(("processor", "lanes"), [("haswell", 8), ("x86-64", 8)])
def test_native_kernels_run_without_avx512(processor: str, lanes: int, tmp_path: Path) -> None:
    """The same picture and gradients from kernels compiled for older processors."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("processors of another family")
    code = f"""
import sys, torch, warp
warp.config.cpu_compiler_flags = "-target-cpu {processor}"
warp.config.kernel_cache_dir = {str(tmp_path)!r}
sys.path.insert(0, "tests/rasterizers")
from raster_scenes import a_camera, random_scene
from hoigs.rasterizers.warp import WarpRasterizer
rasterizer = WarpRasterizer()
scene = random_scene(700).map(lambda x: x.requires_grad_())
output = rasterizer.render(scene, a_camera(150, 90))
(output.color.square().sum() + output.depth.sum()).backward()
print(rasterizer.backend_report()["cpu_kernels_reason"])
torch.save((output.color.detach(), scene.means.grad), {str(tmp_path / "found.pt")!r})
"""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    assert done.returncode == 0, done.stderr
    assert f"vectors of {lanes} floats" in done.stdout
    color, gradient = torch.load(tmp_path / "found.pt", weights_only=True)
    scene = random_scene(700).map(lambda x: x.requires_grad_())
    output = WarpRasterizer().render(scene, a_camera(150, 90))
    (output.color.square().sum() + output.depth.sum()).backward()
    clear = clear_of_cutoffs(scene.detach(), a_camera(150, 90), RenderRequest())
    torch.testing.assert_close(color[clear], output.color.detach()[clear], atol=1e-5, rtol=0)
    assert scene.means.grad is not None
    assert (gradient - scene.means.grad).norm() < 1e-3 * gradient.norm()  # cut-offs included


def test_threads_must_be_positive() -> None:
    with pytest.raises(ValueError, match="threads"):
        WarpConfig(threads=0)


def test_importing_is_light_and_rendering_is_quiet() -> None:
    code = """
import sys
from hoigs.rasterizers.warp import WarpRasterizer
rasterizer = WarpRasterizer()
assert "warp" not in sys.modules, "constructing it loaded Warp"
sys.path.insert(0, "tests/rasterizers")
from raster_scenes import a_camera, random_scene
rasterizer.render(random_scene(10), a_camera())
"""
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "project.kernels",
        "project.optics",
        "project.spherical_harmonics_adjoint",
        "intersect.cuda_kernels",
        "blend.pixel_kernels",
        "blend.absolute_kernels",
        "blend.gather_kernels",
    ],
)
def test_kernels_compile_for_cuda(name: str, tmp_path: Path) -> None:
    """No GPU is needed to compile; to run them see the conformance tests on "cuda"."""
    import importlib

    from hoigs.core.system.quiet_warp import wp

    module = importlib.import_module(f"hoigs.rasterizers.warp.{name}")
    wp.compile_aot_module(module, arch=80, module_dir=str(tmp_path))
    assert list(tmp_path.glob("*.cubin")) or list(tmp_path.glob("*.ptx"))


def test_no_render_keeps_an_autograd_graph_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Density control gives a parameter more rows: a graph of the old size must be gone by then."""
    from hoigs.core.fast import launch as cpu_launch

    monkeypatch.setattr(cpu_launch, "_launches", {})  # as in a process that has drawn nothing yet
    means = torch.nn.Parameter(random_scene(8).means)
    for count in (8, 20):
        scene = random_scene(count)
        means.data, means.grad = scene.means, None
        WarpRasterizer().render(scene.replace(means=means), a_camera()).color.sum().backward()
        assert means.grad is not None and len(means.grad) == count


def test_second_derivatives_are_refused(device: torch.device) -> None:
    scene = random_scene(20).to(device).map(lambda x: x.requires_grad_())
    color = WarpRasterizer().render(scene, a_camera().to(device)).color
    (slope,) = torch.autograd.grad(color.sum(), scene.means, create_graph=True)
    penalty = slope.square().sum()
    for ask in (
        lambda: penalty.backward(retain_graph=True),
        lambda: torch.autograd.grad(penalty, scene.quats, allow_unused=True),
    ):
        with pytest.raises(DerivativeError, match=r"WarpRasterizer.*rasterizer:torch"):
            ask()

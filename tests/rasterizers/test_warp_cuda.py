"""What is particular to Warp on CUDA: no waiting, one shared list, captured graphs."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from raster_scenes import RAW, a_camera, assert_close_gradient, forged, images, random_scene
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.optics import Optics
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.warp import WarpRasterizer
from hoigs.rasterizers.warp.cuda import intersections
from hoigs.rasterizers.warp.frame import Images, Inputs, TileIntersections
from hoigs.testing.rasterizer.subject import on, require_close_gradient

CUDA = torch.device("cuda", 0)
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def scene(count: int = 3000, width: int = 150, height: int = 90) -> tuple[Gaussians, Camera]:
    return random_scene(count).to(CUDA), a_camera(width, height).to(CUDA)


def drawn(
    rasterizer: WarpRasterizer, gaussians: Gaussians, camera: Camera, request: RenderRequest
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Images, and gradients of a fixed random weighting of them.

    Those by `screen_offsets` and `absolute_gradients` are included where the request has them.
    """
    fields = {
        name: torch.zeros_like(x).requires_grad_()
        for name in ("screen_offsets", "absolute_gradients")
        if (x := getattr(request, name)) is not None
    }
    request = request.replace(**fields)
    leaves = gaussians.map(lambda x: x.detach().clone().requires_grad_())
    output = images(rasterizer.render(leaves, camera, request))
    generator = torch.Generator().manual_seed(1)
    device = gaussians.means.device
    loss = torch.zeros((), device=device)
    for image in output.values():
        loss = loss + (image * torch.randn(image.shape, generator=generator).to(device)).sum()
    loss.backward()
    return (
        {name: image.detach() for name, image in output.items()},
        {name: getattr(leaves, name).grad for name in RAW}
        | {name: x.grad for name, x in fields.items()},
    )


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("channels", [0, 6])
def test_where_intersections_do_not_fit_the_picture_is_the_same(
    channels: int, absolute: bool
) -> None:
    gaussians, camera = scene()
    request = RenderRequest(
        features=torch.randn(3000, channels, device=CUDA) if channels else None,
        absolute_gradients=torch.zeros(3000, 2, device=CUDA) if absolute else None,
    )
    roomy, tight = WarpRasterizer(), WarpRasterizer()
    wanted = drawn(roomy, gaussians, camera, request)
    capacity = tight.pipeline(CUDA).capacity
    capacity.counted(3000, 10**6, 0)  # as if only empty views had been drawn
    capacity._capacity = 3000
    actual = drawn(tight, gaussians, camera, request)
    torch.cuda.synchronize()
    assert int(capacity.largest_on_host[0]) > 3000, "the intersections fit: this tests nothing"
    for name, image in wanted[0].items():
        assert torch.equal(actual[0][name], image), name
    for name, gradient in wanted[1].items():
        assert_close_gradient(name, actual[1][name], gradient)
    again = drawn(tight, gaussians, camera, request)  # there is memory now
    assert all(torch.equal(again[1][name], wanted[1][name]) for name in wanted[1])


@pytest.mark.parametrize("channels", [0, 6])
def test_absolute_gradients_are_those_of_the_cpu(channels: int) -> None:
    """Beside the signed ones, in tiles with long lists, where some pixels have stopped."""
    gaussians, camera = scene()
    request = RenderRequest(
        features=torch.randn(3000, channels, device=CUDA) if channels else None,
        screen_offsets=torch.zeros(3000, 2, device=CUDA),
        absolute_gradients=torch.zeros(3000, 2, device=CUDA),
        min_transmittance=0.0,
        min_alpha=0.0,  # no cut-offs, where the two may differ by a splat
    )
    rasterizer = WarpRasterizer()
    _, found = drawn(rasterizer, gaussians, camera, request)
    plain = request.replace(absolute_gradients=None)
    for name, gradient in drawn(rasterizer, gaussians, camera, plain)[1].items():
        assert_close_gradient(name, found[name], gradient)
    assert (found["absolute_gradients"] >= found["screen_offsets"].abs() * 0.999 - 1e-3).all()
    cpu = torch.device("cpu")
    _, wanted = drawn(rasterizer, *(on(cpu, x) for x in (gaussians, camera, request)))
    for name, gradient in wanted.items():
        assert_close_gradient(name, found[name].cpu(), gradient)


@pytest.mark.parametrize("channels", [0, 6])
def test_what_is_hidden_has_no_gradient_whatever_the_memory_held(channels: int) -> None:
    """Few tiles, dozens and hundreds of them under a Gaussian, behind pixels that have stopped."""
    gaussians, camera = scene(6000, 640, 480)
    larger = 5 * torch.linspace(0, 1, 6000, device=CUDA) ** 20 - 2.5  # some cover the picture
    gaussians = gaussians.replace(
        log_scales=gaussians.log_scales + larger[:, None],
        opacity_logits=gaussians.opacity_logits.abs() + 2,
    )
    features = torch.randn(6000, channels, device=CUDA) if channels else None
    rasterizer, request = WarpRasterizer(), RenderRequest(features=features)
    wanted = drawn(rasterizer, gaussians, camera, request)[1]
    nothing = torch.full((100_000_000,), float("nan"), device=CUDA)
    del nothing  # the next render gets this memory
    found = drawn(rasterizer, gaussians, camera, request)[1]
    for name in RAW:
        assert torch.equal(found[name], wanted[name]), name
    hidden = (wanted["means"] == 0).all(-1)
    assert 0.3 < hidden.float().mean() < 0.95
    on_cpu = (on(torch.device("cpu"), x) for x in (gaussians, camera, request))
    for name, gradient in drawn(rasterizer, *on_cpu)[1].items():
        require_close_gradient(name, found[name].cpu(), gradient, 1e-3)  # cut-offs: a splat or so


@pytest.mark.parametrize("depths", ["all different", "two alike", "all alike"])
def test_long_lists_are_in_order(depths: str) -> None:
    """Thousands of splats in one tile, all drawn: sorted in chunks, whatever their depths."""
    gaussians, camera = scene(20_000, 20, 20)
    means = gaussians.means.clone()
    if depths == "two alike":
        means[::2] = means[1::2]
    elif depths == "all alike":
        toward = camera.world_to_camera[2, :3]
        means -= (means @ toward - means[0] @ toward)[:, None] * toward
    faint = gaussians.replace(means=means, opacity_logits=gaussians.opacity_logits * 0.0 - 4.0)
    tiles, drawn_depths, _ = blended(faint, camera, RenderRequest(min_transmittance=0.0))
    offsets, shared = tiles.offsets[: tiles.tiles + 1].tolist(), tiles.offsets[tiles.tiles + 1]
    assert shared == -1
    assert max(b - a for a, b in pairwise(offsets)) > 5000
    assert tiles.offsets[2 * tiles.tiles + 2 :][: tiles.tiles].tolist() == offsets[1:]
    partials = []
    for begin, end in pairwise(offsets):
        rows, here = tiles.indices[begin:end].long().unbind(1)
        keys = drawn_depths[rows].view(torch.int32).long() << 32 | rows
        assert (keys[1:] > keys[:-1]).all()
        assert (here >= tiles.first_partial[rows]).all()
        assert (here < tiles.first_partial[rows] + tiles.tiles_per_gaussian[rows]).all()
        partials.append(here)
    assert torch.equal(torch.cat(partials).sort().values, torch.arange(offsets[-1], device=CUDA))


def test_what_is_hidden_is_not_sorted_and_what_is_drawn_is_in_order() -> None:
    gaussians, camera = scene(20_000, 60, 40)
    opaque = gaussians.replace(opacity_logits=gaussians.opacity_logits.abs() + 1)
    some, _, images = blended(opaque, camera, RenderRequest())
    every, _, _ = blended(opaque, camera, RenderRequest(min_transmittance=0.0))
    read = 0
    for tile in range(some.tiles):
        begin, end = some.offsets[tile], some.offsets[2 * some.tiles + 2 + tile]
        assert torch.equal(some.indices[begin:end, 0], every.indices[begin:end, 0])
        read += int(end - begin)
    assert read < 0.5 * int(some.offsets[some.tiles])
    assert images.alpha.mean() > 0.99


def blended(
    gaussians: Gaussians, camera: Camera, request: RenderRequest
) -> tuple[TileIntersections, Tensor, Images]:
    """Intersections as far as they were drawn, depths and images, from the stages of a render."""
    rasterizer = WarpRasterizer()
    settings, tensors = rasterizer.inputs.prepare(gaussians, camera, request)
    pipeline, inputs = rasterizer.pipeline(CUDA), Inputs(*tensors)
    projected = pipeline.project(inputs, settings)
    tiles = pipeline.intersect(projected, settings)
    return tiles, projected.drawn_depths, pipeline.blend(inputs, settings, projected.records, tiles)


@pytest.mark.parametrize("opacity", [-4.0, 0.0, 4.0])
@pytest.mark.parametrize("channels", [0, 6])
def test_the_nearest_before_the_others_draw_the_same(
    opacity: float, channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the nearest leave all tiles open, some, and few."""
    gaussians, camera = scene(6000)
    gaussians = gaussians.replace(opacity_logits=gaussians.opacity_logits + opacity)
    features = torch.randn(6000, channels, device=CUDA) if channels else None
    request = RenderRequest(features=features, absolute_gradients=torch.zeros(6000, 2, device=CUDA))
    wanted = drawn(WarpRasterizer(), gaussians, camera, request)
    in_two_parts(monkeypatch)
    rasterizer = WarpRasterizer()
    capacity = rasterizer.pipeline(CUDA).capacity
    for time in ("first", "second", "without memory", "with some", "with all"):
        if time == "without memory":
            needed = int(capacity.largest[0])
            capacity._capacity = 6000
            capacity._largest[0] = capacity.largest[0] = 0
        actual = drawn(rasterizer, gaussians, camera, request)
        torch.cuda.synchronize()
        for name, image in wanted[0].items():
            assert torch.equal(actual[0][name], image), (time, name)
        for name, gradient in wanted[1].items():
            assert_close_gradient(name, actual[1][name], gradient)
        if time == "first":
            first = actual
        elif time in ("second", "with all"):
            assert all(torch.equal(actual[1][name], first[1][name]) for name in first[1]), time
    assert int(capacity.largest[0]) == needed > 6000, "the intersections fit: this tests nothing"


def in_two_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(intersections, "MANY", 0)
    monkeypatch.setattr(intersections, "DENSE", 0)


def test_the_nearest_before_the_others_can_be_captured(monkeypatch: pytest.MonkeyPatch) -> None:
    in_two_parts(monkeypatch)
    gaussians, camera = scene(20_000, 300, 200)
    opaque = gaussians.replace(opacity_logits=gaussians.opacity_logits + 4.0)
    rasterizer = WarpRasterizer()
    draw = rasterizer.capture(opaque, camera)
    assert torch.equal(draw().color, rasterizer.render(opaque, camera).color)
    wanted = rasterizer.render(gaussians, camera).color
    for _ in range(2):  # more intersections than there was memory, then captured again
        assert torch.equal(draw(gaussians=gaussians).color, wanted)
        torch.cuda.synchronize()


@pytest.mark.parametrize("absolute", [False, True])
def test_a_steady_step_waits_for_nothing(absolute: bool) -> None:
    gaussians, camera = scene()
    rasterizer = WarpRasterizer()

    def step() -> Tensor:
        leaves = gaussians.map(lambda x: x.detach().requires_grad_())
        absolutes = torch.zeros(3000, 2, device=CUDA, requires_grad=True) if absolute else None
        output = rasterizer.render(leaves, camera, RenderRequest(absolute_gradients=absolutes))
        output.color.backward(torch.ones_like(output.color))
        assert leaves.means.grad is not None
        return leaves.means.grad if absolutes is None else absolutes.grad

    wanted = step()
    torch.cuda.set_sync_debug_mode("error")
    try:
        actual = step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(actual, wanted)


@pytest.mark.parametrize("absolute", [False, True])
def test_a_whole_step_can_be_captured(absolute: bool) -> None:
    gaussians, camera = scene()
    rasterizer = WarpRasterizer()

    def asking() -> RenderRequest:
        zeros = torch.zeros(3000, 2, device=CUDA, requires_grad=True)
        return RenderRequest(absolute_gradients=zeros if absolute else None)

    leaves = gaussians.map(lambda x: x.detach().clone().requires_grad_())
    graph, request = torch.cuda.CUDAGraph(), asking()
    with pytest.raises(RenderError, match="once before the capture"), torch.cuda.graph(graph):
        rasterizer.render(leaves, camera, request)
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        rasterizer.render(leaves, camera, request).color.sum().backward()
        leaves, request = leaves.map(lambda x: x.detach().requires_grad_()), asking()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=side):
        rasterizer.render(leaves, camera, request).color.sum().backward()
    with torch.no_grad():
        leaves.means.add_(0.05)
    graph.replay()
    wanted, wanted_request = leaves.map(lambda x: x.detach().clone().requires_grad_()), asking()
    rasterizer.render(wanted, camera, wanted_request).color.sum().backward()
    for name in RAW:
        assert torch.equal(getattr(leaves, name).grad, getattr(wanted, name).grad), name
    if absolute:
        assert request.absolute_gradients.grad.any()
        assert torch.equal(request.absolute_gradients.grad, wanted_request.absolute_gradients.grad)


def test_streams_do_not_disturb_each_other() -> None:
    rasterizer = WarpRasterizer()
    scenes = [random_scene(3000, seed=seed).to(CUDA) for seed in range(3)]
    camera = a_camera(150, 90).to(CUDA)
    alone = [rasterizer.render(x, camera).color for x in scenes]
    streams = [torch.cuda.Stream() for _ in scenes]
    torch.cuda.synchronize()
    for _ in range(10):
        together = []
        for gaussians, stream in zip(scenes, streams):
            with torch.cuda.stream(stream):
                together.append(rasterizer.render(gaussians, camera).color)
        torch.cuda.synchronize()
        assert all(torch.equal(a, b) for a, b in zip(together, alone))


def test_a_captured_render_follows_its_inputs() -> None:
    gaussians, camera = scene()
    rasterizer = WarpRasterizer()
    features = torch.randn(3000, 2, device=CUDA)
    request = RenderRequest(features=features, background=torch.rand(3, device=CUDA))
    draw = rasterizer.capture(gaussians, camera, request)
    moved = gaussians.replace(means=gaussians.means + 0.1)
    turned = a_camera(150, 90).to(CUDA)
    turned.world_to_camera[2, 3] += 0.4
    other = request.replace(features=features.flip(0))
    for given in (
        {},
        {"camera": turned},
        {"gaussians": moved},
        {"camera": camera, "request": other},
    ):
        actual = images(draw(**given))
        now = {"gaussians": gaussians, "camera": camera, "request": request} | given
        if "request" in given or given == {"gaussians": moved}:
            now["camera"] = camera if "camera" in given else turned
        if "request" in given:
            now["gaussians"] = moved
        wanted = images(rasterizer.render(**now))
        for name, image in wanted.items():
            assert torch.equal(actual[name], image), (list(given), name)
    assert draw.captures == 1


def test_a_captured_render_that_exceeds_its_capacity_is_right_and_grows() -> None:
    gaussians, camera = scene(20_000, 300, 200)
    small = gaussians.replace(log_scales=gaussians.log_scales - 3.0)
    draw = WarpRasterizer().capture(small, camera)
    wanted = WarpRasterizer().render(gaussians, camera).color
    assert torch.equal(draw(gaussians=gaussians).color, wanted)
    torch.cuda.synchronize()
    assert draw.captures == 1
    assert torch.equal(draw().color, wanted)
    assert draw.captures == 2, "the intersections fit: this tests nothing"


def test_a_captured_render_refuses_other_sizes() -> None:
    gaussians, camera = scene()
    draw = WarpRasterizer().capture(gaussians, camera)
    with pytest.raises(RenderError, match=r"captured with .*150.*called with .*151"):
        draw(camera=a_camera(151, 90).to(CUDA))
    with pytest.raises(RenderError, match=r"3000, 3.*100, 3"):
        draw(gaussians=gaussians[:100])


def rolling(optics: Optics | None = None, turn: float = 0.04) -> Camera:
    """A camera whose last row is seen from another pose; its numbers are on the GPU."""
    camera = a_camera(150, 90)
    last = camera.moved(torch.tensor([0.0, turn, 0.02]), torch.tensor([0.1, 0.0, -0.05]))
    fisheye = Optics(
        "fisheye", (0.05, -0.02, 0.01, -0.003), shutter="top_to_bottom",
        last_world_to_camera=last.world_to_camera,
    )  # fmt: skip
    return replace(camera, optics=optics or fisheye).to(CUDA)


def test_a_step_through_optics_waits_for_nothing_and_is_that_of_the_cpu() -> None:
    gaussians, camera = random_scene(3000).to(CUDA), rolling()
    rasterizer = WarpRasterizer()
    request = RenderRequest(min_alpha=0.0, min_transmittance=0.0)

    def step(device: torch.device) -> tuple[Tensor, ...]:
        leaves = gaussians.map(lambda x: x.detach().to(device).requires_grad_())
        poses = [camera.world_to_camera, camera.optics.last_world_to_camera]
        poses = [x.detach().to(device).requires_grad_() for x in poses]
        view = forged(
            camera.to(device), world_to_camera=poses[0],
            optics=replace(camera.optics, last_world_to_camera=poses[1]),
        )  # fmt: skip
        output = rasterizer.render(leaves, view, request)
        output.color.backward(torch.ones_like(output.color))
        return output.color.detach(), leaves.means.grad, leaves.quats.grad, *(x.grad for x in poses)

    wanted = step(CUDA)
    torch.cuda.set_sync_debug_mode("error")
    try:
        actual = step(CUDA)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(torch.equal(a, b) for a, b in zip(actual, wanted))
    for number, (a, b) in enumerate(zip(actual, step(torch.device("cpu")))):
        assert_close_gradient(str(number), a.cpu(), b)


def test_a_captured_render_follows_its_optics() -> None:
    gaussians, camera = random_scene(3000).to(CUDA), rolling()
    rasterizer = WarpRasterizer()
    draw = rasterizer.capture(gaussians, camera)
    bent = Optics(radial=(-0.2, 0.03), tangential=(0.01, 0.0))
    for view in (camera, rolling(turn=-0.05), rolling(bent), rolling(Optics("fisheye"))):
        assert torch.equal(draw(camera=view).color, rasterizer.render(gaussians, view).color)
    assert draw.captures == 1
    with pytest.raises(RenderError, match="optics"):
        draw(camera=replace(camera, optics=None))

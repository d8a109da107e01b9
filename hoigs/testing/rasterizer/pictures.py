"""R20 to R27: whole pictures, against the oracle's."""

from __future__ import annotations

import sys
from functools import cache

import torch

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.compare import require, require_close
from hoigs.testing.rasterizer.reference import reference, require_reference_picture
from hoigs.testing.rasterizer.scenes import (
    Scene,
    a_camera,
    front_camera,
    one_gaussian,
    random_gaussians,
    random_scene,
)
from hoigs.testing.rasterizer.subject import CHECKS, RasterizerSubject

SIZES = ((1, 1), (1, 37), (50, 3), (16, 16), (33, 65))


@cache
def rich_scene(seed: int) -> Scene:
    return random_scene(seed=seed, channels=5, offset=1.0 - seed)  # moved, and in place


@cache
def sized_scene(width: int, height: int) -> Scene:
    return Scene(random_gaussians(60, degree=0), a_camera().resized(width, height))


@cache
def harmonic_scene(stored: int, active: int | None) -> Scene:
    request = RenderRequest(sh_degree=active)
    return Scene(random_gaussians(40, degree=stored), a_camera(20, 14), request)


@cache
def opacity_scene(logit: float) -> Scene:
    gaussians = random_gaussians(60, degree=0)
    return Scene(gaussians.replace(opacity_logits=torch.full((60,), logit)), a_camera())


@cache
def channel_scene(channels: int) -> Scene:
    features = torch.randn(50, channels, generator=torch.Generator().manual_seed(1))
    request = RenderRequest(features=features)
    return Scene(random_gaussians(50, degree=0), a_camera(20, 14), request)


@cache
def spread_scene() -> Scene:
    gaussians = random_gaussians(200, seed=4)
    return Scene(gaussians.replace(means=gaussians.means * 3.0), a_camera())


@cache
def giant_scene() -> Scene:
    return Scene(one_gaussian((6.0, -3.0, 2.0), scale=4.0, opacity=0.9), front_camera())


@CHECKS.check("R20")
def pictures_are_the_oracles(subject: RasterizerSubject) -> None:
    """Colour, alpha, depth, features and `info` are the oracle's."""
    for seed in (0, 1):
        scene = rich_scene(seed)
        wanted = reference(scene).output
        require(0.3 < wanted.alpha.mean() < 0.95, "the scene is too empty or too full")
        output = require_reference_picture(subject, scene)
        radii = output.info["radii"]
        require_close("info['radii']", radii, wanted.info["radii"], atol=1.0, rtol=1e-3)
        for name in {"means2d", "depths"} & output.info.keys():
            what = f"info['{name}']"
            require_close(what, output.info[name], wanted.info[name], atol=1e-4, rtol=1e-4)


@CHECKS.check("R21")
def any_image_size(subject: RasterizerSubject) -> None:
    """Images of 1 x 1, of one column, of a few rows and beyond a tile's edge."""
    for width, height in SIZES:
        output = require_reference_picture(subject, sized_scene(width, height))
        require(output.color.shape == (height, width, 3), f"{width}x{height} has another shape")


@CHECKS.check("R22")
def a_large_image(subject: RasterizerSubject) -> None:
    """4000 x 3000 pixels: every corner is reached, and memory stays within 400 bytes a pixel."""
    camera = front_camera(4000, 3000, 4000.0, cx=2000.0, cy=1500.0)
    places = [
        ((u - 2000) / 2000, (v - 1500) / 2000) for u, v in ((4, 4), (3996, 2996), (2000, 1500))
    ]
    parts = [one_gaussian((x, y, 2.0), scale=0.005) for x, y in places]
    gaussians = Gaussians.cat(parts)
    before = _reset_peak(subject.device)
    with torch.no_grad():
        output = subject.render(gaussians, camera, RenderRequest(background=torch.ones(3)))
    used = _peak(subject.device) - before
    for row, column in ((4, 4), (2995, 3995), (1500, 2000)):
        require_close(f"alpha at {row, column}", output.alpha[row, column], 0.6, atol=0.01)
    require_close("color of an empty place", output.color[500, 500], torch.ones(3), atol=0.0)
    require_close("pixels seen", float((output.alpha > 0).sum()), 5400.0, atol=800.0)
    limit = 400 * 4000 * 3000
    require(used <= limit, f"it took {used / 1e6:.0f} MB, expected at most {limit / 1e6:.0f}")


@CHECKS.check("R23")
def harmonics_of_every_degree(subject: RasterizerSubject) -> None:
    """Spherical harmonics stored to degree 0 to 3, used to every degree."""
    for stored in range(4):
        for active in (*range(stored), 3, None):
            scene = harmonic_scene(stored, active)
            output = require_reference_picture(subject, scene)
            if active is not None and active < stored:
                fewer = scene.gaussians.sh[:, : (active + 1) ** 2].contiguous()
                only = subject.render(scene.gaussians.replace(sh=fewer), scene.camera)
                require_close(f"degree {active} of {stored}", output.color, only.color, atol=1e-6)


@CHECKS.check("R24")
def opacity_near_zero_and_one(subject: RasterizerSubject) -> None:
    """Opacities of almost 0, just above min_alpha, and of 1."""
    for logit in (-20.0, -5.5, 12.0, 40.0):
        require_reference_picture(subject, opacity_scene(logit))


@CHECKS.check("R25")
def partly_culled(subject: RasterizerSubject) -> None:
    """Random Gaussians, half of them outside the image, some behind the camera."""
    scene = spread_scene()
    shown = reference(scene).output.info["radii"] > 0
    require(20 < int(shown.sum()) < 180, "the scene is not partly culled")
    output = require_reference_picture(subject, scene)
    wrong = ((output.info["radii"] > 0).cpu() != shown).nonzero().flatten().tolist()
    require(not wrong, f"rows {wrong}: info['radii'] > 0 is not where the oracle draws")


@CHECKS.check("R26")
def a_splat_beyond_the_image(subject: RasterizerSubject) -> None:
    """A giant far off the image whose edge reaches in: the clamp of the Jacobian applies."""
    wanted = reference(giant_scene()).output
    require(wanted.alpha.max() > 0.1, "the giant is not in the picture")
    require_reference_picture(subject, giant_scene())


@CHECKS.check("R27")
def any_number_of_features(subject: RasterizerSubject) -> None:
    """0, 1, 17 and 40 feature channels."""
    for channels in (0, 1, 17, 40):
        output = require_reference_picture(subject, channel_scene(channels))
        shape = None if output.features is None else list(output.features.shape)
        require(shape == [14, 20, channels], f"features have shape {shape}")


def _reset_peak(device: torch.device) -> int:
    """Bytes in use now; the peak is counted from here on."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    return _peak(device)


def _peak(device: torch.device) -> int:
    """Most bytes in use: of the device, or of this process since it started."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform == "win32":
        return 0  # Windows needs another package for it
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024

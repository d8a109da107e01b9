"""Depth of an estimator becomes metres: scale and shift are found, outliers and gaps do not
matter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import FRAMES, HEIGHT, WIDTH, masks

from hoigs.core.interfaces.estimator import DepthMaps, Estimates, Estimator
from hoigs.core.values.camera import Camera
from hoigs.core.values.lens import Undistortion
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.preparation.depth import (
    Anchors,
    DepthSource,
    fit_depth,
    median_depth,
    seen_points,
    seen_surface,
    solve,
    to_metres,
)
from hoigs.preparation.prepare import PrepareOptions, prepare
from hoigs.preparation.video.frames import VideoFrames
from hoigs.preparation.video.source import SourceError

rng = np.random.default_rng(0)


@pytest.mark.parametrize("kind", ["metric", "disparity"])
def test_scale_and_shift_despite_outliers(kind: str) -> None:
    depth = rng.uniform(1, 8, 500)
    values = depth / 0.7 if kind == "metric" else (1 / depth - 0.05) / 0.3
    noisy = values * rng.normal(1, 0.01, 500)
    noisy[:100] *= 2.5  # a fifth lies on something else
    scale, shift = solve(Anchors(noisy, depth), kind)  # type: ignore[arg-type]
    fitted = to_metres(values, kind, scale, shift)  # type: ignore[arg-type]
    assert np.abs(fitted / depth - 1).max() < 0.03


def test_unknown_and_absurd_depths_are_zero() -> None:
    values = np.array([1.0, np.nan, -1.0, 0.0, 1e-9], np.float32)
    np.testing.assert_allclose(to_metres(values, "disparity", 0.5, 0.0), [2, 0, 0, 0, 0])
    np.testing.assert_allclose(to_metres(values[:4], "metric", 0.5, 0.0), [0.5, 0, 0, 0])


def camera() -> Camera:
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(K, torch.eye(4), WIDTH, HEIGHT)


def test_each_frame_has_its_own_scale(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video)
    truth = np.fromfunction(lambda y, x: 2 + 0.02 * x + 0.03 * y, (HEIGHT, WIDTH))
    factors = np.linspace(0.5, 2, FRAMES)
    maps = [(truth * f).astype(np.float32) for f in factors]
    maps[3][:20] = np.nan
    source = DepthSource(DepthMaps(maps, "metric"), video, Undistortion())
    y, x = np.mgrid[2:HEIGHT:4, 2:WIDTH:4].reshape(2, -1)
    known = np.stack((x, y, truth[y, x]), 1)
    none = np.zeros((0, 3))
    # frame 5 has hardly a point: it takes the scale of all
    fit = fit_depth(
        source, lambda i: known[:5] if i == 5 else known, lambda _: none, FRAMES, lambda _: None
    )
    own = [i for i in range(FRAMES) if i != 5]
    np.testing.assert_allclose(fit.scale[own] * factors[own], 1, rtol=1e-3)
    assert fit.residual[own].max() < 1e-3 and fit.against == "points of the scene"
    metres = fit.metres(source[3], 3)
    assert (metres[:20] == 0).all()
    np.testing.assert_allclose(metres[20:], truth[20:], rtol=2e-3)


def test_depth_without_anchors_is_refused(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video)
    maps = [np.full((HEIGHT, WIDTH), np.nan, np.float32)] * FRAMES
    source = DepthSource(DepthMaps(maps, "metric"), video, Undistortion())
    known = np.array([[5.0, 5.0, 2.0]])
    with pytest.raises(SourceError, match="0 pixels"):
        fit_depth(source, lambda _: known, lambda _: known, FRAMES, lambda _: None)


def test_what_is_hidden_or_behind_does_not_anchor() -> None:
    points = torch.tensor([[0.0, 0, 2], [0.0, 0, -2], [5.0, 0, 2], [0.3, 0, 2]])
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[:, WIDTH // 2 + 5 :] = True
    np.testing.assert_allclose(
        seen_points(points, camera(), hidden), [[WIDTH / 2, HEIGHT / 2, 2]], atol=1e-4
    )
    front = torch.tensor([[0.0, 0, 2], [0.001, 0, 2.4]])
    seen = seen_surface(front, camera(), ~hidden)
    np.testing.assert_allclose(seen[:, 2], [2], atol=1e-5)


def test_median_depth_leaves_out_what_moves() -> None:
    maps = [np.full((4, 4), value, np.float32) for value in (3.0, 3.2, 0.0, 9.0)]
    moving = [np.zeros((4, 4), bool) for _ in maps]
    moving[3][:] = True
    for mask in moving:
        mask[0, 0] = True
    found = median_depth(zip(maps, moving, strict=True), (4, 4))
    assert found[0, 0] == 0 and found[1, 1] == pytest.approx(3.1)


class WallDepth(Estimator):
    """A wall 6 m away and a person 2.8 m away, as disparities."""

    provides = frozenset({"depth"})

    def estimate(self, video, progress=lambda done, text: None) -> Estimates:
        maps = []
        for i in range(video.frames):
            depth = np.where(masks(i)[0], 2.75, 6.0)
            maps.append(((1 / depth + 0.1) * 40).astype(np.float32))
        return Estimates(depth=DepthMaps(maps, "disparity", "a wall"))


def test_a_clip_with_depth(tiny_source: Path, tmp_path: Path) -> None:
    out = tmp_path / "clip"
    options = PrepareOptions(fit_steps=25, overlay_width=0)
    report = prepare(
        tiny_source, out, body=AnnyBody(), options=options, estimators={"depth": WallDepth()}
    )
    clip = ClipFolderReader().read(out)
    assert clip.depth_kind == "metric"
    assert "the fitted body's surface" in report.provenance["depth"]
    assert report.depth_residual is not None and report.depth_residual < 0.05
    human = masks(4)[0]
    depth = clip[4].depth
    assert depth is not None
    assert float(depth[torch.from_numpy(human)].median()) == pytest.approx(2.8, abs=0.4)
    # taken up again, it is the same
    again = prepare(
        tiny_source, out, body=AnnyBody(), redo=["write"], options=options,
        estimators={"depth": WallDepth()},
    )  # fmt: skip
    assert again.depth_residual == report.depth_residual
    assert torch.equal(ClipFolderReader().read(out)[4].depth, depth)

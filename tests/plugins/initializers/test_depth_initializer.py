"""initializer:depth against the built-in clip's true geometry, and what it keeps out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import trimesh

from hoigs.core.values.clip import Clip, OverStore
from hoigs.plugins.initializers.alignment import inliers
from hoigs.plugins.initializers.depth import (
    DepthInitializer,
    DepthInitializerConfig,
    shrunk,
    steady,
)


class Spoilt(OverStore):
    """Depth as sensors and networks give it: holes, NaN, and pixels that fly off at edges."""

    def depth(self, position):
        depth = self.base.depth(position).clone()
        generator = torch.Generator().manual_seed(position)
        kind = torch.rand(depth.shape, generator=generator)
        depth[kind < 0.05] = 0.0
        depth[(kind >= 0.05) & (kind < 0.08)] = torch.nan
        depth[(kind >= 0.08) & (kind < 0.10)] *= 0.7  # single pixels, far before the rest
        mask = self.base.mask("object", position)
        rim = mask & ~shrunk(mask, 1)
        depth[rim] *= 1 + 0.04 * torch.rand(int(rim.sum()), generator=generator)
        return depth


def test_points_lie_on_the_true_surface(clip, truth):
    track = DepthInitializer().initialize(clip, "object")
    assert len(track.points) > 800
    for frame in (0, 5, 11):
        assert truth.distances(track, frame).max() < 2e-4
    assert torch.equal(track.rotations, clip.objects["object"].rotations)
    # several frames see several sides: most of the box is within reach of a point
    surface = torch.from_numpy(trimesh.sample.sample_surface(truth.mesh, 2000, seed=0)[0]).float()
    near = torch.cdist(surface, track.points).amin(1)
    assert near.median() < 0.04  # pixels are 2.5 cm wide
    alone = DepthInitializer(DepthInitializer.Config(frames=1)).initialize(clip, "object")
    assert torch.cdist(surface, alone.points).amin(1).mean() > near.mean()


def test_colours_are_those_of_the_pixels(clip):
    track = DepthInitializer(
        DepthInitializer.Config(frames=[0], erode=0, edge=9.0, outliers=99.0)
    ).initialize(clip, "object")
    frame = clip[0]
    world = track.points @ track.rotations[0].mT + track.translations[0]
    xy, depth = frame.camera.project(world)
    column, row = xy.floor().long().T
    assert len(world) == int(frame.masks["object"].sum())
    torch.testing.assert_close(track.colors, frame.rgb[row, column])
    torch.testing.assert_close(depth, frame.depth[row, column], atol=1e-4, rtol=0)


def test_holes_nan_and_flying_pixels_are_kept_out(clip, truth):
    spoilt = replace(clip, store=Spoilt(clip.store))
    track = DepthInitializer().initialize(spoilt, "object")
    assert torch.isfinite(track.points).all() and len(track.points) > 300
    assert truth.distances(track, 0).max() < 0.02
    careless = DepthInitializer(
        DepthInitializer.Config(erode=0, edge=9.0, outliers=99.0)
    ).initialize(spoilt, "object")
    away = truth.distances(careless, 0)
    assert torch.isfinite(careless.points).all() and away.max() > 0.5  # they were really there


def test_chosen_frames_count_and_seed(clip):
    first = DepthInitializer(DepthInitializer.Config(count=200), seed=1).initialize(clip, "object")
    again = DepthInitializer(DepthInitializer.Config(count=200), seed=1).initialize(clip, "object")
    other = DepthInitializer(DepthInitializer.Config(count=200), seed=2).initialize(clip, "object")
    assert len(first.points) <= 200 and torch.equal(first.points, again.points)
    assert not torch.equal(first.points[:50], other.points[:50])
    assert (
        "frames [3, 4]"
        in DepthInitializer(DepthInitializer.Config(frames=[4, 3, 3]))
        .initialize(clip, "object")
        .provenance
    )
    config = DepthInitializerConfig(frames=[2], count=9)
    assert DepthInitializer(config).config.frames == [2]


def test_parts_of_an_object_go_over_to_its_new_points(clip):
    track = clip.objects["object"]
    parted = replace(track, moving=track.points[:, 0] > 0)
    made = DepthInitializer().initialize(replace(clip, objects={"object": parted}), "object")
    sure = made.points[:, 0].abs() > 0.04
    assert torch.equal(made.moving[sure], made.points[sure, 0] > 0)
    assert DepthInitializer().initialize(clip, "object").moving is None


def test_steady_by_hand():
    depth = torch.full((4, 5), 2.0)
    depth[1, 1], depth[2, 3] = 0.0, torch.nan
    assert (~steady(depth, 0.05)).sum() == 2  # unknown ones only; their neighbours are fine
    depth[:, 4] = 3.0
    good = steady(depth, 0.05)
    assert not good[[0, 1, 3], 3:].any() and good[2, 4] and good[0, :3].all()
    assert steady(depth, 0.6)[:, 4].all()


def test_shrunk_leaves_the_images_border_alone():
    mask = torch.zeros(6, 6, dtype=torch.bool)
    mask[:4, 1:5] = True
    assert torch.equal(shrunk(mask, 0), mask)
    assert shrunk(mask, 1).nonzero().tolist() == [[r, c] for r in range(3) for c in (2, 3)]


def test_outliers():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(500, 3, generator=generator) * torch.tensor([1.0, 1, 0.01])
    points[:5] += torch.tensor([0.0, 0, 2]) * torch.arange(1, 6)[:, None]
    kept = inliers(points)
    assert not kept[:5].any() and kept[5:].float().mean() > 0.95
    assert inliers(points[:8]).all()


def refusal(clip: Clip, **settings) -> str:
    with pytest.raises(ValueError) as caught:
        DepthInitializer(DepthInitializer.Config(**settings)).initialize(clip, "object")
    return str(caught.value)


def test_errors_speak(clip):
    assert 'depth is "none"' in refusal(replace(clip, depth_kind="none"))
    assert "expected some of 0 to 11" in refusal(clip, frames=[12])
    assert "no track of object" in refusal(replace(clip, objects={}))
    assert "smaller `erode`" in refusal(clip, erode=60)
    blind = replace(clip, store=Blind(clip.store))
    assert "empty in every observed training frame" in refusal(blind)


class Blind(Spoilt):
    def mask(self, entity, position):
        return torch.zeros_like(self.base.mask(entity, position))

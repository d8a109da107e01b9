"""Foreign axes, units and places: the true object, written by some other tool, comes home."""

from __future__ import annotations

import pytest
import torch
from pydantic import ValidationError

from hoigs.core.model.object_placement import OPENGL_TO_OPENCV
from hoigs.plugins.initializers.alignment import (
    AlignmentConfig,
    align,
    axes_matrix,
    centred,
    most_seen,
)


@pytest.fixture(scope="module")
def surface(truth) -> torch.Tensor:
    """4000 points on the true object, in its own axes, metres."""
    import trimesh

    return torch.from_numpy(trimesh.sample.sample_surface(truth.mesh, 4000, seed=0)[0]).float()


def home(points, clip, **settings):
    return align(
        points, torch.rand(len(points), 3), clip, "object", AlignmentConfig(**settings),
        provenance="a test",
    )  # fmt: skip


def test_a_shape_of_no_unit_becomes_as_large_as_its_masks(clip, truth, surface):
    track = home(7.3 * surface + torch.tensor([4.0, -2, 1]), clip)
    assert truth.distances(track, 6).mean() < 0.005  # of a box 0.34 m wide, 10 pixels
    assert track.points.abs().amax(0).tolist() == pytest.approx([0.17, 0.125, 0.13], rel=0.03)
    torch.testing.assert_close(track.rotations, clip.objects["object"].rotations, atol=1e-5, rtol=0)
    assert "scale 0.13" in track.provenance or "scale 0.14" in track.provenance


@pytest.mark.parametrize("axes", ["opencv", "opengl", "blender", "-z -x y", "y,z,x"])
def test_axes_and_units(clip, truth, surface, axes):
    written = 1000 * surface @ axes_matrix(axes)  # x_file = C^T x
    track = home(written, clip, axes=axes, unit="mm", center="origin")
    torch.testing.assert_close(track.points, surface, atol=1e-6, rtol=0)
    assert truth.distances(track, 3).max() < 1e-5
    if axes != "opencv":  # as it stands it is another one
        wrong = home(written, clip, unit="mm", center="origin")
        assert (wrong.points - surface).norm(dim=1).max() > 0.02


def test_named_axes():
    torch.testing.assert_close(axes_matrix("opengl"), torch.tensor(OPENGL_TO_OPENCV))
    up = torch.tensor([0.0, 0, 1])  # in Blender; OpenCV's up is -y
    assert (axes_matrix("blender") @ up).tolist() == [0, -1, 0]
    for text, message in (
        ("x y", "expected opencv"),
        ("x y w", "expected opencv"),
        ("x y -z", "they mirror"),
        ("x x y", "stands twice"),
    ):
        with pytest.raises(ValidationError, match=message):
            AlignmentConfig(axes=text)


@pytest.mark.parametrize("space", ["camera", "world"])
def test_a_shape_seen_in_one_frame(clip, truth, surface, space):
    at = clip.split["train"][2]
    points = surface @ truth.rotations[at].mT + truth.translations[at]
    if space == "camera":
        points = clip.cameras[at].to_camera(points)
    exact = home(points, clip, space=space, reference=at, unit="m", center="origin")
    assert truth.distances(exact, 9).max() < 1e-4
    fitted = home(40 * points, clip, space=space, reference=at)
    assert truth.distances(fitted, 9).mean() < 0.005
    other = home(points, clip, space=space, reference=clip.split["train"][6], unit="m")
    assert truth.distances(other, 9).mean() > 0.01  # the object has turned meanwhile


def test_rotation_none_is_the_papers(clip, truth, surface):
    at = clip.split["train"][0]
    track = home(surface, clip, rotation="none", reference=at)
    to_camera = torch.stack([c.world_to_camera[:3, :3] for c in clip.cameras]) @ track.rotations
    torch.testing.assert_close(to_camera, to_camera[:1].expand_as(to_camera), atol=1e-5, rtol=0)
    assert truth.distances(track, at).mean() < 0.02  # S suffers too: 8 %
    assert truth.distances(track, 6).mean() > truth.distances(track, at).mean() + 0.005


def test_place_by_masked_depth(clip, truth, surface):
    track = home(5 * surface, clip, place="depth", smooth=False)
    away = (track.translations - truth.translations).norm(dim=1)
    train = clip.split["train"]
    assert away[train].max() < 0.04 and track.observed[train].all()
    assert not track.observed[list(clip.split["test"])].any()  # never looked at
    naive = home(5 * surface, clip, place="depth", smooth=False, front=False)
    assert (naive.translations - truth.translations).norm(dim=1)[train].mean() > (
        2 * away[train].mean()
    )


def test_centres():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 4, 2]])
    assert torch.equal(centred(points, "origin"), points)
    assert centred(points, "mean").mean(0).abs().max() < 1e-6
    assert (centred(points, "box").amax(0) + centred(points, "box").amin(0)).abs().max() < 1e-6
    many = torch.cat((torch.rand(5000, 3), torch.tensor([[50.0, 50, 50]])))
    assert (many - centred(many, "box"))[0].sub(0.5).abs().max() < 0.02  # one stray moves nothing


def test_the_reference_is_a_training_frame(clip):
    at = most_seen(clip, "object")
    areas = {i: int(clip.store.mask("object", i).sum()) for i in clip.split["train"]}
    assert at in areas and areas[at] == max(areas.values())


def test_settings_that_contradict_each_other():
    with pytest.raises(ValidationError, match="place: depth finds scale and place together"):
        AlignmentConfig(place="depth", unit="m")
    with pytest.raises(ValidationError, match="give its unit"):
        AlignmentConfig(space="world", center="origin")


def test_errors_speak(clip, surface):
    from dataclasses import replace

    with pytest.raises(ValueError, match="the clip has 12 frames"):
        home(surface, clip, reference=12, space="camera")
    with pytest.raises(ValueError, match="no track of object"):
        home(surface, replace(clip, objects={}))
    with pytest.raises(ValueError, match='depth is "affine-disparity"'):
        home(surface, replace(clip, depth_kind="affine-disparity"), place="depth")

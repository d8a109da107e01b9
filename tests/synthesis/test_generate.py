from __future__ import annotations

import numpy as np
import pytest
import torch

from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.synthesis import SceneConfig, SyntheticScene, TrueView, generate
from hoigs.synthesis.generate import canonical, unproject
from hoigs.synthesis.object_motions import MOTIONS
from hoigs.synthesis.raycast import camera_path, held_out_views


@pytest.fixture(scope="module")
def view(scene: SyntheticScene) -> TrueView:
    return scene.render(10, scene.cameras[10].resized(160, 160))


def test_the_same_config_gives_the_same_pixels(
    body: AnnyBody, scene: SyntheticScene, view: TrueView
) -> None:
    again = generate(scene.config, body).render(10, view.camera)
    assert np.array_equal(again.image, view.image)
    assert np.array_equal(again.depth, view.depth)
    assert np.array_equal(again.entity, view.entity)


def test_another_seed_gives_other_textures_on_the_same_geometry(
    body: AnnyBody, scene: SyntheticScene, view: TrueView
) -> None:
    other = generate(scene.config.model_copy(update={"seed": 5}), body).render(10, view.camera)
    assert not np.array_equal(other.image, view.image)
    human = view.mask("human")
    np.testing.assert_array_equal(other.mask("human"), human)
    np.testing.assert_allclose(other.depth[human], view.depth[human])


def test_the_object_s_pixels_lie_on_its_surface(scene: SyntheticScene, view: TrueView) -> None:
    points, _ = unproject(view, view.mask("object"))
    local = np.abs(canonical(scene, points, view.frame))
    half = np.array(scene.config.object.size) / 2
    assert len(points) > 200
    assert np.abs((local - half).max(-1)).max() < 1e-3  # on one of the six sides


def test_the_object_s_corners_project_onto_its_silhouette(
    scene: SyntheticScene, view: TrueView
) -> None:
    corners = torch.from_numpy(scene.object_at(view.frame).vertices).float()
    pixels, depth = view.camera.project(corners)
    rows, columns = np.nonzero(view.mask("object"))
    low, high = pixels.min(0).values, pixels.max(0).values
    # hands may hide the left and right edges, not the top and the bottom
    assert abs(rows.min() - float(low[1])) < 1.5 and abs(rows.max() + 1 - float(high[1])) < 1.5
    assert columns.min() > low[0] - 1 and columns.max() + 1 < high[0] + 1
    seen = view.depth[view.mask("object")]
    assert seen.min() > depth.min() - 1e-3 and seen.max() < depth.max() + 1e-3


def test_human_pixels_lie_on_the_clothed_body(scene: SyntheticScene, view: TrueView) -> None:
    points, _ = unproject(view, view.mask("human"))
    vertices = scene.body_vertices[view.frame]
    gap = torch.cdist(torch.from_numpy(points).float(), torch.from_numpy(vertices)).min(1).values
    assert len(points) > 800
    assert gap.max() < 0.03  # edges of the mesh are about a centimetre


def test_floor_pixels_have_height_zero(view: TrueView) -> None:
    points, _ = unproject(view, (view.entity == 0) & (np.arange(160)[:, None] > 150))
    assert np.median(np.abs(points[:, 1])) < 0.015  # floor, and a rug of 12 mm


def test_joints_project_into_the_person(
    body: AnnyBody, scene: SyntheticScene, view: TrueView
) -> None:
    joints = body(scene.poses.frame(view.frame)).joints
    pixels, depth = view.camera.project(joints[:22])
    hit = 0
    for (x, y), z in zip(pixels.tolist(), depth.tolist(), strict=True):
        row, column = int(y), int(x)
        # a joint lies inside the person, who may be hidden by the box, furniture or own arms
        assert z > view.depth[row, column] - 0.005
        hit += view.entity[row, column] == 1 and z - view.depth[row, column] < 0.2
    assert hit >= 12


def test_the_clothed_body_follows_the_body_model(body: AnnyBody, scene: SyntheticScene) -> None:
    skin = body(scene.poses).vertices.numpy()
    gap = np.linalg.norm(scene.body_vertices - skin, axis=-1)
    parts = body.vertex_parts.numpy()
    assert gap[:, np.isin(parts, (8, 9))].max() < 1e-4  # hands wear nothing
    torso = gap[:, np.isin(parts, (1, 10, 11, 12, 13))]
    assert 0.007 < np.median(torso) < 0.013 and gap.max() < 0.05


def test_views_come_in_order_with_their_held_out_ones(body: AnnyBody) -> None:
    scene = generate(SceneConfig.tiny(frames=5, width=24, height=24, held_out_views=2), body)
    views = list(scene.views())
    assert [v.frame for v, _ in views] == [0, 1, 2, 3, 4]
    held_out = [o for _, others in views for o in others]
    assert [o.frame for o in held_out] == [f for f, _ in scene.held_out]
    for v, _ in views:
        assert np.array_equal(v.image, scene.render(v.frame, v.camera).image)


def test_person_and_object_fill_half_of_the_frame(scene: SyntheticScene) -> None:
    spans = []
    for frame in (0, 8, 12, 23):
        seen = scene.render(frame, scene.cameras[frame])
        rows, columns = np.nonzero(seen.entity > 0)
        spans.append((rows.max() + 1 - rows.min()) / 64)
        assert columns.min() > 0 and columns.max() < 63  # in frame, with air around
        assert seen.mask("object").sum() > 30 and seen.mask("human").sum() > 100
    assert 0.42 < np.mean(spans) < 0.7


@pytest.mark.parametrize("motion", [m for m in MOTIONS if m != "held"])
def test_every_motion_renders(body: AnnyBody, motion: str) -> None:
    config = SceneConfig.tiny(width=32, height=32, object={"motion": motion})
    scene = generate(config, body)
    frame = 4
    seen = scene.render(frame, scene.cameras[frame])
    assert seen.mask("object").any() and seen.mask("human").any()
    vertices = scene.object_at(frame).vertices
    rigid = vertices @ scene.script.track.rotations[frame]
    rest = scene.object_mesh.vertices
    stretch = np.ptp(rigid, axis=0) - np.ptp(rest, axis=0)
    assert (np.abs(stretch).max() > 0.005) == (motion in ("bending", "squeezed"))


def test_an_orbit_turns_about_the_person_by_its_arc() -> None:
    config = SceneConfig()
    cameras = camera_path(config)
    centers = torch.stack([c.center for c in cameras]).numpy()
    flat = centers[:, [0, 2]] - np.array(config.camera.target)[[0, 2]]
    np.testing.assert_allclose(np.linalg.norm(flat, axis=-1), config.camera.distance, rtol=1e-5)
    azimuth = np.degrees(np.arctan2(*flat.T))
    assert np.ptp(azimuth) == pytest.approx(config.camera.arc_degrees, rel=1e-4)
    assert np.ptp(centers[:, 1]) == pytest.approx(config.camera.height_change, rel=1e-4)
    pixels, _ = cameras[0].project(torch.tensor(config.camera.target))
    np.testing.assert_allclose(pixels, [128, 128], atol=1e-3)


def test_a_static_camera_stands_still_and_a_pan_does_not_turn_much() -> None:
    still = camera_path(SceneConfig.model_validate({"camera": {"path": "static"}}))
    assert all(torch.equal(c.world_to_camera, still[0].world_to_camera) for c in still)
    pan = camera_path(SceneConfig.model_validate({"camera": {"path": "pan"}}))
    way = pan[-1].center - pan[0].center
    assert float(way[[0, 2]].norm()) == pytest.approx(1.2, rel=1e-3)


def test_the_principal_point_can_be_off_the_middle() -> None:
    shifted = {"camera": {"principal_point_shift": (0.1, -0.05)}}
    camera = camera_path(SceneConfig.model_validate(shifted))[0]
    np.testing.assert_allclose(camera.K[:2, 2], [128 + 25.6, 128 - 12.8], rtol=1e-6)


def test_held_out_cameras_are_far_from_every_filming_one() -> None:
    config = SceneConfig()
    path = torch.stack([c.center for c in camera_path(config)])
    views = held_out_views(config)
    assert len(views) == 8 and len({f for f, _ in views}) == 8
    for frame, camera in views:
        assert (path - camera.center).norm(dim=-1).min() > 0.1
        assert (path[frame] - camera.center).norm() > 0.8  # unlike the view of that moment


def test_held_out_cameras_turned_about_the_scene() -> None:
    config = SceneConfig(held_out_degrees=(45, 135), held_out_views=4)
    path, target = camera_path(config), torch.tensor(config.camera.target)
    turns = []
    for frame, camera in held_out_views(config):
        ours, theirs = ((c.center - target)[[0, 2]] for c in (camera, path[frame]))
        cosine = torch.nn.functional.cosine_similarity(ours, theirs, dim=0)
        turns.append(round(float(torch.rad2deg(cosine.acos()))))
    assert turns == [45, 45, 135, 135]
    assert SceneConfig().digest() != config.digest()


def test_shape_changes_the_person(body: AnnyBody, scene: SyntheticScene) -> None:
    other = generate(SceneConfig.tiny(betas=(2.5,)), body)
    assert (
        np.abs(np.ptp(other.dressed.vertices, 0) - np.ptp(scene.dressed.vertices, 0)).max() > 0.01
    )
    assert float(other.poses.betas[0]) == 2.5


def test_exposure_ramps(body: AnnyBody) -> None:
    config = SceneConfig.tiny(
        width=24, height=24, camera={"path": "static"}, light={"exposure_ramp": 0.6}
    )
    scene = generate(config, body)
    first, last = (scene.render(f, scene.cameras[f]).image.astype(float) for f in (0, 11))
    assert first[:4].mean() < 0.85 * last[:4].mean()  # the wall above

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoigs.core.values.camera import Camera
from hoigs.synthesis import LightConfig, SyntheticScene
from hoigs.synthesis.generate import unproject
from hoigs.synthesis.meshes import TexturedMesh, box, quad
from hoigs.synthesis.raycast import FINE, Layer, RayCaster, fine_barycentrics, pixel_samples
from hoigs.synthesis.raycast_kernels import MIRROR
from hoigs.synthesis.textures import TextureAtlas, to_srgb

ROOM = ((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0))
DARK = LightConfig(sun=0.0, ambient=1.0, shadows=0.0, occlusion=0.0)


def _camera(width: int = 48, height: int = 40, shift: float = 0.0) -> Camera:
    camera = Camera.look_at(
        torch.tensor([0.3, 0.4, 3.0]), torch.tensor([0.0, 0.0, 0.0]),
        width=width, height=height, fov_y=0.6,
    )  # fmt: skip
    K = camera.K.clone()
    K[0, 2] += shift
    return replace(camera, K=K)


def _wall(image: np.ndarray, light: LightConfig = DARK, samples: int = 4) -> RayCaster:
    """A picture on the plane z = -1, from (-2, 2) to (2, -2)."""
    corners = np.array([[-2, 2, -1], [2, 2, -1], [2, -2, -1], [-2, -2, -1.0]])
    shell = Layer.build(quad(corners, 0), np.zeros(2, int))
    return RayCaster(shell, TextureAtlas.pack([image]), light, ROOM, samples, 2 * samples)


def _block(size: float, place: tuple[float, float, float]) -> Layer:
    mesh = box((size, size, size), 0).moved(shift=place)
    return Layer.build(mesh, np.full(len(mesh.faces), 7))


NOWHERE = (0.0, 40.0, 0.0)
GREY = np.full((8, 8, 3), 0.5)


def test_depth_is_z_of_the_plane_at_each_pixel_s_centre() -> None:
    camera = _camera(shift=3.0)
    picture = _wall(GREY).render(camera, _block(0.1, NOWHERE))
    eye = camera.center.double()
    rays = (camera.unproject(camera.pixel_grid(), torch.ones(40, 48)) - eye).double()
    expected = (-1.0 - eye[2]) / rays[..., 2]  # rays have unit length along the camera's z
    np.testing.assert_allclose(picture.depth, expected.numpy(), rtol=1e-5)
    assert (picture.entity == 0).all()


def test_a_box_covers_the_pixels_between_its_projected_corners() -> None:
    camera = _camera(96, 80)
    mesh = box((0.8, 0.8, 0.8), 0)
    picture = _wall(GREY).render(camera, _block(0.8, (0, 0, 0)))
    pixels, depth = camera.project(torch.from_numpy(mesh.vertices).float())
    rows, columns = np.nonzero(picture.entity == 7)
    low, high = pixels.min(0).values.numpy(), pixels.max(0).values.numpy()
    assert np.abs(columns.min() - low[0]) < 1 and np.abs(columns.max() + 1 - high[0]) < 1
    assert np.abs(rows.min() - low[1]) < 1 and np.abs(rows.max() + 1 - high[1]) < 1
    seen = picture.depth[picture.entity == 7]
    assert depth.min() - 1e-4 <= seen.min() and seen.max() <= depth.max() + 1e-4
    assert picture.depth[0, 0] > depth.max()


def test_nothing_hit_is_depth_zero_and_no_entity() -> None:
    away = Camera.look_at(
        torch.tensor([0.0, 0.0, 3.0]), torch.tensor([0.0, 0.0, 9.0]), width=16, height=16, fov_y=0.7
    )
    picture = _wall(GREY).render(away, _block(0.1, NOWHERE))
    assert (picture.depth == 0).all() and (picture.entity == -1).all()
    assert (picture.color == 0).all()


def test_a_texture_stands_where_its_uv_says() -> None:
    image = np.zeros((64, 64, 3))
    image[:32, :32] = (1, 0, 0)  # top left, seen from the front
    image[:32, 32:] = (0, 1, 0)
    image[32:, :32] = (0, 0, 1)
    camera = _camera()
    color = _wall(image).render(camera, _block(0.1, NOWHERE)).color
    for x, y, channel in ((-0.7, 0.6, 0), (0.7, 0.6, 1), (-0.7, -0.6, 2)):
        pixel, _ = camera.project(torch.tensor([x, y, -1.0]))
        column, row = pixel.long().tolist()
        assert color[row, column].argmax() == channel
        assert np.sort(color[row, column])[:2].max() < 1e-6


def test_light_is_the_same_from_every_side() -> None:
    light = LightConfig(sun_radius_degrees=0.0)
    caster = _wall(GREY, light)
    block = _block(0.8, (0.2, 0.1, 0.0))
    point = torch.tensor([0.62, 0.2, 0.1])  # on the block's right side, in the sun
    seen = []
    for eye in ([3.0, 0.5, 1.5], [2.5, 1.5, 0.2], [2.0, -0.6, 2.0]):
        camera = Camera.look_at(torch.tensor(eye), point, width=33, height=33, fov_y=0.2)
        picture = caster.render(camera, block)
        assert picture.entity[16, 16] == 7
        seen.append(picture.color[16, 16])
    np.testing.assert_allclose(seen[0], seen[1], rtol=0.02)
    np.testing.assert_allclose(seen[0], seen[2], rtol=0.02)


def test_a_thing_before_the_sun_casts_a_shadow_and_none_when_asked() -> None:
    light = LightConfig(
        sun=1.0, ambient=0.2, sun_direction=(0, 0, 1), sun_radius_degrees=1.0, occlusion=0.0
    )
    camera = Camera.look_at(  # past the block's side at the wall behind it
        torch.tensor([2.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, -1.0]), width=32, height=32,
        fov_y=0.3,
    )  # fmt: skip
    block = _block(0.6, (0.0, 0.0, 0.7))
    brightness = {
        strength: _wall(GREY, light.model_copy(update={"shadows": strength}))
        .render(camera, block).color[16, 16].sum()
        for strength in (0.0, 1.0)
    }  # fmt: skip
    sky_only = _wall(GREY, light.model_copy(update={"sun": 0.0})).render(camera, block)
    assert brightness[1.0] == pytest.approx(sky_only.color[16, 16].sum(), rel=1e-3)
    assert brightness[0.0] > 2 * brightness[1.0]


def test_corners_near_a_thing_are_occluded() -> None:
    light = LightConfig(sun=0.0, ambient=1.0, occlusion=1.0)
    camera = _camera(64, 64)
    caster = _wall(GREY, light, samples=8)
    block = _block(0.8, (0.0, 0.0, -0.6))
    with_block, alone = (caster.render(camera, b) for b in (block, _block(0.1, NOWHERE)))
    foot, _ = camera.project(torch.tensor([0.52, 0.0, -1.0]))  # 12 cm beside the block
    column, row = foot.long().tolist()
    assert with_block.entity[row, column] == 0
    assert with_block.color[row, column].sum() < 0.9 * alone.color[row, column].sum()


@pytest.mark.parametrize(("plain", "more"), [(4, 8), (3, 16), (1, 1), (5, 5)])
def test_samples_are_centred_and_within_the_pixel(plain: int, more: int) -> None:
    points = pixel_samples(plain, more)
    assert points.shape == (more, 2)
    assert (points > 0).all() and (points < 1).all()
    np.testing.assert_allclose(points[0], 0.5)
    if plain > 2:
        np.testing.assert_allclose(points[:plain].mean(0), 0.5, atol=1e-6)
    if more > plain + 1:
        np.testing.assert_allclose(points.mean(0), 0.5, atol=1e-6)


def test_edges_are_smoothed() -> None:
    camera = _camera(96, 80)
    white = np.ones((4, 4, 3))
    black = np.zeros((4, 4, 3))
    corners = np.array([[-2, 2, -1], [2, 2, -1], [2, -2, -1], [-2, -2, -1.0]])
    shell = Layer.build(quad(corners, 0), np.zeros(2, int))
    mesh = box((0.8, 0.8, 0.8), 1)
    block = Layer.build(mesh, np.ones(len(mesh.faces), int))
    caster = RayCaster(shell, TextureAtlas.pack([white, black]), DARK, ROOM, 4, 8)
    color = caster.render(camera, block).color.mean(-1)
    top = color.max()
    between = ((color > 0.1 * top) & (color < 0.9 * top)).mean()
    assert 0.005 < between < 0.08


def test_mesh_colours_are_linear_on_a_face() -> None:
    corners = np.array([[-2, 2, -1], [2, 2, -1], [2, -2, -1], [-2, -2, -1.0]])
    wall = quad(corners, -1)
    weights = fine_barycentrics()
    assert weights.shape == ((FINE + 1) * (FINE + 2) // 2, 3)
    points = np.einsum("nk,fkc->fnc", weights, wall.vertices[wall.faces])
    colors = (points + 2) / 4  # a function that is linear in the place
    from hoigs.synthesis.raycast import fine_array

    things = Layer.build(wall, np.ones(2, int), fine_array(colors.astype(np.float32)))
    behind = Layer.build(quad(corners - [0, 0, 1], 0), np.zeros(2, int))
    caster = RayCaster(behind, TextureAtlas.pack([GREY]), DARK, ROOM, 1, 1)
    camera = _camera()
    picture = caster.render(camera, things)
    place = camera.unproject(camera.pixel_grid(), torch.from_numpy(picture.depth)).numpy()
    # a wall facing +z under the sky alone has one light everywhere
    ratio = picture.color[..., :2] / ((place[..., :2] + 2) / 4)
    centre = ratio[16:24, 16:32]
    np.testing.assert_allclose(centre[..., 0], centre[4, 8, 0], rtol=0.05)
    np.testing.assert_allclose(centre[..., 1], centre[4, 8, 1], rtol=0.05)
    assert picture.color[20, 40, 0] > picture.color[20, 8, 0]


def test_two_cameras_agree_on_the_still_room(scene: SyntheticScene) -> None:
    """Back-project one view, look the points up in another: same depth, same colour."""
    first, second = scene.render(6, scene.cameras[6]), scene.render(6, scene.cameras[12])
    points, colors = unproject(first, first.entity == 0)
    pixels, depth = second.camera.project(torch.from_numpy(points).float())
    inside = ((pixels > 0) & (pixels < 64)).all(-1).numpy()
    columns, rows = pixels[inside].long().numpy().T
    there = np.abs(second.depth[rows, columns] - depth[inside].numpy()) < 0.02
    still = there & (second.entity[rows, columns] == 0)
    assert still.mean() > 0.6
    gap = np.abs(second.image[rows, columns][still] / 255.0 - colors[inside][still]).mean(-1)
    assert np.median(gap) < 0.03


def test_srgb_ends() -> None:
    np.testing.assert_allclose(to_srgb(np.array([-1.0, 0.0, 1.0, 4.0])), [0, 0, 1, 1])


def test_atlas_levels_average() -> None:
    image = np.zeros((4, 4, 3))
    image[:, 2:] = 1
    atlas = TextureAtlas.pack([image], levels=4)
    start, width, height = atlas.levels[0, 1]
    assert (width, height) == (2, 2)
    np.testing.assert_allclose(atlas.texels[start : start + 4, 0], [0, 1, 0, 1])
    np.testing.assert_allclose(atlas.texels[atlas.levels[0, 3, 0]], 0.5)


def test_joined_meshes_keep_their_parts() -> None:
    a, b = box((1, 1, 1), 2), box((1, 1, 1), 5)
    both = TexturedMesh.join([a, b])
    assert len(both.faces) == 24 and both.faces.max() == 47
    assert (both.texture[:12] == 2).all() and (both.texture[12:] == 5).all()


def test_a_mirror_shows_what_stands_behind_the_camera() -> None:
    """Behind the camera stands a white wall at the left and a black one at the right."""
    left = np.array([[0, 4, 4], [-4, 4, 4], [-4, -4, 4], [0, -4, 4.0]])
    sides = [left, left + np.array([4, 0, 0])]
    walls = [quad(corners, i) for i, corners in enumerate(sides)]
    shell = Layer.build(TexturedMesh.join(walls), np.zeros(4, int))
    atlas = TextureAtlas.pack([np.ones((4, 4, 3)), np.zeros((4, 4, 3))])
    corners = np.array([[-1, 1, -1], [1, 1, -1], [1, -1, -1], [-1, -1, -1.0]])
    mirror = Layer.build(quad(corners, 1), np.full(2, MIRROR))
    camera = Camera.look_at(
        torch.tensor([0.0, 0.0, 3.0]), torch.zeros(3), width=48, height=40, fov_y=0.4
    )
    shown = RayCaster(shell, atlas, DARK, ROOM, 1, 1, mirror=1.0).render(camera, mirror).color
    dull = RayCaster(shell, atlas, DARK, ROOM, 1, 1).render(camera, mirror).color
    assert shown[20, 4].min() > 0.2 and shown[20, 43].max() < 0.01
    assert dull.max() < 0.01  # the mirror's own colour is black

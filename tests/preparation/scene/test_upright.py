"""Up by the vertical lines of a room, held against the people in it."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hoigs.core.values.camera import Camera
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.upright import _degrees, room_up, world_of

WIDTH, HEIGHT, FOCAL, FINER = 640, 480, 520.0, 2
NOTHING = np.zeros((HEIGHT, WIDTH), bool)
K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def room(tilt: float, roll: float) -> tuple[np.ndarray, Camera, np.ndarray]:
    """Shelves along a wall, seen by a camera that looks down by `tilt` degrees and is rolled; and
    up in its axes."""
    turn = Rotation.from_euler("xz", [tilt, roll], degrees=True).as_matrix()
    y, x = (np.mgrid[: FINER * HEIGHT, : FINER * WIDTH] + 0.5) / FINER
    rays = np.stack(((x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)), -1)
    wall = rays @ turn  # from the camera to the room, whose y is down
    across, down = wall[..., 0] / wall[..., 2] * 3, wall[..., 1] / wall[..., 2] * 3
    parts = np.floor(across / 0.4) * 7 + np.floor(down / 0.7 + 0.3 * np.floor(across / 0.4)) * 3
    fine = (60 + 30 * (parts % 5)).reshape(HEIGHT, FINER, WIDTH, FINER)
    image = np.uint8(fine.mean((1, 3)))[..., None].repeat(3, -1)
    return image, Camera(K, torch.eye(4), WIDTH, HEIGHT), turn @ (0, -1, 0)


@pytest.mark.parametrize(("tilt", "roll"), [(25, 3), (-12, -5)])
def test_vertical_lines_tell_up_within_what_is_said(tilt: float, roll: float) -> None:
    image, camera, true = room(tilt, roll)
    found = room_up(image, NOTHING, camera)
    assert found is not None and _degrees(found.up, true) <= found.within < 4


def test_a_meadow_tells_nothing() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 1), np.uint8)
    assert room_up(noise.repeat(3, -1), NOTHING, room(0, 0)[1]) is None


def draft(image: np.ndarray, camera: Camera, trunk: np.ndarray | None) -> SimpleNamespace:
    """A clip of one image, with somebody who sits and whose trunk has this direction."""
    frames = SimpleNamespace(subset=lambda _, places: [image for _ in places], fps=10.0)
    frames = type("Video", (), {"__len__": lambda _: 3, **vars(frames)})()
    joints = torch.zeros(3, 55, 3)
    if trunk is not None:
        joints[:, 12] = torch.from_numpy(0.5 * trunk).float()
    people = {} if trunk is None else {"human": SimpleNamespace(joints=joints, poses=None)}
    return SimpleNamespace(
        video=frames, cameras=[camera] * 3, bodies=people, body=None,
        guessed={"human": {"left leg": [], "right leg": [0, 1, 2]}},
        masks=SimpleNamespace(moving=lambda i: NOTHING),
        track=SimpleNamespace(undistort=Undistortion()),
    )  # fmt: skip


def no_legs(people: list, fps: float) -> None:
    """Nobody stands on legs that are guessed."""
    assert len(people) == 0


def test_lines_are_believed_beside_somebody_upright(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mat that is seen from above has lines that look vertical."""
    monkeypatch.setattr("hoigs.preparation.upright.world_of_people", no_legs)
    monkeypatch.setattr("hoigs.preparation.upright.FRAMES", 1)
    image, camera, true = room(20, 0)
    lean = Rotation.from_euler("x", 15, degrees=True).apply(true)
    world = world_of(draft(image, camera, lean), None)
    assert world.known == "lines" and world.floor is None
    assert _degrees(np.array(world.up), true) <= world.within < 4
    toward = np.array((0.0, 0.0, -1.0))
    assert world_of(draft(image, camera, toward), None).is_guess
    assert world_of(draft(image, camera, None), None).is_guess
    # a focal length that is not known makes the tilt as unsure, and in the end a guess
    wide = world_of(draft(image, camera, lean), (0.7, 1.5))
    longer = math.degrees(math.atan(1.5 * math.tan(math.radians(20)))) - 20
    assert wide.within == pytest.approx(longer, abs=1)
    assert world_of(draft(image, camera, lean), (0.5, 2.0)).is_guess

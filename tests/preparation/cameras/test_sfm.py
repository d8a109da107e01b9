"""A moving camera is distinguished from a static one, and its path is found."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy import ndimage

from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.cameras import sfm
from hoigs.preparation.cameras.choose import BesideVideo, ChosenCameras, choose_cameras
from hoigs.preparation.cameras.sfm import _focals, _what_to_do, structure_from_motion
from hoigs.preparation.cameras.turning_cameras import background_motion
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.video.frames import Frames, open_frames
from hoigs.preparation.video.source import SourceError

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 260.0, 8


def texture(seed: int, size: int) -> np.ndarray:
    """Blotches of several sizes, which features like."""
    noise = np.random.default_rng(seed).normal(size=(size, size))
    layers = [ndimage.gaussian_filter(noise, s) * s for s in (1.5, 3, 6)]
    total = np.add.reduce(layers)
    return np.clip(128 + 90 * total / total.std() / 2, 0, 255)


WALLS = [(4.0, texture(0, 900), None), (2.5, texture(1, 900), 0.55)]  # depth, texture, lower part


def view(eye: float) -> np.ndarray:
    """What a camera sees that walks sideways: a far wall, and a near one below."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image = np.zeros((HEIGHT, WIDTH))
    for depth, pattern, start in WALLS:
        at_x = (x - WIDTH / 2) / FOCAL * depth + eye
        at_y = (y - HEIGHT / 2) / FOCAL * depth
        shown = ndimage.map_coordinates(
            pattern, (at_y * 110 + 450, at_x * 110 + 450), order=1, mode="mirror"
        )
        image = np.where(y > HEIGHT * start, shown, image) if start else shown
    return image


def recorded(folder: Path, steps: list[float], block: bool = True) -> tuple[Frames, GivenMasks]:
    """Frames and the mask of a textured block that goes its own way."""
    folder.mkdir()
    moving = texture(2, 90)
    masks = MaskStack()
    for i, eye in enumerate(steps):
        image, mask = view(eye), np.zeros((HEIGHT, WIDTH), bool)
        if block:
            left = 30 + 18 * i
            image[60:150, left : left + 90] = moving
            mask[60:150, left : left + 90] = True
        masks.append(mask)
        grey = image.astype(np.uint8)
        Image.fromarray(np.stack([grey] * 3, -1)).save(folder / f"{i:05d}.png")
    return open_frames(folder), GivenMasks(together=masks)


def nobody(count: int) -> Landmarks:
    unseen = np.full((count, 33, 4), np.nan)
    return Landmarks.from_mediapipe(unseen, unseen)


def cameras_of(video: Frames, masks: GivenMasks, folder: Path, **options: Any) -> ChosenCameras:
    """Chosen with nobody in view and nothing beside the video."""
    asked = PrepareOptions(**options)
    seen = nobody(len(video))
    return choose_cameras(video, seen, masks, BesideVideo(), asked, folder, lambda _: None)


def test_a_camera_that_stands_still(tmp_path: Path) -> None:
    video, masks = recorded(tmp_path / "still", [0.0] * COUNT)
    motion = background_motion(video, masks)
    assert motion.known and motion.static and motion.largest < 0.5
    chosen = cameras_of(video, masks, tmp_path, focal=FOCAL)
    assert chosen.track.static and "features outside the masks move by" in chosen.track.provenance
    assert chosen.track.figures["displacement_px"] < 0.5


def test_a_camera_that_is_let_go_and_taken_up(tmp_path: Path) -> None:
    """A hand starts and stops the recording: the frames in which it moves the camera go."""
    eyes = [0.12, 0.06, *[0.0] * 20, 0.1, 0.3]
    video, masks = recorded(tmp_path / "touched", eyes, block=False)
    motion = background_motion(video, masks)
    assert motion.static and motion.largest < 0.5 and motion.still == (2, 21)
    chosen = cameras_of(video, masks, tmp_path, focal=FOCAL)
    assert chosen.track.static and chosen.track.positions == tuple(range(2, 22))
    assert any("0-1, 22-23" in warning for warning in chosen.warnings)
    declared = cameras_of(video, masks, tmp_path, focal=FOCAL, camera="static")
    assert len(declared.track.positions) == 24
    assert any("0-1, 22-23" in w and "blurred" in w for w in declared.warnings)

    hidden = MaskStack([np.full((HEIGHT, WIDTH), i > 20) for i in range(24)])
    motion = background_motion(video, GivenMasks(together=hidden))
    assert motion.static and motion.still == (2, 23), "nothing shows that the last frames moved"


def test_a_camera_that_moves_and_one_that_shows_nothing(tmp_path: Path) -> None:
    video, masks = recorded(tmp_path / "moves", [0.08 * i for i in range(COUNT)])
    motion = background_motion(video, masks)
    assert motion.known and not motion.static and motion.largest > 5 and motion.turned is None
    hidden = GivenMasks(together=MaskStack([np.ones((HEIGHT, WIDTH), bool)] * COUNT))
    nothing = background_motion(video, hidden)
    assert not nothing.known and nothing.static
    chosen = cameras_of(video, hidden, tmp_path)
    assert any("too few to tell" in warning for warning in chosen.warnings)


def test_a_camera_in_a_hand_is_one_that_turns(tmp_path: Path) -> None:
    """It shakes by a centimetre: structure from motion would find nothing after minutes."""
    video, masks = recorded(tmp_path / "hand", [0.0, 0.01, -0.01, 0.005], block=False)
    motion = background_motion(video, masks)
    assert not motion.static and motion.turned is not None and 0.3 < motion.parallax < 3
    chosen = cameras_of(video, masks, tmp_path)
    assert chosen.track.kind == "turning"
    # so small turns show no focal length, however small their residuals are
    assert float(chosen.track.cameras[0].K[0, 0]) == pytest.approx(0.8 * WIDTH)
    assert chosen.track.figures["focal_low_px"] < FOCAL < chosen.track.figures["focal_high_px"]


def test_a_video_that_was_taken_upright_is_measured_by_its_longer_side(tmp_path: Path) -> None:
    lying, masks = recorded(tmp_path / "lying", [0.0, 0.01, -0.01, 0.005], block=False)
    (tmp_path / "upright").mkdir()
    for i, frame in enumerate(lying):
        Image.fromarray(np.rot90(frame)).save(tmp_path / f"upright/{i:05d}.png")
    upright = open_frames(tmp_path / "upright")
    turned = GivenMasks(together=MaskStack([np.rot90(masks.moving(i)) for i in range(len(lying))]))
    one, other = background_motion(lying, masks), background_motion(upright, turned)
    assert other.displacement == pytest.approx(one.displacement, rel=0.05)
    assert other.parallax == pytest.approx(one.parallax, rel=0.2)


def turning_video(folder: Path, yaw: list[float]) -> tuple[Frames, GivenMasks]:
    """A camera that looks at the wall from one place, turned by these degrees."""
    folder.mkdir()
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack(((x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)), -1)
    for i, degrees in enumerate(yaw):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        wall = rays @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        at = wall[..., 1::-1] / wall[..., 2:] * 440 + 450
        grey = ndimage.map_coordinates(WALLS[0][1], at.transpose(2, 0, 1), order=1, mode="mirror")
        Image.fromarray(np.stack([grey.astype(np.uint8)] * 3, -1)).save(folder / f"{i}.png")
    nothing = MaskStack([np.zeros((HEIGHT, WIDTH), bool)] * len(yaw))
    return open_frames(folder), GivenMasks(together=nothing)


def test_a_camera_that_turns_on_its_spot(tmp_path: Path) -> None:
    yaw = [0.0, 6.0, 12.0, 9.0]
    video, nothing = turning_video(tmp_path / "turns", yaw)

    def choose(**options):
        return cameras_of(video, nothing, tmp_path, **options)

    chosen = choose()
    track = chosen.track
    assert track.kind == "turning" and track.static and not chosen.warnings
    assert float(track.cameras[0].K[0, 0]) == pytest.approx(FOCAL, rel=0.02)  # found by itself
    poses = torch.stack([c.world_to_camera for c in track.cameras]).double()
    assert (poses[:, :3, 3] == 0).all()
    turned = poses[:, :3, :3] @ poses[0, :3, :3].mT
    found = torch.rad2deg(torch.atan2(turned[:, 0, 2], turned[:, 2, 2])).abs()
    assert found.numpy() == pytest.approx(np.array(yaw), abs=0.1)
    given = choose(camera="turning", focal=1.2 * FOCAL)
    assert float(given.track.cameras[0].K[0, 0]) == pytest.approx(1.2 * FOCAL, rel=1e-5)
    chosen = choose(camera="static", focal=FOCAL)
    assert chosen.track.figures["displacement_px"] > 50 and chosen.track.kind == "static"
    assert any("turns" in w and "declared static" in w for w in chosen.warnings)


def test_a_turning_camera_of_which_some_frames_show_no_background(tmp_path: Path) -> None:
    video, _ = turning_video(tmp_path / "turns", [0.0, 5.0, 10.0, 14.0])
    hidden = [np.full((HEIGHT, WIDTH), i == 1) for i in range(4)]

    def choose():
        masks = GivenMasks(together=MaskStack(hidden))
        return cameras_of(video, masks, tmp_path, camera="turning", focal=FOCAL)

    chosen = choose()
    assert any("background of 1 frames (1) was not found" in w for w in chosen.warnings)
    poses = torch.stack([c.world_to_camera[:3, :3] for c in chosen.track.cameras]).double()
    turned = poses[1] @ poses[0].mT  # half way to frame 2
    assert float(torch.rad2deg(torch.acos(turned[0, 0]))) == pytest.approx(5.0, abs=0.2)
    hidden[2][:] = True
    with pytest.raises(SourceError, match=r"4 of 4"):
        choose()


def test_the_way_of_a_moving_camera(tmp_path: Path) -> None:
    steps = [0.1 * i for i in range(COUNT)]
    video, masks = recorded(tmp_path / "moves", steps)
    chosen = cameras_of(video, masks, tmp_path, focal=FOCAL)
    track = chosen.track
    assert track.model is not None and track.positions == tuple(range(COUNT))
    assert track.figures["registered"] == COUNT and track.figures["reprojection_px"] < 1
    centers = np.stack([c.center.numpy() for c in track.cameras])
    way = centers - centers[0]
    along = way[-1] / np.linalg.norm(way[-1])
    done = way @ along / np.linalg.norm(way[-1])
    np.testing.assert_allclose(done, np.linspace(0, 1, COUNT), atol=0.02)
    off = np.linalg.norm(way - np.outer(way @ along, along), axis=1)
    assert off.max() < 0.03 * np.linalg.norm(way[-1])


def test_frames_with_a_camera_are_named_by_the_videos_numbers() -> None:
    video = SimpleNamespace(indices=[4, 6, 8, 10, 12, 14], times=[2, 3, 4, 5, 6, 7])
    images = [SimpleNamespace(name=f"{i:05d}.png") for i in (14, 4, 8, 10)]
    advice = _what_to_do(SimpleNamespace(images=dict(enumerate(images))), video)
    assert advice.startswith("Frames 4, 8, 10, 14 of the video have one")
    assert "--start 8f --end 11f uses the longest part of them, 1.0 s" in advice
    video.times = [t / 30 for t in video.times]
    assert "--start" not in _what_to_do(SimpleNamespace(images=dict(enumerate(images))), video)


def test_frames_without_features_are_refused_with_advice(tmp_path: Path) -> None:
    folder = tmp_path / "flat"
    folder.mkdir()
    for i in range(4):
        Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(folder / f"{i}.png")
    video = open_frames(folder)
    empty = GivenMasks(together=MaskStack([np.zeros((HEIGHT, WIDTH), bool)] * 4))
    with pytest.raises(SourceError, match=r"0 of 4 .*--camera static"):
        cameras_of(video, empty, tmp_path, camera="moving")


def test_features_and_matches_survive_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video, masks = recorded(tmp_path / "moves", [0.1 * i for i in range(COUNT)])
    work, done = tmp_path / "work", []

    def counted(name: str, killed: bool = False) -> None:
        real = getattr(pycolmap, name)

        def run(*arguments, **settings):
            done.append(name)
            found = real(*arguments, **settings)
            if killed:
                raise KeyboardInterrupt
            return found

        monkeypatch.setattr(pycolmap, name, run)

    counted("extract_features")
    counted("match_sequential", killed=True)
    with pytest.raises(KeyboardInterrupt):
        structure_from_motion(video, masks, work, focal=FOCAL)
    assert done == ["extract_features", "match_sequential"]
    assert (work / "features.db").is_file() and not (work / "matches-0.db").exists()
    monkeypatch.undo()
    done.clear()
    counted("extract_features")
    counted("match_sequential")
    resumed = pycolmap.Reconstruction(structure_from_motion(video, masks, work, focal=FOCAL).model)
    again = pycolmap.Reconstruction(structure_from_motion(video, masks, work, focal=FOCAL).model)
    assert done == ["match_sequential"], "features were kept, and then the matches, too"
    for image in resumed.images.values():
        twin = again.images[image.image_id]
        # mapping runs in threads, whose order moves the last digits: a degree, 1 % of the distance
        np.testing.assert_allclose(
            twin.cam_from_world().matrix(), image.cam_from_world().matrix(), atol=0.05
        )
    assert resumed.num_reg_images() == COUNT


def test_matches_are_drawn_by_a_fixed_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where matches are doubtful, RANSAC finds others in each run by itself, and these give other
    cameras: of a film in a hall 118 or all of 131, with focal lengths from 201 to 629 pixels."""
    video, masks = recorded(tmp_path / "moves", [0.1 * i for i in range(COUNT)])
    real, seeds = pycolmap.match_sequential, list[int]()

    def matched(*arguments, **settings):
        seeds.append(settings["verification_options"].ransac.random_seed)
        return real(*arguments, **settings)

    monkeypatch.setattr(pycolmap, "match_sequential", matched)
    structure_from_motion(video, masks, tmp_path / "work", focal=FOCAL)
    assert len(seeds) == 1 and seeds[0] >= 0


def test_a_focal_length_that_the_video_does_not_determine(tmp_path: Path) -> None:
    """Walls that face a camera which walks sideways look the same through every lens: what is
    twice as far away through twice the lens."""
    video, masks = recorded(tmp_path / "moves", [0.1 * i for i in range(COUNT)])
    chosen = cameras_of(video, masks, tmp_path, camera="moving")
    low, high = (chosen.track.figures[f"focal_{end}_px"] for end in ("low", "high"))
    assert low < FOCAL < high and high > 1.3 * low
    assert any("one start alone" in text for text in chosen.warnings)


def test_how_far_a_focal_length_is_known() -> None:
    """The halves of the frames, each by itself, lie to both sides of what all give."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=24, num_points3D=150,
        camera_model_id=pycolmap.CameraModelId.SIMPLE_RADIAL,
        camera_params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], camera_width=WIDTH, camera_height=HEIGHT,
    )  # fmt: skip
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model)
    low, high = _focals(pycolmap, model, [model], None) or (0, 0)
    assert 0.97 * FOCAL < low < high < 1.03 * FOCAL
    assert _focals(pycolmap, model, [model], (200, 400)) == (200, 400)


@pytest.mark.parametrize(("works", "tried", "confirmed"), [
    ({0: 300.0, 2: 301.0}, [0, 2], True),
    ({0: 300.0, 2: 400.0}, [0, 2], False),
    ({3: 170.0}, [0, 1, 2, 3], False),  # the last start: no other is left to confirm it
])  # fmt: skip
def test_no_start_confirms_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, works: dict[int, float], tried: list[int],
    confirmed: bool,
) -> None:  # fmt: skip
    video, masks = recorded(tmp_path / "moves", [0.1 * i for i in range(2)])
    starts = []

    def mapped(_colmap: Any, _matches: Path, _images: Path, folder: Path, _lens: Any) -> Any:
        starts.append(int(folder.name))
        focal = works.get(starts[-1])
        return focal and SimpleNamespace(
            cameras={1: SimpleNamespace(params=[focal])}, images={}, num_reg_images=lambda: 2,
            compute_num_observations=lambda: 9, write=lambda _folder: None,
        )  # fmt: skip

    for name in ("_extract", "_match"):
        monkeypatch.setattr(sfm, name, lambda *_: None)
    monkeypatch.setattr(sfm, "_mapped", mapped)
    found = structure_from_motion(video, masks, tmp_path / "work")
    assert starts == tried and found.confirmed == confirmed
    assert found.focals is not None and found.focals[0] <= min(works.values())

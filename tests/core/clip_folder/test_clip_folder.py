"""Clip folders: written whole or not at all, and read back as they were given."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hoigs.core.clip_folder.health import examine
from hoigs.core.clip_folder.write import ClipWriter, write_clip
from hoigs.core.errors import ClipError
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, ObjectTrack
from hoigs.core.values.moment import BodyPose
from hoigs.core.values.world import World
from hoigs.plugins.readers.clip import ClipFolderReader

FRAMES, WIDTH, HEIGHT = 8, 20, 14


def camera(frame: int = 0) -> Camera:
    w2c = torch.eye(4)
    w2c[0, 3] = 0.1 * frame
    K = torch.tensor([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(K, w2c, WIDTH, HEIGHT)


def body_track() -> BodyTrack:
    generator = torch.Generator().manual_seed(1)
    poses = BodyPose.zeros(FRAMES).map(lambda x: torch.randn(x.shape, generator=generator))
    return BodyTrack("body:anny", poses, "made up")


def object_track() -> ObjectTrack:
    return ObjectTrack(
        points=torch.rand(5, 3),
        colors=torch.rand(5, 3),
        rotations=torch.eye(3).expand(FRAMES, 3, 3),
        translations=torch.rand(FRAMES, 3),
        observed=torch.arange(FRAMES) != 3,
        provenance="made up too",
    )


def pixels(frame: int) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    rng = np.random.default_rng(frame)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    masks = {n: rng.random((HEIGHT, WIDTH)) > 0.5 for n in ("ann", "box")}
    depth = rng.random((HEIGHT, WIDTH)).astype(np.float32) + 1
    depth[0, 0] = 0
    return image, masks, depth


def write(folder: Path, **options: object) -> None:
    options = {"depth_kind": "metric", **options}
    entities = {"ann": "human", "box": "object"}
    with ClipWriter(folder, fps=24, entities=entities, **options) as writer:  # type: ignore[arg-type]
        for i in range(FRAMES):
            image, masks, depth = pixels(i)
            writer.add_frame(image, camera(i), masks, depth)
        for frame in (2, 5):
            image, masks, depth = pixels(100 + frame)
            writer.add_held_out(frame, image, camera(9), masks, depth)
        writer.set_body("ann", body_track())
        writer.set_object("box", object_track())
        writer.set_points(torch.rand(11, 3), torch.rand(11, 3))
        writer.provenance["by"] = "a test"


def test_round_trip(tmp_path: Path) -> None:
    write(tmp_path / "clip")
    clip = ClipFolderReader().read(tmp_path / "clip")
    assert len(clip) == clip.num_frames == FRAMES
    assert clip.kinds == {"ann": "human", "box": "object"}
    assert clip.fps == 24 and clip.depth_kind == "metric" and clip.name == "clip"
    assert clip.provenance == {"by": "a test"}
    assert sorted([*clip.split["train"], *clip.split["test"]]) == list(range(FRAMES))
    assert clip.points.shape == clip.point_colors.shape == (11, 3)
    for i, frame in enumerate(clip):
        image, masks, depth = pixels(i)
        assert torch.equal(frame.image, torch.from_numpy(image))
        for name, mask in masks.items():
            assert torch.equal(frame.masks[name], torch.from_numpy(mask))
        assert torch.equal(frame.depth, torch.from_numpy(depth))
        torch.testing.assert_close(frame.camera.world_to_camera, camera(i).world_to_camera)
        torch.testing.assert_close(frame.camera.K, camera(i).K)
        assert frame.moment.time == pytest.approx(i / (FRAMES - 1))
        torch.testing.assert_close(frame.moment.poses["ann"].body, body_track().poses.body[i])
    assert clip.bodies["ann"].model == "body:anny" and clip.bodies["ann"].provenance == "made up"
    assert clip.objects["box"].observed.tolist() == [i != 3 for i in range(FRAMES)]
    assert clip.objects["box"].provenance == "made up too"


def test_held_out_views_keep_the_moment_of_their_frame(tmp_path: Path) -> None:
    write(tmp_path / "clip")
    clip = ClipFolderReader().read(tmp_path / "clip")
    assert clip.held_out is not None
    assert [m.index for m in clip.held_out.moments] == [2, 5]
    assert clip.held_out[1].moment.time == clip[5].moment.time
    assert torch.equal(clip.held_out[1].image, torch.from_numpy(pixels(105)[0]))
    assert not clip.held_out.split["train"]


def test_jpg_and_float16_are_close(tmp_path: Path) -> None:
    write(tmp_path / "clip", image_format="jpg", depth_dtype=np.float16)
    clip = ClipFolderReader().read(tmp_path / "clip")
    assert (tmp_path / "clip/images/00000.jpg").is_file()
    assert clip[0].depth is not None and clip[0].depth.dtype == torch.float32
    torch.testing.assert_close(clip[0].depth, torch.from_numpy(pixels(0)[2]), atol=1e-3, rtol=0)
    error = (clip[0].image.float() - torch.from_numpy(pixels(0)[0]).float()).abs().mean()
    assert error < 8  # of 255, on pure noise, the hardest picture for jpg


def test_write_clip_copies_any_clip(tmp_path: Path) -> None:
    write(tmp_path / "first")
    clip = ClipFolderReader().read(tmp_path / "first")
    write_clip(clip.resized(10), tmp_path / "second")
    small = ClipFolderReader().read(tmp_path / "second")
    assert (small.cameras[0].width, small.cameras[0].height) == (10, 7)
    assert small.held_out is not None and len(small.held_out) == 2
    assert small.split == clip.split
    torch.testing.assert_close(small.cameras[3].K, clip.resized(10).cameras[3].K)


def test_an_object_whose_rotation_is_unknown_stays_so(tmp_path: Path) -> None:
    write(tmp_path / "first")
    clip = ClipFolderReader().read(tmp_path / "first")
    (name, track), *_ = clip.objects.items()
    assert track.rotation_known
    outline = replace(track, rotation_known=False)
    write_clip(replace(clip, objects={**clip.objects, name: outline}), tmp_path / "second")
    assert not ClipFolderReader().read(tmp_path / "second").objects[name].rotation_known


def test_the_world_travels_with_who_knows_it(tmp_path: Path) -> None:
    world = World(up=(0.1, -0.9, 0.2), floor=-1.5, known="floor")
    write(tmp_path / "clip")
    older = ClipFolderReader().read(tmp_path / "clip")
    assert older.world.is_guess  # a folder of before there was such a key
    write_clip(replace(older, world=world), tmp_path / "new")
    found = ClipFolderReader().read(tmp_path / "new")
    assert found.world.up == pytest.approx(world.up) and found.held_out is not None
    assert replace(found.world, up=world.up) == world and found.held_out.world == found.world


@pytest.mark.parametrize(
    ("key", "value"), [("up", [0, 0, 0]), ("up", [0, 1]), ("floor", "low"), ("known", "me")]
)
def test_a_world_that_means_nothing_is_named(key: str, value: object, tmp_path: Path) -> None:
    write(tmp_path / "clip")
    header = json.loads((tmp_path / "clip" / "clip.json").read_text())
    header["world"] = {"up": [0, 1, 0], key: value}
    (tmp_path / "clip" / "clip.json").write_text(json.dumps(header))
    with pytest.raises(ClipError, match=rf"world\.{key}"):
        ClipFolderReader().read(tmp_path / "clip")


def test_replaces_an_older_clip_only(tmp_path: Path) -> None:
    write(tmp_path / "clip")
    write(tmp_path / "clip", name="again")
    assert json.loads((tmp_path / "clip/clip.json").read_text())["name"] == "again"
    assert [p.name for p in tmp_path.iterdir()] == ["clip"]
    precious = tmp_path / "photos"
    precious.mkdir()
    (precious / "me.txt").write_text("keep")
    with pytest.raises(ClipError, match="is not empty and holds no clip"):
        write(precious)
    assert (precious / "me.txt").read_text() == "keep"


def test_a_clip_with_other_peoples_files_is_not_replaced(tmp_path: Path) -> None:
    write(tmp_path / "clip")
    mine = tmp_path / "clip" / "masks" / "sketch.psd"
    mine.write_text("keep")
    with pytest.raises(ClipError, match=r"masks/sketch\.psd in it did not come from"):
        write(tmp_path / "clip")
    assert mine.read_text() == "keep"
    mine.unlink()
    (tmp_path / "clip" / "points.npz").unlink()
    with pytest.raises(ClipError, match=r"not a complete clip \(points\.npz absent\)"):
        write(tmp_path / "clip")


def test_an_exception_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with ClipWriter(tmp_path / "clip", fps=24, entities={}) as writer:
            image, masks, depth = pixels(0)
            writer.add_frame(image, camera(), masks, depth)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_clip_is_refused_whole(tmp_path: Path) -> None:
    def unfinished() -> None:
        with ClipWriter(tmp_path / "clip", fps=24, entities={"box": "object"}) as writer:
            image, masks, _ = pixels(0)
            writer.add_frame(image, camera(), {"box": masks["box"]})
            writer.add_frame(image, camera(), {})

    with pytest.raises(ClipError) as error:
        unfinished()
    for part in ("masks/box/00001.png is absent", "objects/box.npz is absent", "points.npz"):
        assert part in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_size_and_empty_clip_errors(tmp_path: Path) -> None:
    image, masks, _ = pixels(0)
    wrong = replace(camera(), width=99)
    with (
        pytest.raises(ClipError, match="image is 20x14 and its camera 99x14"),
        ClipWriter(tmp_path / "clip", fps=24, entities={}) as writer,
    ):
        writer.add_frame(image, wrong, masks)
    with (
        pytest.raises(ClipError, match="no frame was added"),
        ClipWriter(tmp_path / "clip", fps=24, entities={}),
    ):
        pass


def test_ignored_pixels_travel_with_their_frames(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    blank = np.zeros((HEIGHT, WIDTH), dtype=bool)
    blank[:4] = True
    with ClipWriter(folder, fps=24, entities={"box": "object"}) as writer:
        for i in range(FRAMES):
            image, masks, _ = pixels(i)
            writer.add_frame(
                image, camera(i), {"box": masks["box"]}, ignored=blank if i == 2 else None
            )
        writer.set_object("box", object_track())
        writer.set_points(torch.rand(4, 3), torch.rand(4, 3))
    clip = ClipFolderReader().read(folder)
    assert clip[1].ignored is None
    assert torch.equal(clip[2].ignored, torch.from_numpy(blank))
    small = clip.resized(WIDTH // 2)[2].ignored
    assert small is not None and small[:2].all() and not small[2:].any()
    write_clip(clip, tmp_path / "again")
    assert torch.equal(ClipFolderReader().read(tmp_path / "again")[2].ignored, clip[2].ignored)
    (folder / "ignored" / "00003.png").write_bytes(b"no picture")
    with pytest.raises(ClipError, match=r"ignored/00003.png: not a readable image"):
        ClipFolderReader().read(folder)


def test_a_mask_of_ones_is_not_taken_for_an_empty_one(tmp_path: Path) -> None:
    write(tmp_path / "clip")
    path = tmp_path / "clip/masks/ann/00003.png"
    Image.new("L", (WIDTH, HEIGHT), 1).save(path)
    clip = ClipFolderReader().read(tmp_path / "clip")
    assert clip[2].masks["ann"].any()
    with pytest.raises(
        ClipError, match=r"00003\.png: its brightest pixel is 1, but a mask has 255"
    ):
        examine(clip)
    Image.new("L", (WIDTH, HEIGHT), 0).save(path)
    assert "empty-masks" in [fault.kind for fault in examine(clip)]

"""estimator:depth-files: all formats give the same depth; metres and disparity are never
guessed."""

from __future__ import annotations

from typing import Any

import av
import numpy as np
import pytest
from estimator_cases import FRAMES, HEIGHT, WIDTH, metric, request
from PIL import Image

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import checked
from hoigs.plugins.estimators.depth_files import DepthFilesEstimator, read_exr


def made_depth_files(**settings: Any) -> DepthFilesEstimator:
    return DepthFilesEstimator(DepthFilesEstimator.Config(**settings))


def write_exr(path, depth: np.ndarray) -> None:
    """A 32-bit EXR with three equal channels."""
    with av.open(str(path), "w", format="image2") as container:
        stream = container.add_stream("exr", rate=1)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gbrpf32le"
        frame = av.VideoFrame(WIDTH, HEIGHT, "gbrpf32le")
        for plane in frame.planes:
            rows = np.zeros((HEIGHT, plane.line_size // 4), np.float32)
            rows[:, :WIDTH] = depth
            plane.update(rows.tobytes())
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write(folder, suffix: str) -> None:
    folder.mkdir()
    for i in range(FRAMES):
        path = folder / f"frame_{i:04d}{suffix}"
        if suffix == ".png":
            Image.fromarray(np.round(1000 * metric(i)).astype(np.uint16)).save(path)
        elif suffix == ".npy":
            np.save(path, metric(i)[None])
        elif suffix == ".npz":
            np.savez(path, depth=metric(i))
        else:
            write_exr(path, metric(i))


def maps_of(estimator: DepthFilesEstimator, video):
    return checked(estimator.estimate(video), video, estimator).depth


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png", ".exr"])
def test_folders(tmp_path, suffix):
    write(tmp_path / "depth", suffix)
    scale = 0.001 if suffix == ".png" else None
    depth = maps_of(
        made_depth_files(kind="metric", scale=scale),
        request(tmp_path),
    )
    assert depth.kind == "metric"
    for i in range(FRAMES):
        np.testing.assert_allclose(depth.maps[i], metric(i), atol=6e-4 if scale else 0)


@pytest.mark.parametrize("name", ["d.npy", "d.npz"])
def test_one_array_for_all_frames(tmp_path, name):
    stack = np.stack([metric(i) for i in range(FRAMES)])
    if name == "d.npy":
        np.save(tmp_path / name, stack.astype(np.float16))
    else:
        np.savez_compressed(tmp_path / name, depths=stack.astype(np.float16))
    depth = maps_of(
        made_depth_files(path=name, kind="disparity"),
        request(tmp_path),
    )
    np.testing.assert_allclose(depth.maps[3], metric(3), rtol=1e-3)
    with pytest.raises(HoigsError, match=rf"{name} has 5 frames, the video has 9"):
        made_depth_files(path=name, kind="disparity").estimate(request(tmp_path, frames=9))


def test_what_is_not_known_is_nan(tmp_path):
    stack = np.stack([metric(i) for i in range(FRAMES)])
    stack[0, 0, :4] = (0, -1, np.inf, np.nan)
    stack[0, 1, 0] = 65.535
    np.save(tmp_path / "d.npy", stack)
    depth = maps_of(
        made_depth_files(path="d.npy", kind="metric", scale=2.0, invalid=65.535),
        request(tmp_path),
    )
    assert np.isnan(depth.maps[0][0, :4]).all() and np.isnan(depth.maps[0][1, 0])
    assert np.isnan(depth.maps[0]).sum() == 5
    assert depth.maps[0][5, 5] == 2 * stack[0, 5, 5]
    # disparity of 0 is what is far away
    depth = maps_of(
        made_depth_files(path="d.npy", kind="disparity"),
        request(tmp_path),
    )
    assert depth.maps[0][0, 0] == 0 and np.isnan(depth.maps[0][0, 2:4]).all()


def test_kinds_are_said_or_refused(tmp_path):
    stack = np.stack([metric(i) for i in range(FRAMES)])
    np.savez(tmp_path / "a.npz", depth=stack)
    with pytest.raises(HoigsError, match="does not declare whether it holds metres or disparity"):
        made_depth_files(path="a.npz").estimate(request(tmp_path))
    np.savez(tmp_path / "b.npz", disparity=stack)
    assert maps_of(made_depth_files(path="b.npz"), request(tmp_path)).kind == "disparity"
    with pytest.raises(HoigsError, match="declares that it holds disparity, but `kind` is metric"):
        made_depth_files(path="b.npz", kind="metric").estimate(request(tmp_path))
    np.savez(tmp_path / "c.npz", depth=stack, kind="metric")
    assert maps_of(made_depth_files(path="c.npz"), request(tmp_path)).kind == "metric"
    np.savez(tmp_path / "d.npz", depth=stack, kind="log")
    with pytest.raises(HoigsError, match='its `kind` is "log", expected metric or disparity'):
        made_depth_files(path="d.npz").estimate(request(tmp_path))


def test_pngs_need_a_scale_and_sixteen_bits(tmp_path):
    write(tmp_path / "depth", ".png")
    with pytest.raises(HoigsError, match="set `scale`"):
        made_depth_files(kind="metric").estimate(request(tmp_path))
    (tmp_path / "grey").mkdir()
    for i in range(FRAMES):
        Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / "grey" / f"{i}.png")
    depth = made_depth_files(path="grey", kind="disparity").estimate(request(tmp_path)).depth
    with pytest.raises(HoigsError, match="a picture of depth"):
        depth.maps[0]


def test_pictures_in_exr_are_refused(tmp_path):
    write(tmp_path / "depth", ".exr")
    path = tmp_path / "colours.exr"
    with av.open(str(path), "w", format="image2") as container:
        stream = container.add_stream("exr", rate=1)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gbrpf32le"
        rgb = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        frame = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(format="gbrpf32le")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(HoigsError, match="its channels differ"):
        read_exr(path)
    (tmp_path / "depth" / "frame_0002.exr").write_bytes(b"nothing")
    with pytest.raises(HoigsError, match=r"frame_0002\.exr is no EXR file"):
        made_depth_files(kind="metric").estimate(request(tmp_path))


def test_one_message_names_all(tmp_path):
    write(tmp_path / "depth", ".npy")
    (tmp_path / "depth" / "frame_0003.npy").unlink()
    np.save(tmp_path / "depth" / "frame_0001.npy", np.ones((8, 8), np.float32))
    np.save(tmp_path / "depth" / "frame_0002.npy", np.ones(8, np.float32))
    with pytest.raises(HoigsError) as caught:
        DepthFilesEstimator().estimate(request(tmp_path))
    text = str(caught.value)
    for part in (
        "lacks 1 of 5 frames: 3", "frame_0001.npy: 8x8, the video is 32x24",
        "frame_0002.npy: an array of shape (8,)", "set `kind: metric`", "DepthCrafter",
    ):  # fmt: skip
        assert part in text, part
    with pytest.raises(HoigsError, match='did you mean "depth"'):
        made_depth_files(path="depths", kind="metric").estimate(request(tmp_path))
    np.savez(tmp_path / "two.npz", a=np.ones((FRAMES, 4, 4)), b=np.ones((FRAMES, 4, 4)))
    with pytest.raises(HoigsError, match="holds a, b; name the array of depth with `key`"):
        made_depth_files(path="two.npz", kind="metric").estimate(request(tmp_path))


def test_maps_of_a_size_that_a_network_likes(tmp_path):
    """DepthCrafter rounds to multiples of 64: shapes within a tenth are taken if that is said."""
    stack = np.repeat(np.arange(FRAMES, dtype=np.float32)[:, None, None], 12, 1).repeat(17, 2)
    stack[:, :, 9:] = np.nan
    np.save(tmp_path / "d.npy", stack + 1)
    with pytest.raises(HoigsError, match="17x12, the video is 32x24"):
        made_depth_files(path="d.npy", kind="metric").estimate(request(tmp_path))
    depth = maps_of(
        made_depth_files(path="d.npy", kind="metric", resize=True),
        request(tmp_path),
    )
    assert depth.maps[2].shape == (HEIGHT, WIDTH) and depth.maps[2][0, 0] == 3
    assert np.isnan(depth.maps[2]).mean() == pytest.approx(8 / 17, abs=0.03)

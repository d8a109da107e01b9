"""Films: frames are those of SceneModel.render; what goes in comes out; no rest of a failure."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from hoigs.core.system.video_files import write_video


def test_frames_come_back(tmp_path: Path) -> None:
    colors = [np.array((20 + 40 * i, 120, 200 - 40 * i), np.uint8) for i in range(5)]
    frames = [np.full((33, 48, 3), color) for color in colors]
    path = write_video(tmp_path / "deep" / "clip.mp4", frames, fps=12.5)
    with av.open(str(path)) as container:
        decoded = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        stream = container.streams.video[0]
        assert stream.average_rate == 12.5
        assert stream.codec_context.colorspace == 1  # BT.709: players guess what is not declared
    assert len(decoded) == 5 and decoded[0].shape == (32, 48, 3)
    for i, image in enumerate(decoded):
        assert np.abs(image.mean((0, 1)) - colors[i]).max() < 4


@pytest.mark.parametrize("suffix", [".mov", ".webm"])
def test_equal_pictures_give_equal_files(tmp_path: Path, suffix: str) -> None:
    """A width of no whole number of blocks, whose rows once ended with what the memory held."""
    random = np.random.default_rng(0)
    frames = [random.integers(0, 255, (30, 42, 4)).astype(np.uint8) for _ in range(2)]
    files = set()
    for i in range(8):
        random.integers(0, 255, 4000 * i).astype(np.uint8)  # memory that is used again
        files.add(write_video(tmp_path / f"{i}{suffix}", frames, fps=10).read_bytes())
    assert len(files) == 1


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    def breaks():
        yield np.zeros((16, 16, 3), np.uint8)
        raise RuntimeError("out of paint")

    with pytest.raises(RuntimeError, match="paint"):
        write_video(tmp_path / "a.mp4", breaks(), fps=10)
    sizes = [np.zeros((16, 16, 3), np.uint8), np.zeros((16, 18, 3), np.uint8)]
    with pytest.raises(ValueError, match="18x16"):
        write_video(tmp_path / "a.mp4", sizes, fps=10)
    with pytest.raises(ValueError, match="at least one"):
        write_video(tmp_path / "a.mp4", [], fps=10)
    assert list(tmp_path.iterdir()) == []

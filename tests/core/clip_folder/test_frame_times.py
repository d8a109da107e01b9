"""Frames that are not evenly spaced keep their times, from the clip folder to rendered moments."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from test_clip_folder import FRAMES, camera, object_track, pixels, write

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.clip_folder.health import examine
from hoigs.core.clip_folder.write import ClipWriter, write_clip
from hoigs.core.errors import ClipError
from hoigs.core.maths.frame_times import TrainedFrames, frame_at, time_of
from hoigs.core.values.between import frame_numbers, frame_of, moment_between
from hoigs.plugins.deformation.rigid_track import RigidTrack
from hoigs.plugins.readers.clip import ClipFolderReader

SECONDS = np.cumsum([0.1 if i % 2 else 0.3 for i in range(FRAMES)]).tolist()  # from 0.3 on
SHARES = tuple((s - SECONDS[0]) / (SECONDS[-1] - SECONDS[0]) for s in SECONDS)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with ClipWriter(tmp_path / "clip", fps=1, entities={"box": "object"}) as writer:
        for i in range(FRAMES):
            image, masks, _ = pixels(i)
            writer.add_frame(image, camera(i), {"box": masks["box"]})
        writer.set_object("box", object_track())
        writer.set_points(torch.rand(11, 3), torch.rand(11, 3))
        writer.set_times(SECONDS)
    return tmp_path / "clip"


def test_times_come_back_and_are_written_again(folder: Path, tmp_path: Path) -> None:
    clip = ClipFolderReader().read(folder)
    assert [m.time for m in clip.moments] == pytest.approx(SHARES)
    assert clip.fps == pytest.approx((FRAMES - 1) / (SECONDS[-1] - SECONDS[0]))
    assert clip.frame_times == clip.objects["box"].times == pytest.approx(SHARES)
    write_clip(clip, tmp_path / "again")
    again = ClipFolderReader().read(tmp_path / "again")
    assert again.frame_times == pytest.approx(SHARES) and again.fps == pytest.approx(clip.fps)
    assert not [d for d in examine(clip) if d.kind == "missing-frames"]
    write(tmp_path / "even")
    even = ClipFolderReader().read(tmp_path / "even")
    assert even.frame_times is None and even.objects["box"].times is None
    assert even.held_out.frame_times is None


def test_rendered_moments_are_evenly_spaced_in_time(folder: Path) -> None:
    clip = ClipFolderReader().read(folder)
    numbers, _ = frame_numbers(clip, fps=3 * clip.fps)
    times = [moment_between(clip, number).time for number in numbers]
    np.testing.assert_allclose(times, np.linspace(0, 1, len(times)), atol=1e-6)
    assert len(times) == 3 * (FRAMES - 1) + 1
    assert frame_of(clip, clip.moments[3]) == pytest.approx(3)
    low, high = (clip.moments[i].time for i in (2, 3))
    assert moment_between(clip, 2.5).time == pytest.approx((low + high) / 2)


def test_what_is_known_of_a_frame_is_at_its_time(folder: Path) -> None:
    track = ClipFolderReader().read(folder).objects["box"]
    motion, frames = RigidTrack(track), TrainedFrames(FRAMES, [0, 2, 4, FRAMES - 1], SHARES)
    for i, time in enumerate(SHARES):
        for at in (time, torch.tensor(time)):
            torch.testing.assert_close(motion.at(at)[1], track.translations[i], atol=2e-4, rtol=0)
            assert float(frame_at(at, FRAMES, SHARES)) == pytest.approx(i, abs=1e-4)
        assert time_of(i, FRAMES, SHARES) == pytest.approx(time)
    low, high, r = frames.neighbours(SHARES[3])
    assert (low, high) == (2, 4) and r == pytest.approx(0.5)
    # velocities are those of the places, by finite differences
    step, time, origin = 1e-3, (SHARES[2] + SHARES[3]) / 2, torch.zeros(1, 3)
    before, after = (motion.carry(origin, time + s) for s in (-step, step))
    for at in (time, torch.tensor(time)):
        velocity = motion.velocity(origin, at, torch.zeros(1, 3), 1.0)
        torch.testing.assert_close(velocity, (after - before) / (2 * step), atol=2e-2, rtol=2e-2)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 1.0], "times has 2 entries for"),
        ([0.0, 0.5, 0.4, *range(1, FRAMES - 2)], "begin with 0 and to ascend"),
        ([float(i) for i in range(FRAMES)], "but times have 1 frames a second"),
    ],
)
def test_times_that_cannot_be(folder: Path, times: list[float], message: str) -> None:
    header = json.loads((folder / "clip.json").read_text())
    (folder / "clip.json").write_text(json.dumps({**header, "times": times}))
    assert message in " ".join(str(problem) for problem in check_clip(folder))


def test_a_time_for_each_frame(tmp_path: Path) -> None:
    with (
        pytest.raises(ClipError, match="2 times for 1 frames"),
        ClipWriter(tmp_path / "clip", fps=1, entities={}) as writer,
    ):
        image, _, _ = pixels(0)
        writer.add_frame(image, camera(0), {})
        writer.set_points(torch.rand(11, 3), torch.rand(11, 3))
        writer.set_times([0.0, 1.0])

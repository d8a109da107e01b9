"""Estimators by options stand in for the files beside a video; folders of frames for the video."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny import FRAMES, HEIGHT, WIDTH, landmarks, masks, picture

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.errors import HoigsError, SpecError
from hoigs.core.interfaces.estimator import Estimates, Estimator, Landmarks
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.preparation.estimates.installed import load_options
from hoigs.preparation.estimates.reader import chosen_landmarks
from hoigs.preparation.prepare import PrepareOptions, prepare, prepare_until, work_folder
from hoigs.preparation.video.frames import Choice, FolderFrames, VideoFrames, open_frames
from hoigs.preparation.video.source import (
    NobodyFoundError,
    SourceError,
    find_source,
    numbered_frames,
)

QUICK = ["fit_steps=3", "overlay_width=0"]


@pytest.fixture
def bare_frames(tmp_path: Path) -> Path:
    """A folder of frames alone, and evidence somewhere else."""
    frames, other = tmp_path / "bare", tmp_path / "estimators"
    frames.mkdir()
    for name in ("human", "object"):
        (other / "sam2" / name).mkdir(parents=True)
    for i in range(FRAMES):
        Image.fromarray(picture(i)).save(frames / f"frame_{i}.png")
        for name, mask in zip(("human", "object"), masks(i), strict=True):
            Image.fromarray(mask).save(other / f"sam2/{name}/{i:05d}.png")
    np.savez(other / "pose.npz", **landmarks())
    return frames


def test_frames_alone_with_priors_by_options(bare_frames: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "estimators:\n  masks: {use: 'estimator:masks-files', path: ../estimators/sam2}\n"
        "folder_fps: 12\n"
    )
    settings = [
        "estimators.landmarks.use=estimator:landmarks-files",
        "estimators.landmarks.path=../estimators/pose.npz",
    ]
    options = load_options(file, settings + QUICK, {"max_frames": 8, "every": None})
    out = tmp_path / "clip"
    report = prepare(bare_frames, out, body=AnnyBody(), options=options)
    assert check_clip(out) == [] and report.frames == 8 and report.fps == 12
    clip = ClipFolderReader().read(out)
    for i in (0, 7):
        for name, mask in zip(("human", "object"), masks(i), strict=True):
            found = clip[i].masks[name].numpy()
            assert (found == mask).mean() > 0.999
    # edited masks are seen by the next run
    (bare_frames.parent / "estimators/sam2/object/00003.png").unlink()
    with pytest.raises(HoigsError, match=r"1 of 8 .*3"):
        prepare(bare_frames, out, body=AnnyBody(), options=options, redo=["write"])


def test_frames_are_ordered_by_number(bare_frames: Path) -> None:
    names = [p.name for p in numbered_frames(bare_frames)]
    assert names[:3] == ["frame_0.png", "frame_1.png", "frame_2.png"] and len(names) == FRAMES
    frames = open_frames(bare_frames, choice=Choice(every=4, folder_fps=12))
    assert isinstance(frames, FolderFrames) and frames.fps == 3 and frames.indices == [0, 4, 8]
    for i, image in zip(frames.indices, frames, strict=True):
        np.testing.assert_array_equal(image, picture(i))
    np.testing.assert_array_equal(frames.read(5), picture(5))
    Image.new("RGB", (8, 8)).save(bare_frames / "frame_99.png")
    with pytest.raises(SourceError, match=r"frame 12.*8x8.*96x64"):
        open_frames(bare_frames)


def test_a_folder_may_keep_frames_inside(bare_frames: Path, tmp_path: Path) -> None:
    inside = tmp_path / "folder/frames"
    inside.parent.mkdir()
    bare_frames.rename(inside)
    found = find_source(inside.parent, given={"masks", "landmarks"})
    assert found.video == inside and found.folder == inside.parent
    assert not found.beside


def test_the_sharpest_of_each_window(tmp_path: Path) -> None:
    from scipy import ndimage

    folder = tmp_path / "frames"
    folder.mkdir()
    sharp = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    best = {1, 3, 8}
    for i in range(9):
        image = sharp if i in best else ndimage.gaussian_filter(sharp, (2, 2, 0))
        Image.fromarray(image).save(folder / f"{i}.png")
    assert open_frames(folder, choice=Choice(every=3, pick="sharpest")).indices == [1, 3, 8]
    assert open_frames(folder, choice=Choice(every=3)).indices == [0, 3, 6]
    at_ten = open_frames(
        folder, choice=Choice(fps=10, folder_fps=30, pick="sharpest", max_frames=2)
    )
    assert at_ten.indices == [1, 3] and at_ten.fps == 10
    with pytest.raises(SourceError, match="video's 30"):
        open_frames(folder, choice=Choice(fps=31, folder_fps=30))


def test_a_video_reads_any_frame(tiny_video: Path) -> None:
    video = VideoFrames(tiny_video, choice=Choice(max_frames=2), width=48)
    assert video.count() == FRAMES
    for number in (3, 7, 2):
        image = video.read(number)
        assert np.abs(image.astype(int) - picture(number)).mean() < 6
    with pytest.raises(SourceError, match=r"12 .*40"):
        video.read(40)


def test_wrong_settings_are_named_with_their_place(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("estimators:\n  masks: {use: 'estimator:masks-files', pth: sam2}\n")
    with pytest.raises(SpecError, match=r"mine\.yaml:2:.* estimators\.masks\.pth.*path"):
        load_options(file)
    with pytest.raises(SpecError, match=r"estimators\.depth\.use.*initializer:sfm"):
        load_options(None, ["estimators.depth.use=initializer:sfm"])
    with pytest.raises(SpecError, match=r"evry.*every"):
        load_options(None, ["evry=2"])


class FlatPrior(Estimator):
    """Landmarks in the image alone."""

    provides = frozenset({"landmarks"})

    def estimate(self, video, progress=lambda done, text: None) -> Estimates:
        track = Landmarks(landmarks()["image_xyzv"], None, "flat")
        return Estimates(landmarks={"human": track})


def test_landmarks_without_space_are_enough(tiny_source: Path, tmp_path: Path) -> None:
    report = prepare(
        tiny_source, tmp_path / "clip", body=AnnyBody(),
        options=PrepareOptions(fit_steps=30, overlay_width=0),
        estimators={"landmarks": FlatPrior()},
    )  # fmt: skip
    assert check_clip(tmp_path / "clip") == [] and report.body_residual_px < 4
    assert "known in the image only" in " ".join(report.warnings)


def test_a_prior_of_other_evidence_is_refused(tiny_source: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"FlatPrior.*landmarks.*masks"):
        prepare_until(
            "estimates", tiny_source, tmp_path / "clip", body=AnnyBody(),
            options=PrepareOptions(fit_steps=3), estimators={"masks": FlatPrior()},
        )  # fmt: skip


def test_depth_beside_the_video_says_what_it_is_or_is_left_out(
    tiny_source: Path, tmp_path: Path
) -> None:
    (tiny_source / "depth").mkdir()
    options = PrepareOptions(fit_steps=3, overlay_width=0)
    for name, used in (("values", False), ("metric_depth", True)):
        for i in range(FRAMES):
            depth = np.full((HEIGHT, WIDTH), 2.8, np.float32)
            np.savez(tiny_source / f"depth/{i:05d}.npz", **{name: depth})
        out = tmp_path / name
        report = prepare(tiny_source, out, body=AnnyBody(), options=options)
        left_out = [
            w for w in report.warnings if w.startswith("depth/ beside the video is not used")
        ]
        assert (report.depth_residual is not None) == used and len(left_out) == (not used)
        assert used or "does not declare whether it holds metres or disparity" in left_out[0]
        assert ClipFolderReader().read(out).depth_kind == ("metric" if used else "none")


COMMAND = """
estimators:
  masks: {{use: "estimator:command", command: "touch {mark}", masks: {{path: .}}}}
  landmarks: {{use: "estimator:mediapipe", python: env/bin/python}}
"""


def test_commands_of_options_need_permission(tiny_source: Path, tmp_path: Path) -> None:
    file, mark = tmp_path / "theirs.yaml", tmp_path / "ran"
    file.write_text(COMMAND.format(mark=mark))
    options = load_options(file)
    for run in (
        lambda: prepare(tiny_source, tmp_path / "clip", body=AnnyBody(), options=options),
        lambda: prepare_until(
            "estimates", tiny_source, tmp_path / "clip", body=AnnyBody(), options=options
        ),
    ):
        with pytest.raises(SpecError) as refused:
            run()
        message = str(refused.value)
        assert f"estimators.masks: touch {mark}" in message and "--allow-commands" in message
        assert "estimators.landmarks: env/bin/python -I mediapipe_script.py" in message
    assert not mark.exists() and not work_folder(tmp_path / "clip").exists()
    # allowed, it runs: what it wrote is looked for
    settings = [f"estimators.masks.command=touch {mark}", "estimators.masks.use=estimator:command",
                "estimators.masks.masks.path=."]  # fmt: skip
    with pytest.raises(HoigsError, match="exited with 0"):
        prepare(
            tiny_source, tmp_path / "clip", body=AnnyBody(), options=load_options(None, settings),
            allow_commands=True,
        )  # fmt: skip
    assert mark.exists()


def test_who_is_found_in_few_frames_and_never_at_once_is_nobody(tmp_path: Path) -> None:
    """A cat is taken for a person in a tenth of the frames, all of them at a second look."""
    for i in range(20):
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(tmp_path / f"{i:02d}.png")
    video = open_frames(tmp_path)
    image = np.full((20, 33, 4), np.nan, np.float32)
    image[[8, 9]] = 1.0
    late = Landmarks(image, None, repaired={"a second look": [8, 9]})
    with pytest.raises(NobodyFoundError, match="in 18 of the 20 chosen frames"):
        chosen_landmarks(late, video, "late", "given", placed=False)
    assert chosen_landmarks(late, video, "late", "given", placed=True).found.sum() == 2
    once = Landmarks(image, None, repaired={"a second look": [3, 8]})
    assert chosen_landmarks(once, video, "once", "given", placed=False).found.sum() == 2
    image[4:8] = 1.0
    often = Landmarks(image, None, repaired={"a second look": list(range(4, 10))})
    assert chosen_landmarks(often, video, "often", "given", placed=False).found.sum() == 6

"""estimator:command and estimator:mediapipe: subprocesses, what they write, how they fail, and
resuming."""

from __future__ import annotations

import json
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimator_cases import FRAMES, HEIGHT, WIDTH, mask, request
from pydantic import ValidationError
from tiny_mediapipe import FAKE_CV2, FAKE_LOOK, FAKE_MODEL

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.estimator import EntityRequest, checked
from hoigs.core.registry.registry import default_registry
from hoigs.plugins.estimators.mediapipe.estimator import MediapipeEstimator
from hoigs.plugins.estimators.mediapipe.mediapipe_doubts import LOST, NOBODY, OFF

# a tool like those of the field: a folder of frames in, masks and one depth array out; it finds
# what is bright, and writes down that it ran
TOOL = """
import sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from PIL import Image
frames, out, extra = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
print("working on", extra)
with open(Path(__file__).with_suffix(".runs"), "a") as runs:
    runs.write("x")
if extra == "fail":
    sys.exit("out of memory, as ever")
(out / "human").mkdir()
depth = []
for path in sorted(frames.iterdir()):
    grey = np.asarray(Image.open(path).convert("L"))
    Image.fromarray(((grey > 100) * 255).astype(np.uint8)).save(out / "human" / path.name)
    depth.append(grey / np.float32(8) + 1)
if extra != "short":
    np.savez_compressed(out / "clip_depths.npz", depths=np.stack(depth))
"""
HUMAN = (EntityRequest("human", "human"),)


def mediapipe_estimator(**settings: Any) -> MediapipeEstimator:
    return MediapipeEstimator(MediapipeEstimator.Config(**settings))


@pytest.fixture
def tool(tmp_path) -> Path:
    path = tmp_path / "some folder" / "tool.py"
    path.parent.mkdir()
    path.write_text(TOOL)
    return path


def command(tool: Path, extra: str = "{width}x{height}", **changes):
    """The estimator, built from settings as a spec has them."""
    settings = {
        "command": f"{shlex.quote(sys.executable)} {shlex.quote(str(tool))} {{frames}} {{out}} "
        f"{extra}",
        "masks": {"path": "."},
        "depth": {"path": "clip_depths.npz", "kind": "disparity"},
    } | changes
    registry = default_registry()
    config = registry.config_class("estimator:command").model_validate(settings)
    return registry.get("estimator:command").from_config(config, BuildContext())


def test_a_command_gives_what_it_writes_and_is_not_run_twice(tmp_path, tool):
    # only some frames are wanted: arrays still have a row for each
    video = request(tmp_path, entities=HUMAN, wanted=(0, 2, 4))
    estimator = command(tool)
    assert estimator.provides == {"masks", "depth"}
    assert type(estimator).provides == {"masks", "landmarks", "depth"}  # what a command may give
    assert repr(estimator) == repr(command(tool))  # results are kept under this name
    told = []
    estimates = checked(
        estimator.estimate(video, lambda *step: told.append(step)), video, estimator
    )
    for i in range(FRAMES):
        assert np.array_equal(estimates.masks.entities["human"][i], mask("human", i))
    assert estimates.depth.kind == "disparity" and len(estimates.depth.maps) == FRAMES
    assert told[0][0] == 0 and told[-1][0] == 1
    log = next((tmp_path / "work").glob("command-*.log"))
    assert log.read_text() == f"working on {WIDTH}x{HEIGHT}\n"
    estimator.estimate(video)
    assert tool.with_suffix(".runs").read_text() == "x"
    command(tool, "again").estimate(video)  # another command is another run
    assert tool.with_suffix(".runs").read_text() == "xx"


def test_a_run_that_was_cut_short_is_done_again(tmp_path, tool):
    video = request(tmp_path, entities=HUMAN)
    estimator = command(tool)
    estimator.estimate(video)
    next((tmp_path / "work").glob("*.done")).unlink()
    out = next((tmp_path / "work").glob("*.out"))
    (out / "human" / "00009.png").write_bytes(b"half")
    estimator.estimate(video)
    assert len(list((out / "human").iterdir())) == FRAMES


def test_failures_show_the_command_and_its_last_words(tmp_path, tool):
    with pytest.raises(HoigsError) as caught:
        command(tool, "fail").estimate(request(tmp_path, entities=HUMAN))
    text = str(caught.value)
    assert "ended with code 1" in text and "out of memory, as ever" in text
    assert str(tool) in text
    with pytest.raises(HoigsError, match="cannot run no-such-program: No such file"):
        command(tool, command="no-such-program {out}").estimate(request(tmp_path))


def test_files_that_a_command_did_not_write_are_named_and_it_runs_again(tmp_path, tool):
    video = request(tmp_path, entities=HUMAN)
    with pytest.raises(HoigsError, match=r"(?s)exited with 0, but.*clip_depths\.npz: no such file"):
        command(tool, "short").estimate(video)
    with pytest.raises(HoigsError, match="exited with 0"):
        command(tool, "short").estimate(video)
    assert tool.with_suffix(".runs").read_text() == "xx"


def test_settings_are_checked_before_anything_runs(tool):
    with pytest.raises(ValidationError, match=r"\{frame\} is not a placeholder; did you mean"):
        command(tool, "{frame}")
    with pytest.raises(ValidationError, match="declare what the command writes"):
        command(tool, masks=None, depth=None)
    with pytest.raises(ValidationError, match="the command is empty"):
        command(tool, command=" ")
    with pytest.raises(ValidationError, match="kinds"):
        command(tool, depth={"kinds": "metric"})


def test_a_command_runs_in_the_folder_that_it_wants(tmp_path, tool):
    video = request(tmp_path, entities=HUMAN)
    words = f"{shlex.quote(sys.executable)} tool.py {{frames}} {{out}} here"
    with pytest.raises(HoigsError, match="ended with code 2"):
        command(tool, command=words).estimate(video)
    command(tool, command=words, cwd="some folder").estimate(video)
    with pytest.raises(HoigsError, match=r'did you mean "some folder".*`cwd`'):
        command(tool, command=words, cwd="some folders").estimate(video)


def test_no_shell_is_involved(tmp_path, tool):
    """Words with `;`, `$` and `*` arrive as they are."""
    video = request(tmp_path, entities=HUMAN)
    command(tool, "'$HOME; echo * {{x}}'").estimate(video)
    log = next((tmp_path / "work").glob("command-*.log"))
    assert log.read_text() == "working on $HOME; echo * {x}\n"


def test_a_video_file_is_given_if_there_is_one(tmp_path, tool):
    with pytest.raises(HoigsError, match=r"\{video\} is in the command, but only frames are given"):
        command(tool, "{video}").estimate(request(tmp_path, entities=HUMAN))


# in place of mediapipe, to test the pipe and the files in between where it is not installed: its
# landmarks tell what it saw and how it was called
FAKE = """
from types import SimpleNamespace as Box
class Selfie:
    def __init__(self, **settings):
        pass
    def process(self, image):
        return Box(segmentation_mask=(image[..., 1] > 127).astype("float32"))
class Pose:
    def __init__(self, **settings):
        self.settings = settings
        self.seen = 0
    def reset(self):
        pass
    def process(self, image):
        self.seen += 1
        if self.seen == 2 or image.shape[0] > 24:
            return Box(pose_landmarks=None, pose_world_landmarks=None)
        mean = float(image.mean())
        points = [Box(x=0.5, y=0.25 + k / 64, z=-0.1, visibility=mean / 255) for k in range(33)]
        world = Box(x=float(self.settings["model_complexity"]), y=0.0, z=1.0, visibility=1.0)
        own = (image[..., 0] > 127).astype("float32")
        return Box(segmentation_mask=own, pose_landmarks=Box(landmark=points),
                   pose_world_landmarks=Box(landmark=[world] * 33))
solutions = Box(pose=Box(Pose=Pose), selfie_segmentation=Box(SelfieSegmentation=Selfie))
"""
# what the search without a detector imports: its graph finds nobody
FAKE_GRAPH = {
    "google/protobuf/text_format.py": "def Parse(text, config): return config",
    "mediapipe/framework/calculator_pb2.py": "class CalculatorGraphConfig: pass",
    "mediapipe/framework/formats/rect_pb2.py": "class NormalizedRect:\n"
    "    def __init__(self, **place): pass",
    "mediapipe/python/solution_base.py": """
from types import SimpleNamespace as Box
class SolutionBase:
    def __init__(self, **settings):
        pass
    def process(self, given):
        return Box(landmarks=None, world=None, mask=None)
""",
}


@pytest.fixture
def fake_python(tmp_path) -> Path:
    """A `python` whose environment has a mediapipe that answers with what it is given."""
    package = tmp_path / "site" / "mediapipe"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(FAKE)
    (package.parent / "cv2.py").write_text(FAKE_CV2)
    (package.parent / "mediapipe_check.py").write_text(FAKE_MODEL["mediapipe_check"])
    (package.parent / "mediapipe_look.py").write_text(FAKE_LOOK.replace("PEOPLE", "[]"))
    for name, text in FAKE_GRAPH.items():
        (package.parent / name).parent.mkdir(parents=True, exist_ok=True)
        (package.parent / name).write_text(text)
    start = f"import sys, runpy; sys.path.insert(0, {str(package.parent)!r}); "
    start += "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    path = tmp_path / "python"
    path.write_text(
        f'#!/bin/sh\nshift\nexec {shlex.quote(sys.executable)} -c {shlex.quote(start)} "$@"\n'
    )
    path.chmod(0o755)
    return path


def test_mediapipe_gets_all_frames_to_the_last_wanted_one_and_its_landmarks_come_back(
    tmp_path, fake_python
):
    video = request(tmp_path, wanted=(0, 3))
    estimator = mediapipe_estimator(python=fake_python, complexity=2, masks=False)
    track = checked(estimator.estimate(video), video, estimator).landmarks["human"]
    found = np.isfinite(track.image_xyzv).all((1, 2)).tolist()
    assert found == [True, False, True, True, False]  # in 1 nobody was found, 4 it did not see
    assert track.image_xyzv[0, 0, :3] == pytest.approx([0.5 * WIDTH, 0.25 * HEIGHT, -0.1 * WIDTH])
    assert track.image_xyzv[3, 7, 3] == pytest.approx(video.frame(3).mean() / 255)
    assert track.world_xyzv[0, 0].tolist() == [2, 0, 1, 1]
    fake_python.write_text("#!/bin/sh\nexit 1\n")
    again = estimator.estimate(video).landmarks["human"]
    np.testing.assert_array_equal(again.image_xyzv, track.image_xyzv)
    with pytest.raises(HoigsError, match="ended with code 1"):
        mediapipe_estimator(python=fake_python, complexity=1).estimate(video)


def test_mediapipe_masks_the_person_and_drops_landmarks_beside_them(tmp_path, fake_python):
    def frame(i: int) -> np.ndarray:
        image = np.full((24, 32, 3), 100, np.uint8)
        image[4:22, 10 : 22 - i] = 250  # the fake takes what is bright for the person
        return image if i < 3 else np.where(image > 200, 100, 250).astype(np.uint8)

    video = replace(request(tmp_path, entities=HUMAN), read=frame)
    estimator = mediapipe_estimator(python=fake_python, complexity=1)
    found = checked(estimator.estimate(video), video, estimator)
    for i in range(FRAMES):
        mask = found.masks.entities["human"][i]
        np.testing.assert_array_equal(mask, frame(i)[..., 0] > 127)
    seen = np.isfinite(found.landmarks["human"].image_xyzv[:, 0, 0])
    assert seen.tolist() == [True, False, True, False, False], "from 3 on they are beside the mask"
    assert found.landmarks["human"].lost == {LOST[NOBODY]: (1,), LOST[OFF]: (3, 4)}
    assert not found.landmarks["human"].repaired
    notes = [note for note in found.masks.notes if "of the segmentation of selfies alone" in note]
    assert len(notes) == 1 and "3 frames (1, 3-4)" in notes[0]


def test_a_whole_picture_mask_without_the_head_loses_no_frame(tmp_path, fake_python):
    """The model of selfies, which sees the green channel here, misses head and chest and takes a
    chair in; the pose's own mask, of the red channel, has all of the person."""
    person, chair = (slice(4, 22), slice(8, 22)), (slice(4, 24), slice(26, 31))

    def frame(i: int) -> np.ndarray:
        image = np.full((24, 32, 3), (100, 100, 255), np.uint8)
        image[(*person, 0)] = 250
        image[15 - i % 2 : 22, 8:22, 1] = image[(*chair, 1)] = 250
        return image

    video = replace(request(tmp_path, entities=HUMAN), read=frame)
    estimator = mediapipe_estimator(python=fake_python, complexity=1)
    found = checked(estimator.estimate(video), video, estimator)
    track = found.landmarks["human"]
    # one landmark in three is on the mask of selfies
    assert np.isfinite(track.image_xyzv[:, 0, 0]).tolist() == [True, False, True, True, True]
    assert track.lost == {LOST[NOBODY]: (1,)}
    for i in (0, 2, 3, 4):
        mask = found.masks.entities["human"][i]
        assert mask[5:21, 9:21].all() and not mask[chair].any()


def test_a_python_without_mediapipe_is_told_how_to_get_it(tmp_path):
    with pytest.raises(
        HoigsError, match=r"(?s)has no mediapipe.*hoigs estimators install mediapipe"
    ):
        mediapipe_estimator(python=sys.executable).estimate(request(tmp_path))
    with pytest.raises(HoigsError, match=r"there is no .*nowhere.*estimators install"):
        mediapipe_estimator(python="nowhere/bin/python").estimate(request(tmp_path))
    two = (EntityRequest("anna", "human"), EntityRequest("ben", "human"))
    with pytest.raises(HoigsError, match=r"2 people are requested.*click on each"):
        mediapipe_estimator(python=sys.executable).estimate(request(tmp_path, entities=two))


# a Python with mediapipe 0.10.21, which cannot share this one's environment: named, or no test
if MEDIAPIPE := os.environ.get("HOIGS_MEDIAPIPE_PYTHON"):

    def test_real_mediapipe_against_the_supplied_landmarks(tmp_path, shared_data):
        import av

        folder = shared_data / "juggle"
        with av.open(str(folder / "video.mp4")) as container:
            frames = [
                frame.to_ndarray(format="rgb24")
                for frame, _ in zip(container.decode(video=0), range(12), strict=False)
            ]
        video = replace(
            request(tmp_path, entities=HUMAN),
            frames=12, width=1280, height=720, read=frames.__getitem__,
        )  # fmt: skip
        track = mediapipe_estimator(python=MEDIAPIPE).estimate(video).landmarks["human"]
        with np.load(folder / "pose_mediapipe.npz") as file:
            image, world = file["image_xyzv"][:12], file["world_xyzv"][:12]
        error = np.linalg.norm(track.image_xyzv[..., :2] - image[..., :2], axis=-1)
        assert np.median(error) < 2 and np.quantile(error, 0.95) < 10, json.dumps(error.tolist())
        assert np.median(np.abs(track.world_xyzv - world)[..., :3]) < 0.02

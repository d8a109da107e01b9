"""A video alone: MediaPipe's environment is played by a script that knows the tiny scene."""

from __future__ import annotations

import json
import shlex
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from tiny import FRAMES, HEIGHT, WIDTH, landmarks, masks, picture
from tiny_mediapipe import FAKE, FAKE_CV2, FAKE_LOOK, FAKE_MODEL

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.errors import HoigsError, SpecError
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    Estimates,
    Estimator,
    FramePrompt,
    Landmarks,
    LazyFrames,
    PromptError,
)
from hoigs.core.system.environments import MARKER, EnvironmentAbsentError
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.estimators.tools import MEDIAPIPE
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.preparation.estimates.plan import EstimatorPlan, plan_estimators
from hoigs.preparation.kept import PLAN
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import prepare, work_folder
from hoigs.preparation.prompts import with_prompts
from hoigs.preparation.video.source import SourceError, find_source

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PrepareOptions(fit_steps=30, scene_points=400, overlay_width=0, camera="static")


@pytest.fixture
def alone(tiny_video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The tiny scene's video in an empty folder; hoigs's cache is empty, too."""
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "alone"
    folder.mkdir()
    video = folder / "my.mp4"
    video.write_bytes(tiny_video.read_bytes())
    return video


@pytest.fixture
def environment(alone: Path, tmp_path: Path) -> None:
    """An installed environment whose mediapipe knows the tiny scene."""
    known, package = tmp_path / "known.npz", tmp_path / "site" / "mediapipe"
    package.mkdir(parents=True)
    np.savez(known, **landmarks())
    (package / "__init__.py").write_text(FAKE.replace("KNOWN", str(known)))
    (package.parent / "cv2.py").write_text(FAKE_CV2)
    (package.parent / "mediapipe_look.py").write_text(FAKE_LOOK.replace("PEOPLE", "[]"))
    for name, text in FAKE_MODEL.items():
        (package.parent / f"{name}.py").write_text(text)
    start = f"import sys, runpy; sys.path.insert(0, {str(package.parent)!r}); "
    start += "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    python = MEDIAPIPE.folder / "bin" / "python"
    python.parent.mkdir(parents=True)
    words = f'exec {shlex.quote(sys.executable)} -c {shlex.quote(start)} "$@"'
    python.write_text(f"#!/bin/sh\nshift\n{words}\n")
    python.chmod(0o755)
    (MEDIAPIPE.folder / MARKER).write_text(json.dumps({"versions": "fake"}))


class Balls(Estimator):
    """The ball's masks, if it is shown where the ball is."""

    provides = frozenset({"masks"})

    def __init__(self) -> None:
        pass

    def estimate(self, video, progress=None) -> Estimates:
        assert [e.name for e in video.entities] in (["object"], ["object", "box"])
        assert set(video.known.masks.entities) == set(video.known.landmarks) == {"human"}
        right = all(
            masks(at.frame)[1][int(y), int(x)]
            for at in video.entities[0].prompts
            for x, y in [(p.x, p.y) for p in at.points]
        )
        shown = LazyFrames(video.frames, lambda i: masks(i)[1] & right)
        boxes = LazyFrames(video.frames, boxed) if len(video.entities) > 1 else None
        found = {"object": shown} | ({} if boxes is None else {"box": boxes})
        sure = {name: np.full(video.frames, 0.5 + 0.3 * (name == "box")) for name in found}
        return Estimates(EntityMasks(found, confidence=sure, notes=("a note on the ball",)))


def boxed(frame: int) -> np.ndarray:
    """A second thing, which touches the ball."""
    x = int(np.flatnonzero(masks(frame)[1].any(0))[-1])
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[8:17, max(0, x - 4) : x + 5] = True
    return mask


def made(out: Path) -> dict[str, int]:
    found = {name: work_folder(out) / name / "result.json" for name in PLAN}
    return {name: path.stat().st_mtime_ns for name, path in found.items() if path.is_file()}


def test_a_video_alone_becomes_a_clip_of_a_person(
    alone: Path, environment: None, tmp_path: Path
) -> None:
    plans: list[EstimatorPlan] = []
    out = tmp_path / "clip"
    report = prepare(
        alone, out, object="none", options=OPTIONS, body=AnnyBody(), announce=plans.append
    )
    rows = {row[0]: row[1] for row in plans[0].rows()}
    assert rows["person's mask"] == rows["person's landmarks"] == "mediapipe"
    assert rows["object's mask"] == "none" and plans[0].frames == FRAMES
    assert not plans[0].counted
    assert check_clip(out) == [] and report.object_observed is None
    clip = ClipFolderReader().read(out)
    assert len(clip) == FRAMES and not clip.objects and set(clip.bodies) == {"human"}
    mask, true = clip[5].masks["human"].numpy(), masks(5)[0]
    assert (mask & true).sum() / (mask | true).sum() > 0.9
    assert not (out / "object.jpg").exists() and report.body_residual_px < 3
    assert report.landmarks == {"human": {"found": FRAMES, "lost": {}, "repaired": {}}}


def test_each_frame_lost_or_repaired_is_reported_with_its_reason(
    alone: Path, tmp_path: Path
) -> None:
    """One frame of many is enough: it need not be a fifth of them."""

    class Blinking(Two):
        def people(self, video) -> tuple[FramePrompt, ...]:
            return ()

        def estimate(self, video, progress=None) -> Estimates:
            known = landmarks()
            known["image_xyzv"][3] = known["world_xyzv"][3] = np.nan
            track = Landmarks(
                known["image_xyzv"], known["world_xyzv"],
                lost={"the sun blinded it": (3,)}, repaired={"a second look helped": (5, 6)},
            )  # fmt: skip
            stack = LazyFrames(video.frames, lambda i: masks(i)[0])
            return Estimates(EntityMasks({"human": stack}), {"human": track})

    one, out = Blinking(), tmp_path / "clip"
    report = prepare(
        alone, out, object="none", options=OPTIONS, body=AnnyBody(),
        estimators={"landmarks": one, "masks": one},
    )  # fmt: skip
    lost, repaired = {"the sun blinded it": [3]}, {"a second look helped": [5, 6]}
    counted = {"human": {"found": FRAMES - 1, "lost": lost, "repaired": repaired}}
    assert report.landmarks == counted
    assert json.loads((out / "report.json").read_text())["landmarks"] == counted
    page = (out / "report.html").read_text()
    # the command's last lines are these warnings
    for reason, frames in (("the sun blinded it", "(3)"), ("a second look helped", "(5-6)")):
        (said,) = (text for text in report.warnings if reason in text)
        assert frames in said and reason in page
    (judged,) = (d for d in report.diagnostics() if d.kind == "landmarks of human")
    assert judged.frames == (3,)


def test_another_click_makes_only_the_object_again(
    alone: Path, environment: None, tmp_path: Path
) -> None:
    out, body = tmp_path / "clip", AnnyBody()
    common = {"options": OPTIONS, "body": body, "estimators": {"object": Balls()}}
    report = prepare(alone, out, object="5,5", **common)  # it is not there
    assert report.object_observed is None and "--object X,Y" in " ".join(report.warnings)
    before = made(out)
    better = common | {"options": OPTIONS.model_copy(update={"overwrite": True})}
    report = prepare(alone, out, object=["20,36", "52,30@9"], **better)
    changed = {name for name, when in made(out).items() if before[name] != when}
    assert changed == {"object_masks", "masks", "objects", "scene"}
    assert report.object_observed == 1 and "a note on the ball" in report.warnings
    assert (out / "object.jpg").is_file()
    assert "data:image/jpeg;base64" in (out / "report.html").read_text()
    assert check_clip(out) == []


def test_two_objects_are_followed(alone: Path, environment: None, tmp_path: Path) -> None:
    out = tmp_path / "clip"
    report = prepare(
        alone, out, object=["20,36", "box=30,12@3"], options=OPTIONS, body=AnnyBody(),
        estimators={"object": Balls()},
    )  # fmt: skip
    assert check_clip(out) == []
    clip = ClipFolderReader().read(out)
    assert set(clip.objects) == {"object", "box"} and set(clip.bodies) == {"human"}
    for i in range(FRAMES):
        human, ball, box = (clip[i].masks[n].numpy() > 0 for n in ("human", "object", "box"))
        assert not (human & ball).any() and not (human & box).any()
        assert (box == boxed(i)).all()  # it is surer
        assert (ball == (masks(i)[1] & ~boxed(i))).all()
    assert report.further_objects["box"]["object_observed"] == 1
    assert {"object", "object box"} <= set(report.provenance)
    assert {"box seen", "box's poses", "mask of box"} <= {row[0] for row in report.rows()}


def rolled(i: int, shift: int) -> np.ndarray:
    """The tiny person's mask at another place; elsewhere it sways."""
    return np.roll(np.logical_or(*masks(i)), shift + (2 * (i % 3) if shift else 0), 1)


class Two(Estimator):
    """The tiny person, and the same again to the right."""

    provides = frozenset({"landmarks", "masks"})

    def __init__(self) -> None:
        pass

    def people(self, video) -> tuple[FramePrompt, ...]:
        return (FramePrompt(3, (), (40, 8, 56, 60)), FramePrompt(3, (), (70, 8, 86, 60)))

    def estimate(self, video, progress=None) -> Estimates:
        names = video.named("human")
        assert all(e.prompts for e in video.entities if e.kind == "human")
        tracks, stacks = {}, {}
        for name, shift in zip(names, (0, 30), strict=False):
            known = landmarks()
            known["image_xyzv"][..., 0] += shift
            tracks[name] = Landmarks(known["image_xyzv"], known["world_xyzv"])
            stacks[name] = LazyFrames(video.frames, lambda i, s=shift: rolled(i, s))
        return Estimates(EntityMasks(stacks), tracks)


def test_a_small_person_is_followed_by_their_box(alone: Path, tmp_path: Path) -> None:
    class Far(Two):
        def people(self, video) -> tuple[FramePrompt, ...]:
            return (FramePrompt(3, (), (44, 20, 52, 20 + 0.4 * HEIGHT)),)

    far = Far()
    report = prepare(
        alone, tmp_path / "clip", object="none", options=OPTIONS, body=AnnyBody(),
        estimators={"landmarks": far, "masks": far},
    )  # fmt: skip
    assert any("40 % of the picture's height" in text for text in report.warnings)


@pytest.mark.parametrize("person", ["all", ("anna=48,30", "ben=78,30"), ()])
def test_several_people_are_fitted(alone: Path, tmp_path: Path, person) -> None:
    out, two, notes = tmp_path / "clip", Two(), []
    report = prepare(
        alone, out, object="none", person=person, options=OPTIONS, body=AnnyBody(),
        estimators={"landmarks": two, "masks": two}, announce=lambda plan: notes.extend(plan.notes),
    )  # fmt: skip
    assert check_clip(out) == []
    clip = ClipFolderReader().read(out)
    names = {"all": ["human", "human2"], (): ["human"]}.get(person, ["anna", "ben"])
    assert (
        list(clip.bodies) == names and [n for n in clip.kinds if clip.kinds[n] == "human"] == names
    )
    assert report.further_people.keys() == set(names[1:])
    if person in ((), "all"):
        assert notes and notes[0].startswith("2 people are seen in frame 3, at 48,34, 78,34: ")
        assert notes[0] in report.warnings
    if person == ():  # whoever is not fitted is no scene, either
        always = np.all([rolled(i, 30) for i in range(FRAMES)], axis=0)
        shown = rolled(4, 30) & ~clip[4].masks["human"].numpy()
        ignored = clip[4].ignored.numpy()
        assert (shown & ~always).any() and ignored[shown & ~always].all()
        assert always.any() and not ignored[always].any()  # nothing else is seen there
        assert not any("black patches" in text for text in report.warnings)
    if names[1:]:
        first, second = (clip[4].masks[n].numpy() > 0 for n in names)
        assert first.any() and second.any() and not (first & second).any()
        apart = (clip.bodies[names[1]].poses.transl - clip.bodies[names[0]].poses.transl)[:, 0]
        assert apart.mean() == pytest.approx(30 / (0.8 * WIDTH) * 2.8, rel=0.15)


def test_people_beside_who_cannot_be_followed_are_left_out(alone: Path, tmp_path: Path) -> None:
    class Lonely(Two):
        def estimate(self, video, progress=None) -> Estimates:
            if len(video.named("human")) > 1:
                raise PromptError("no person is found there: 3 of human2")
            return super().estimate(video, progress)

    one = Lonely()
    report = prepare(
        alone, tmp_path / "clip", object="none", options=OPTIONS, body=AnnyBody(),
        estimators={"landmarks": one, "masks": one},
    )  # fmt: skip
    assert any("are not followed: no person is found there" in text for text in report.warnings)
    with pytest.raises(PromptError):
        prepare(
            alone, tmp_path / "both", object="none", person="all", options=OPTIONS,
            body=AnnyBody(), estimators={"landmarks": one, "masks": one},
        )  # fmt: skip


def test_a_clip_of_an_object_alone(alone: Path, tmp_path: Path) -> None:
    class Ball(Estimator):
        provides = frozenset({"masks"})

        def __init__(self) -> None:
            pass

        def estimate(self, video, progress=None) -> Estimates:
            assert video.known is None and video.named("human") == ()
            return Estimates(EntityMasks({"object": LazyFrames(FRAMES, lambda i: masks(i)[1])}))

    out = tmp_path / "clip"
    report = prepare(
        alone, out, person="none", object="20,36", options=OPTIONS, body=AnnyBody(),
        estimators={"object": Ball()},
    )  # fmt: skip
    assert check_clip(out) == [] and report.body_residual_px is None
    clip = ClipFolderReader().read(out)
    assert not clip.bodies and set(clip.objects) == {"object"}
    assert "nobody" in report.provenance["body"] and "--object-size" not in report.to_markdown()
    assert any("taken to be 0.3 m" in text for text in report.warnings)
    supposed = {"unit of the world", "rotation of object", "depth of the scene", "up"}
    assert set(report.unknown) == supposed and clip.provenance["unknown"] == report.unknown
    page = (out / "report.html").read_text()
    assert all(f"**{what}**" in report.to_markdown() and what in page for what in supposed)


def test_without_the_environment_nothing_is_done(alone: Path, tmp_path: Path) -> None:
    with pytest.raises(EnvironmentAbsentError, match="hoigs estimators install mediapipe"):
        prepare(alone, tmp_path / "clip", options=OPTIONS)
    asked: list[str] = []
    with pytest.raises(EnvironmentAbsentError):
        prepare(alone, tmp_path / "clip", options=OPTIONS, consent=lambda q: bool(asked.append(q)))
    assert len(asked) == 1 and "MB" in asked[0] and "Apache" in asked[0]
    with pytest.raises(SourceError, match=r"(?s)absent:.*pose_mediapipe\.npz"):
        prepare(alone, tmp_path / "clip", estimators="files")
    assert [p.name for p in tmp_path.iterdir()] == ["alone"]


def test_clicks_are_checked_before_work(alone: Path, environment: None, tmp_path: Path) -> None:
    for click, message in ((f"{WIDTH + 1},3", "outside of the picture"), ("3,3@99", "frame 99")):
        with pytest.raises(SpecError, match=message):
            prepare(alone, tmp_path / "clip", object=click, options=OPTIONS)
    with pytest.raises(SpecError, match="football"):
        prepare(alone, tmp_path / "clip", object="football", options=OPTIONS)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["alone", "cache", "known.npz", "site"]


def test_files_come_first(tiny_source: Path, alone: Path) -> None:
    def chosen(path: Path, options: PrepareOptions = PrepareOptions()) -> dict[str, str]:  # noqa: B008
        found = find_source(path, complete=False)
        return {c.place: c.use for c in plan_estimators(found, options).choices.values()}

    files = "estimator:landmarks-files", "estimator:masks-files"
    assert chosen(tiny_source) == {
        "landmarks": files[0], "masks": files[1], "object": "ball_track.npz"
    }  # fmt: skip
    (tiny_source / "ball_track.npz").unlink()
    assert chosen(tiny_source)["object"] == "with the person's mask"
    (tiny_source / "pose_mediapipe.npz").unlink()
    assert chosen(tiny_source)["landmarks"] == "estimator:mediapipe"
    assert chosen(alone)["object"] == "estimator:object-tracker"
    hub = chosen(alone, with_prompts(PrepareOptions(object="football", preset="hub")))
    assert hub["object"] == "estimator:transformers-sam2" and len(hub) == 4
    with pytest.raises(SpecError, match="SAM 2"):
        chosen(alone, with_prompts(PrepareOptions(object=["1,2", "3,4@5"], preset="hub")))


def rewrite(path: Path, pictures: list[np.ndarray], ticks: list[int]) -> None:
    """A video of pictures that are shown at multiples of 1/300 s."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.time_base = stream.codec_context.time_base = Fraction(1, 300)
        for image, tick in zip(pictures, ticks, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, 300)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def nothing_is_left(folder: Path) -> bool:
    return not any(p.name.startswith("clip") for p in folder.iterdir())


def test_a_black_video_is_named(alone: Path, environment: None, tmp_path: Path) -> None:
    black = np.zeros((48, 64, 3), np.uint8)
    rewrite(alone, [black] * 10, [10 * i for i in range(10)])
    with pytest.raises(HoigsError, match="5 frames"):
        prepare(alone, tmp_path / "clip", options=OPTIONS)
    assert nothing_is_left(tmp_path)


def test_nobody_in_the_video_is_a_sentence(alone: Path, tmp_path: Path) -> None:
    class Nobody(Two):
        def people(self, video) -> tuple[FramePrompt, ...]:
            return ()

        def estimate(self, video, progress=None) -> Estimates:
            unknown = Landmarks(np.full((video.frames, 33, 4), np.nan, np.float32))
            empty = [np.zeros((HEIGHT, WIDTH), bool)] * video.frames
            return Estimates(EntityMasks({"human": empty}), {"human": unknown})

    two = Nobody()
    with pytest.raises(SourceError, match=f"{FRAMES} chosen frames"):
        prepare(
            alone, tmp_path / "clip", options=OPTIONS, body=AnnyBody(),
            estimators={"landmarks": two, "masks": two},
        )  # fmt: skip
    assert nothing_is_left(tmp_path)


def test_a_click_on_nothing_is_a_sentence(alone: Path, environment: None, tmp_path: Path) -> None:
    bordered = [picture(i) for i in range(FRAMES)]
    for image in bordered:
        image[:, -16:] = 0
    rewrite(alone, bordered, [25 * i for i in range(FRAMES)])
    x = WIDTH - 5
    with pytest.raises(HoigsError, match=rf"{x},30 in frame 0"):
        prepare(alone, tmp_path / "clip", object=f"{x},30", options=OPTIONS, body=AnnyBody())
    assert not (tmp_path / "clip").exists()


def test_a_variable_rate_is_noted(alone: Path, environment: None, tmp_path: Path) -> None:
    uneven = [10 * i + 25 * (i // 3) for i in range(FRAMES)]
    rewrite(alone, [picture(i) for i in range(FRAMES)], uneven)
    report = prepare(alone, tmp_path / "clip", object="none", options=OPTIONS, body=AnnyBody())
    assert any("not evenly spaced" in text for text in report.warnings)
    clip = ClipFolderReader().read(tmp_path / "clip")
    assert list(clip.frame_times) == pytest.approx([tick / uneven[-1] for tick in uneven], abs=1e-3)

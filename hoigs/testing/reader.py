"""Conformance of clip readers: `CHECKS`, on folders that the kit writes."""

from __future__ import annotations

import copy
import pickle
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from hoigs.core.errors import ClipError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.reader import ClipReader
from hoigs.testing.checks import (
    CheckError,
    CheckList,
    ComponentSubject,
    require,
    require_close,
    require_finite,
)
from hoigs.testing.material import write_tiny_clip
from hoigs.testing.runner import Options

IMAGES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class ReaderSubject(ComponentSubject[ClipReader]):
    """The component under check.

    Attributes:
        given: a folder in the reader's layout; None uses a clip folder of hoigs.
    """

    given: Path | None = None

    def reader(self) -> ClipReader:
        return self.cls.from_config(self.config, BuildContext())

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A copy of a clip in its layout, which a check may damage."""
        with tempfile.TemporaryDirectory() as root:
            folder = Path(root) / "clip"
            if self.given is not None:
                shutil.copytree(self.given, folder)
            else:
                write_tiny_clip(folder)
            yield folder

    @cached_property
    def has_folder(self) -> bool:
        if self.given is not None:
            return True
        with self.folder() as folder:
            return bool(self.reader().matches(folder))


CHECKS: CheckList[ReaderSubject] = CheckList("C")


def subject(cls: type[ClipReader], config: Any, options: Options) -> ReaderSubject:
    made = ReaderSubject(cls, config, options.folder)
    made.reader()
    return made


def has_folder(subject: ReaderSubject) -> str | None:
    if subject.has_folder:
        return None
    return "it does not read the clip folder of hoigs: pass a clip in its layout (folder=…)"


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def images_of(folder: Path) -> list[Path]:
    return [path for path in files_of(folder) if path.suffix.lower() in IMAGES]


def has_image_files(subject: ReaderSubject) -> str | None:
    if not subject.has_folder:
        return has_folder(subject)
    with subject.folder() as folder:
        return None if images_of(folder) else "its layout has no image files"


# C01 to C04: folders in other layouts, and incomplete ones.


def foreign_folders(root: Path) -> list[Path]:
    """Paths in no layout: an empty folder, a folder with other files, a file, an absent path."""
    empty, full, file = root / "empty", root / "full", root / "file"
    for folder in (empty, full / "images", full / "clip"):
        folder.mkdir(parents=True)
    (full / "notes.txt").write_text("no clip")
    (full / "images" / "one.png").write_bytes(b"no picture")
    (full / "data.npz").write_bytes(b"no arrays")
    file.write_text("no folder")
    return [empty, full, file, root / "absent"]


@CHECKS.check("C01")
def foreign_folders_do_not_match(subject: ReaderSubject) -> None:
    """`matches` is False for empty and foreign folders, files and absent paths."""
    with tempfile.TemporaryDirectory() as root:
        for folder in foreign_folders(Path(root)):
            try:
                matches = subject.reader().matches(folder)
            except Exception as error:
                raise CheckError(f"matches({folder.name}) raises {error!r}") from error
            require(matches is False, f"matches({folder.name}) is {matches}, expected False")


@CHECKS.check("C02")
def matches_writes_nothing(subject: ReaderSubject) -> None:
    """`matches` writes nothing."""
    with tempfile.TemporaryDirectory() as root:
        folders = foreign_folders(Path(root))
        before = {path: path.stat().st_mtime_ns for path in Path(root).rglob("*")}
        for folder in folders:
            with suppress(Exception):  # C01 checks that
                subject.reader().matches(folder)
        after = {path: path.stat().st_mtime_ns for path in Path(root).rglob("*")}
        require(before == after, f"matches changed {set(before.items()) ^ set(after.items())}")


@CHECKS.check("C03")
def foreign_folders_are_refused(subject: ReaderSubject) -> None:
    """Reading a folder in another layout raises a ClipError that names it."""
    with tempfile.TemporaryDirectory() as root:
        for folder in foreign_folders(Path(root)):
            message = refusal(subject.reader(), folder)
            if message is None:
                raise CheckError(f"read({folder.name}) returns a clip, expected a ClipError")
            require(folder.name in message, f"the error does not name the folder: {message}")


@CHECKS.check("C04", has_folder)
def one_error_names_all_absent_files(subject: ReaderSubject) -> str:
    """One ClipError names all required files that are absent."""
    with subject.folder() as folder:
        reader = subject.reader()
        reader.read(folder)
        states = {path: _needed(reader, folder, path) for path in files_of(folder)}
        needed = [path for path, (fails, _) in states.items() if fails]
        # without these files the folder must still match, or there is no error to check
        absent = [path for path in needed if states[path][1]]
        for path in absent:
            path.rename(path.with_name(path.name + ".away"))
        message = refusal(subject.reader(), folder) if absent else ""
        if message is None:
            raise CheckError(f"without {len(absent)} required files, it still returns a clip")
        unnamed = [str(p.relative_to(folder)) for p in absent if not _names(message, p, folder)]
        why = f"{len(absent)} files are absent, the error does not name {unnamed[:4]}: {message}"
        require(not unnamed, why)
    return f"{len(absent)} of {len(needed)} required files can be absent while the layout matches"


def _names(message: str, path: Path, folder: Path) -> bool:
    """Whether a message names a file, or the folder that it is in."""
    above = path.parent.name if path.parent != folder else path.name
    return path.name in message or path.stem in message or above in message


@contextmanager
def _without(path: Path) -> Iterator[None]:
    """The file is renamed, and so absent, in this block."""
    away = path.with_name(path.name + ".away")
    path.rename(away)
    try:
        yield
    finally:
        away.rename(path)


def _needed(reader: ClipReader, folder: Path, path: Path) -> tuple[bool, bool]:
    """Whether reading fails without a file, and whether the folder still matches then."""
    with _without(path):
        fails = refusal(reader, folder) is not None
        return fails, fails and bool(reader.matches(folder))


def refusal(reader: ClipReader, folder: Path) -> str | None:
    """The message of the ClipError, or None when a clip is returned."""
    try:
        reader.read(folder)
    except ClipError as error:
        return str(error)
    except Exception as error:
        raise CheckError(f"read raises {error!r}, expected a ClipError") from error
    return None


# C05 to C09: the clip that is read.


@CHECKS.check("C05", has_folder)
def frames_are_bytes_of_one_size(subject: ReaderSubject) -> None:
    """Images are uint8 RGB of the camera's size, masks bool, depth in metres, none negative."""
    with subject.folder() as folder:
        clip = subject.reader().read(folder)
        require(len(clip) > 0, "the clip has no frames")
        for position in sorted({0, len(clip) // 2, len(clip) - 1}):
            camera, image = clip.cameras[position], clip.store.image(position)
            size = (camera.height, camera.width)
            require(image.dtype == torch.uint8, f"image {position} is {image.dtype}, not uint8")
            require(image.shape == (*size, 3), f"image {position} has shape {list(image.shape)}")
            for name in clip.kinds:
                mask = clip.store.mask(name, position)
                good = mask.dtype == torch.bool and mask.shape == size
                require(good, f"mask of {name} is {mask.dtype} {list(mask.shape)}")
            depth = clip.store.depth(position)
            if depth is not None:
                require_finite(f"depth {position}", depth)
                require((depth >= 0).all(), f"depth {position} is negative; unknown is 0")


@CHECKS.check("C06", has_folder)
def the_clip_is_consistent(subject: ReaderSubject) -> None:
    """Each frame has a camera, a moment in [0, 1] and all tracks; the split names its frames."""
    with subject.folder() as folder:
        clip = subject.reader().read(folder)
        frames = len(clip.cameras)
        require(len(clip.moments) == frames, f"{len(clip.moments)} moments, {frames} cameras")
        times = [moment.time for moment in clip.moments]
        require(all(0 <= time <= 1 for time in times), f"times {min(times)} to {max(times)}")
        for name, kind in clip.kinds.items():
            tracks = clip.bodies if kind == "human" else clip.objects
            require(name in tracks, f"no track of the {kind} {name}")
        for moment in clip.moments:
            require(set(moment.poses) == set(clip.bodies), "a moment lacks the pose of a human")
        for part, positions in clip.split.items():
            inside = all(0 <= p < frames for p in positions)
            require(inside, f"split {part} has frames beyond the {frames} of the clip")
        for camera in clip.cameras:
            turn = camera.world_to_camera[:3, :3].double()
            require_close("R R^T of a camera", turn @ turn.mT, torch.eye(3), atol=1e-4)


@CHECKS.check("C07", has_image_files)
def pixels_are_read_lazily(subject: ReaderSubject) -> None:
    """Pixels are decoded on access, not when the clip is read."""
    with subject.folder() as folder:
        clip = subject.reader().read(folder)
        for path in images_of(folder):
            with Image.open(path) as image:
                blank = Image.new(image.mode, image.size)
            blank.save(path)
        brightest = int(clip.store.image(len(clip) - 1).max())
        require(brightest < 8, "an image was decoded before it was accessed")


@CHECKS.check("C08", has_folder)
def reading_writes_nothing(subject: ReaderSubject) -> None:
    """Reading writes nothing, and reading twice gives the same clip."""
    with subject.folder() as folder:
        before = {path: path.read_bytes() for path in files_of(folder)}
        first, second = (subject.reader().read(folder) for _ in range(2))
        for position in (0, len(first) - 1):
            same = torch.equal(first.store.image(position), second.store.image(position))
            require(same, f"image {position}, read twice, differs")
        require(torch.equal(first.points, second.points), "points, read twice, differ")
        after = {path: path.read_bytes() for path in files_of(folder)}
        other = [path for path in {*before, *after} if before.get(path) != after.get(path)]
        changed = [str(path.relative_to(folder)) for path in other]
        require(not changed, f"reading changed {changed}")


@CHECKS.check("C09", has_folder)
def a_clip_is_copied_and_pickled(subject: ReaderSubject) -> None:
    """A deep copy and a pickle of the clip, also of one in use, have its pixels."""
    with subject.folder() as folder:
        clip = subject.reader().read(folder)
        last = len(clip) - 1
        image = clip.store.image(last)
        for how, twin in (
            ("a deep copy", lambda: copy.deepcopy(clip)),
            ("a pickle", lambda: pickle.loads(pickle.dumps(clip))),
        ):
            try:
                same = torch.equal(twin().store.image(last), image)
            except (TypeError, AttributeError, RuntimeError, pickle.PicklingError) as error:
                raise CheckError(f"{how} of the clip fails: {error}") from error
            require(same, f"{how} of the clip has another image {last}")

"""C05 to C09: the clip that is read."""

from __future__ import annotations

import copy
import pickle

import torch
from PIL import Image

from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require, require_close, require_finite
from hoigs.testing.reader.subject import (
    CHECKS,
    ReaderSubject,
    files_of,
    has_folder,
    has_image_files,
    images_of,
)


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
        changed = [
            str(p.relative_to(folder)) for p in {*before, *after} if before.get(p) != after.get(p)
        ]
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

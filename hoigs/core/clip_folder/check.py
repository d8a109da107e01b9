"""The clip folder's checker: every absent or inconsistent file, and its maker."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hoigs.core.clip_folder.check_arrays import check_arrays, check_colors, check_track
from hoigs.core.clip_folder.check_frames import View, check_views
from hoigs.core.clip_folder.diagnostics import FileDiagnostic, absent, summarize, wrong
from hoigs.core.clip_folder.format import (
    BODY,
    HEADER,
    OBJECT,
    POINTS,
    VIEWS,
    ClipHeader,
    ViewsHeader,
    parse_header,
)
from hoigs.core.diagnostics import ranges
from hoigs.core.errors import ClipError
from hoigs.core.files.npz import array_headers

RATE_TOLERANCE = 0.01  # of fps, against the mean rate of times
_HEADER_FROM = "clip.json comes from `hoigs prepare VIDEO --out FOLDER` or ClipWriter"


def check_clip(folder: Path) -> list[FileDiagnostic]:
    """Everything wrong with a clip folder, in reading order; empty when it can be used.

    Reads every header and depth map, and masks until one is not empty; images by header only.
    """
    folder = Path(folder)
    if not (folder / HEADER).is_file():
        return [absent(HEADER, _HEADER_FROM)]
    header, messages = parse_header(folder / HEADER, ClipHeader)
    if header is None:
        return [wrong(HEADER, message) for message in messages]
    problems = [*_check_split(header), *_check_times(header), *_check_truth(folder, header)]
    view = View("", header.width, header.height, header.frames)
    problems += check_views(folder, view, header)
    sizes = {"F": header.frames}
    for name, entity in header.entities.items():
        spec, subfolder = (BODY, "bodies") if entity.kind == "human" else (OBJECT, "objects")
        path = f"{subfolder}/{name}.npz"
        found, arrays = check_arrays(folder, path, spec, dict(sizes))
        problems += found
        problems += check_track(path, arrays, entity.body)
    found, arrays = check_arrays(folder, POINTS.pattern, POINTS, dict(sizes))
    problems += [*found, *check_colors(POINTS.pattern, arrays)]
    if (folder / "held_out").exists():
        problems += _check_held_out(folder, header)
    return problems


def require_clip(folder: Path) -> ClipHeader:
    """The header of a clip folder that can be used.

    Raises:
        ClipError: naming every absent or inconsistent file and who makes it.
    """
    return usable_clip(folder)[0]


def usable_clip(
    folder: Path, allow_faults: bool = False
) -> tuple[ClipHeader, list[FileDiagnostic]]:
    """The header of a clip folder that can be used, and what training has to go on without.

    Args:
        allow_faults: accept what training can go on without (severity "fair").

    Raises:
        ClipError: naming every absent or inconsistent file and who makes it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ClipError(f"{folder} is not a folder; make a clip with `hoigs prepare VIDEO --out …`")
    problems = check_clip(folder)
    fatal = [p for p in problems if not allow_faults or p.severity == "bad"]
    if fatal:
        lines = [f"  {line}" for line in summarize(fatal)]
        if all(p.severity == "fair" for p in fatal):
            lines.append("or continue without these: --allow-faults (docs/reference/clip.md)")
        raise ClipError(f"{folder} cannot be used as a clip:\n" + "\n".join(lines))
    header, _ = parse_header(folder / HEADER, ClipHeader)
    assert header is not None  # check_clip has just read it
    return header, problems


def _check_split(header: ClipHeader) -> Iterator[FileDiagnostic]:
    train, test = header.split.train, header.split.test
    if not train:
        yield wrong(HEADER, "split.train is empty: nothing to train on")
    if not test and header.frames > 2:
        yield wrong(HEADER, "split.test is empty: nothing to score on")
    outside = sorted({i for i in (*train, *test) if not 0 <= i < header.frames})
    if outside:
        last = header.frames - 1
        yield wrong(HEADER, f"split names frames {ranges(outside)}; the clip has 0..{last}")
    both = sorted(set(train) & set(test))
    if both:
        yield wrong(HEADER, f"split has frames {ranges(both)} in both train and test")


def _check_times(header: ClipHeader) -> Iterator[FileDiagnostic]:
    times = header.times
    if times is None:
        return
    if len(times) != header.frames or len(times) < 2:
        yield wrong(HEADER, f"times has {len(times)} entries for {header.frames} frames")
        return
    gaps = np.diff(times)
    if times[0] != 0 or not np.isfinite(times).all() or gaps.min() <= 0:
        yield wrong(HEADER, "times has to begin with 0 and to ascend, in seconds")
        return
    rate = len(gaps) / times[-1]
    if abs(rate / header.fps - 1) > RATE_TOLERANCE:
        yield wrong(HEADER, f"fps is {header.fps:g}, but times have {rate:g} frames a second")


def _check_truth(folder: Path, header: ClipHeader) -> Iterator[FileDiagnostic]:
    """The true geometry that synthetic clips name: opened by the evaluation, after training."""
    name = header.provenance.get("truth")
    if name is None:
        return
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        yield wrong(name, "is a link that leaves the clip's folder; copy the file into it")
    elif path.is_file():  # without it, errors against the truth are not computed
        try:
            array_headers(path)
        except (OSError, ValueError) as error:
            yield wrong(name, str(error))


def _check_held_out(folder: Path, header: ClipHeader) -> list[FileDiagnostic]:
    if not (folder / VIEWS).is_file():
        maker = "it comes from ClipWriter.add_held_out; or delete the folder held_out"
        return [absent(VIEWS, maker)]
    views, messages = parse_header(folder / VIEWS, ViewsHeader)
    if views is None:
        return [wrong(VIEWS, message) for message in messages]
    problems = []
    outside = sorted({i for i in views.frames if not 0 <= i < header.frames})
    if outside:
        message = f"frames names {outside}; the clip has 0..{header.frames - 1}"
        problems.append(wrong(VIEWS, message))
    view = View("held_out/", views.width, views.height, len(views.frames))
    return problems + check_views(folder, view, header)

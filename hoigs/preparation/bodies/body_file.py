"""Bodies of other programs: the file that lies beside a video, known by its content."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch

from hoigs.core.errors import ClipError
from hoigs.core.files.regular_file import regular_file
from hoigs.core.unpickling.joblib_file import load_joblib
from hoigs.core.unpickling.pickles import load_pickled_npy
from hoigs.preparation.bodies.file_body import FileBody
from hoigs.preparation.bodies.programs import EXPECTED, body_of
from hoigs.preparation.video.source import SourceError

SUFFIXES = (".pt", ".pkl")
USUAL_NAMES = ("hmr4d_results.pt", "wham_output.pkl")


def body_beside(source: Path, named: str | None) -> FileBody | None:
    """The body in the file `named`, or else in the one beside the video, if there is one.

    Raises:
        SourceError: as `read_bodies` and `find_bodies`.
    """
    folder = source if source.is_dir() else source.parent
    if named is not None:
        path = folder / Path(named).expanduser()
        if not path.is_file():
            raise SourceError(f"--set bodies: {path} does not exist")
        return read_bodies(path)
    return find_bodies(folder) if source.exists() else None


def find_bodies(folder: Path) -> FileBody | None:
    """The one such file of a folder, known by its content; None without one.

    Raises:
        SourceError: there are several, or one of the usual names cannot be read.
    """
    found = []
    for path in _candidates(folder):
        try:
            body = _recognised(path)
        except SourceError:
            if path.name in USUAL_NAMES:
                raise
            continue  # another program's file, which happens to lie here
        if body is not None:
            found.append(body)
    if len(found) > 1:
        names = ", ".join(body.path.name for body in found)
        raise SourceError(f"{folder} holds several files of bodies, {names}: leave one there")
    return found[0] if found else None


def _candidates(folder: Path) -> list[Path]:
    """Files that may hold bodies; of TRAM's, one a person, the first, which has most frames."""
    found = sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES and p.is_file())
    tracks = sorted([*folder.glob("hps_track_*.npy"), *folder.glob("hps/hps_track_*.npy")])
    return found + tracks[:1]


def read_bodies(path: Path) -> FileBody:
    """The body in a file.

    Raises:
        SourceError: it cannot be read as plain numbers, or is of no known program.
    """
    body = _recognised(path)
    if body is None:
        expected = "; ".join(f"{program}: {what}" for program, what in EXPECTED.items())
        raise SourceError(f"{path} holds no bodies of a known program; expected {expected}")
    return body


def _recognised(path: Path) -> FileBody | None:
    """The body in a file, or None if its content is not that of a known program."""
    if path.suffix == ".pt":
        try:
            file = regular_file(path)
            content = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
        except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
            reason = str(error).strip().splitlines() or [type(error).__name__]
            raise SourceError(
                f"{path} cannot be read as tensors alone, without running code: {reason[0]}"
            ) from error
        return body_of(content, path)
    try:
        content = load_pickled_npy(path) if path.suffix == ".npy" else load_joblib(path)
    except ClipError as error:
        raise SourceError(str(error)) from error
    return body_of(content, path)

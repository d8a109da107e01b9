"""Files that are read are regular ones: nothing waits for the writer of a FIFO."""

from __future__ import annotations

import os
import signal
import socket

import pytest

from hoigs.core.errors import HoigsError
from hoigs.core.spec.loader import read_document
from hoigs.core.system.files import NotRegularError, parse_json, regular_file
from hoigs.core.system.joblib_file import load_joblib
from hoigs.core.system.npz import array_headers, load_array, load_arrays
from hoigs.core.system.unpickling import load_pickle, load_pickled_npy
from hoigs.metrics.lpips import _read_tensors
from hoigs.plugins.estimators import frame_files
from hoigs.plugins.estimators.depth_files import read_exr, read_png16
from hoigs.plugins.estimators.frame_files import FileDiagnostics, npz_shapes
from hoigs.plugins.estimators.masks_files import read_video_masks
from hoigs.plugins.readers.checked_files import read_lines
from hoigs.plugins.readers.lazy_frames import image_size, opened
from hoigs.preparation.body.body_files import read_bodies
from hoigs.preparation.prompts import read_prompts
from hoigs.studies.needs.search_space import load_search_spaces
from hoigs.viewing.paths import rate_of


def test_what_is_no_file_of_bytes_is_named(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("fifo")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
    for name, kind in (("fifo", "FIFO"), ("link", "FIFO"), ("socket", "socket")):
        with pytest.raises(NotRegularError, match=kind) as caught:
            regular_file(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)
    with pytest.raises(NotRegularError, match="device"):
        regular_file("/dev/zero")


def test_files_and_folders_pass_and_absence_is_said(tmp_path):
    (tmp_path / "a").touch()
    assert regular_file(tmp_path / "a") == tmp_path / "a"
    assert regular_file(str(tmp_path)) == str(tmp_path)
    with pytest.raises(FileNotFoundError):
        regular_file(tmp_path / "b")


def _noted(read):
    """What a reader that collects problems says, as an error."""

    def call(path):
        problems = FileDiagnostics("test", "")
        read(path, problems)
        problems.raise_if_any()

    return call


def _prompts(path):
    path.rename(path.with_name("a.prompts.json"))
    read_prompts(path.with_name("a.mp4"))


READERS = {
    "npz": load_arrays, "npz headers": array_headers, "npy": load_array, "json": parse_json,
    "spec": read_document, "lines": read_lines, "camera path": rate_of,
    "joblib": load_joblib, "pickle": load_pickle, "pickled npy": load_pickled_npy,
    "tensors": lambda path: read_bodies(path.rename(path.with_suffix(".pt"))),
    "image": opened, "image's size": image_size, "depth": read_png16, "exr": read_exr,
    "mask": _noted(lambda path, found: read_video_masks(path, "bright", found)),
    "estimated array": _noted(frame_files.load_array), "estimated shapes": _noted(npz_shapes),
    "estimated size": _noted(frame_files.image_size),
    "search spaces": load_search_spaces, "LPIPS": _read_tensors,
    "prompts": _prompts,
}  # fmt: skip


@pytest.mark.parametrize("reader", READERS)
def test_no_reader_waits_for_a_fifo(tmp_path, reader):
    def stop(*_):
        raise AssertionError(f"{reader} waits")

    os.mkfifo(tmp_path / "fifo.json")
    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(20)
    try:
        with pytest.raises((HoigsError, ValueError, OSError), match="FIFO"):
            READERS[reader](tmp_path / "fifo.json")
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)

"""Clips that claim too much, or lead elsewhere: a named error before any work."""

from __future__ import annotations

import json
import time
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from hoigs.core.clip_folder.check import check_clip
from hoigs.core.system.npz import array_headers, load_array, load_arrays


def header(clip, **keys):
    content = json.loads((clip / "clip.json").read_text()) | keys
    (clip / "clip.json").write_text(json.dumps(content))


def refused(hoigs, clip, *words):
    began = time.process_time()
    outcome = hoigs("train", clip, "--out", clip.parent / "run", "--device", "cpu")
    assert outcome.code == 2 and outcome.err.startswith("error: "), outcome.err
    assert "Traceback" not in outcome.err and len(outcome.err) < 5000
    for word in words:
        assert word in outcome.err, outcome.err
    assert "pickle=True" not in outcome.err and "allow_pickle" not in outcome.err
    assert not (clip.parent / "run").exists()
    assert time.process_time() - began < 20


@pytest.mark.parametrize("frames", [10**7, 10**12])
def test_as_many_frames_as_one_likes(hoigs, clip_copy, frames):
    header(clip_copy, frames=frames)
    refused(hoigs, clip_copy, "clip.json" if frames > 10**9 else "images/ holds 12 files")


def test_a_split_of_a_million_entries(hoigs, clip_copy):
    header(clip_copy, split={"train": list(range(10**6)), "test": [1, 2]})
    refused(hoigs, clip_copy, "split names frames 12-999999")


@pytest.mark.parametrize(
    "fps", [float("inf"), float("nan"), -1, 1e300, "many"], ids=["inf", "nan", "-1", "big", "text"]
)
def test_frame_rates(hoigs, clip_copy, fps):
    header(clip_copy, fps=fps)
    refused(hoigs, clip_copy, "fps")


@pytest.mark.parametrize("truth", ["/etc/passwd", "../../secret.npz", 7, ["a"], ""])
def test_a_truth_outside_of_the_clip(hoigs, clip_copy, truth):
    header(clip_copy, provenance={"truth": truth})
    refused(hoigs, clip_copy, "truth")


def test_a_truth_that_is_a_link_or_damaged(hoigs, clip_copy):
    (clip_copy / "truth.npz").unlink(missing_ok=True)
    (clip_copy / "truth.npz").symlink_to("/etc/passwd")
    header(clip_copy, provenance={"truth": "truth.npz"})
    refused(hoigs, clip_copy, "leaves the clip's folder")
    (clip_copy / "truth.npz").unlink()
    (clip_copy / "truth.npz").write_bytes(b"damaged")
    refused(hoigs, clip_copy, "truth.npz")


@pytest.mark.parametrize("file", ["cameras.npz", "points.npz", "depth/00002.npz"])
def test_empty_npz(hoigs, clip_copy, file):
    (clip_copy / file).write_bytes(b"")
    refused(hoigs, clip_copy, file)


def test_values_that_make_no_sense(hoigs, clip_copy):
    for file, name in (("points.npz", "points"), ("cameras.npz", "world_to_camera")):
        arrays = load_arrays(clip_copy / file)
        arrays[name][0, 0] = 1e30
        np.savez(clip_copy / file, **arrays)
    refused(hoigs, clip_copy, "points has values up to 1e+30",
            "world_to_camera has values up to 1e+30")  # fmt: skip


def test_deep_json(hoigs, clip_copy):
    (clip_copy / "clip.json").write_text("[" * 10**5 + "]" * 10**5)
    refused(hoigs, clip_copy, "nested too deeply")


def test_a_png_that_is_a_bomb(hoigs, clip_copy):
    size = 60_000
    header(clip_copy, width=size, height=size)
    first = min((clip_copy / "images").iterdir())
    Image.new("RGB", (8, 8)).save(first)
    data = bytearray(first.read_bytes())
    data[16:24] = size.to_bytes(4, "big") * 2  # its IHDR
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    first.write_bytes(data)
    refused(hoigs, clip_copy, "exceeds limit")


def bomb(path, count):
    """An npz of a few kilobytes that holds `count` zeros."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("points.npy", "w", force_zip64=True) as file,
    ):
        start = {"descr": "<f4", "fortran_order": False, "shape": (count // 3, 3)}
        np.lib.format.write_array_header_1_0(file, start)
        for _ in range(count // (3 * 2**18)):
            file.write(bytes(3 * 2**20))


def test_an_npz_that_is_a_bomb(tmp_path, clip_copy):
    bomb(clip_copy / "points.npz", 300 * 2**18)
    assert array_headers(clip_copy / "points.npz")["points"].nbytes == 300 * 2**20
    with pytest.raises(ValueError, match="more than 100 times as much"):
        load_arrays(clip_copy / "points.npz")
    assert any("more than 100 times" in str(p) for p in check_clip(clip_copy))


def test_npy_files(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.arange(6.0).reshape(2, 3).T)
    assert np.array_equal(load_array(path), np.arange(6.0).reshape(2, 3).T)
    for damaged in (b"", path.read_bytes()[:-4], b"\x93NUMPY\x01\x00\xff\xff{", b"text"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="not a readable npy"):
            load_array(path)
    long = b"{" + b" " * 20000 + b"'descr': '<f4', 'fortran_order': False, 'shape': (1,)}"
    path.write_bytes(b"\x93NUMPY\x02\x00" + len(long).to_bytes(4, "little") + long)
    with pytest.raises(ValueError, match="not a readable npy") as refusal:
        load_array(path)
    assert "allow_pickle" not in str(refusal.value)

"""ply-sequence: a picture a moment, in one file or by entity; the zip holds the folder."""

from __future__ import annotations

import zipfile

import pytest
from exported_run import tiny_run

import hoigs as h
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.exporters.ply import PlySequenceConfig, PlySequenceExporter, parse_ply


@pytest.mark.parametrize("merged", [True, False])
def test_pictures_are_ours(merged, request_of, psnr_to_ours, tmp_path):
    PlySequenceExporter(PlySequenceConfig(merged=merged)).export(request_of(), tmp_path / "out")
    folders = [tmp_path / "out"] if merged else [
        tmp_path / "out" / name for name in ("scene", "human", "object")
    ]  # fmt: skip
    for frame in (0, 3):
        parts = [parse_ply((folder / f"frame_{frame:04d}.ply").read_bytes()) for folder in folders]
        assert psnr_to_ours(Gaussians.cat(parts), frame) > 60


def test_a_zip(tmp_path):
    done = h.export(
        tiny_run(), format="ply-sequence", out=tmp_path / "x.zip", entities=["object"], end=2
    )
    assert list(done.files) == ["x.zip", "x.zip.json"] == sorted(p.name for p in tmp_path.iterdir())
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        names = archive.namelist()
        assert names == ["export.json", *(f"frame_{i:04d}.ply" for i in range(3))]
        assert len(parse_ply(archive.read("frame_0002.ply"))) > 0

"""spz, splat, sog and compressed-ply: GaussForge reads them back, and the loss is told in dB."""

from __future__ import annotations

import re

import pytest
import torch

from hoigs.core.registry.registry import default_registry
from hoigs.plugins.exporters.common.ply_file import parse_ply

gaussforge = pytest.importorskip("gaussforge", reason="not installed: hoigs[export]")


@pytest.mark.parametrize(
    ("name", "least"), [("spz", 35), ("sog", 30), ("compressed-ply", 30), ("splat", 20)]
)
def test_what_is_read_back_draws_the_picture(name, least, request_of, psnr_to_ours, tmp_path):
    request = request_of()
    entity = request.scene.entity("scene")
    with torch.no_grad():  # four steps leave the higher bands near zero
        before = entity.sh.clone()
        noise = torch.randn(before.shape, generator=torch.Generator().manual_seed(0))
        entity.sh[:, 1:].add_(0.05 * noise[:, 1:])
    try:
        exporter = default_registry().get(f"exporter:{name}")()
        done = exporter.export(request, tmp_path / "out")
        path = tmp_path / "out" / f"scene{exporter.suffixes[0]}"
        read = parse_ply(
            gaussforge.GaussForge().convert(path.read_bytes(), exporter.file_format, "ply")["data"]
        )
        score = psnr_to_ours(read, 0)
    finally:
        with torch.no_grad():
            entity.sh.copy_(before)
    assert score > least
    told = float(re.search(r": ([\d.]+) dB", done.omitted["precision"])[1])
    assert told == pytest.approx(score, abs=0.06)
    assert path.stat().st_size < 0.4 * len(read) * 4 * (17 + 3 * (entity.sh.shape[1] - 1))
    assert ("view-dependent colour" in done.omitted) == (name == "splat")

"""rgba: what PyAV decodes has our alpha and our colours."""

from __future__ import annotations

import av
import numpy as np
import pytest
import torch
from PIL import Image

from hoigs.plugins.exporters.rgba import RgbaConfig, RgbaExporter, straight_rgba


def decoded(path) -> list[np.ndarray]:
    if path.suffix == ".webm":  # ffmpeg's own vp9 decoder drops alpha
        with av.open(str(path)) as container:
            codec = av.CodecContext.create("libvpx-vp9", "r")
            packets = list(container.demux(video=0))
            return [f.to_ndarray(format="rgba") for p in packets for f in codec.decode(p)]
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="rgba") for f in container.decode(video=0)]


@pytest.mark.parametrize(("codec", "close"), [("png", 0), ("prores", 3), ("vp9", 8)])
def test_alpha_and_colour_come_back(codec, close, request_of, tmp_path):
    request = request_of("human")
    RgbaExporter(RgbaConfig(codec=codec)).export(request, tmp_path / "out")
    files = sorted(p for p in (tmp_path / "out").iterdir() if p.suffix != ".json")
    pngs = [np.asarray(Image.open(p)) for p in files if p.suffix == ".png"]
    images = pngs or decoded(files[0])
    assert len(images) == 4
    for i in (0, 3):
        with torch.no_grad():
            drawn = request.scene.render(
                request.moments[i], request.clip.cameras[i], only=["human"]
            )
        wanted = straight_rgba(drawn).astype(int)
        assert wanted[..., 3].min() == 0 and wanted[..., 3].max() > 200
        assert np.abs(images[i][..., 3] - wanted[..., 3]).mean() <= close
        seen = wanted[..., 3] > 128
        assert np.abs(images[i][seen][:, :3] - wanted[seen][:, :3]).mean() <= 2 * close + 1


def test_another_width(request_of, tmp_path):
    RgbaExporter(RgbaConfig(codec="png", width=32)).export(request_of(end=0.0), tmp_path / "out")
    assert Image.open(tmp_path / "out" / "frame_0000.png").size == (32, 32)

"""spz, splat, sog and compressed-ply, read back by their specifications alone; the loss is told in
dB.

GaussForge writes them, so it does not read them here.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image

from hoigs.core.registry.registry import default_registry
from hoigs.core.values.gaussians import SH_C0, Gaussians

pytest.importorskip("gaussforge", reason="not installed: hoigs[export]")

# of SH up to band 3 where y and z are negated: -y z -x | xy yz zz xz xx-yy | ...
FLIPPED_SH = [1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1]


def gaussians_of(means, quats, scales, opacities, sh) -> Gaussians:
    """quats: wxyz. scales: metres. opacities: in [0, 1]. sh: [N, K, 3]."""
    t = [torch.from_numpy(np.array(a, np.float32)) for a in (means, quats, scales, opacities, sh)]
    return Gaussians(t[0], t[1], t[2].log(), t[3].clamp(1e-4, 1 - 1e-4).logit(), t[4])


def smallest_three(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions from all components but the largest, in order, and its index."""
    fourth = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    return np.stack([np.insert(t, i, f) for t, i, f in zip(three, largest, fourth, strict=True)])


def read_spz(data: bytes) -> Gaussians:
    """Niantic's, version 3: x right, y up, z backward; given in axes with y and z negated."""
    raw = gzip.decompress(data)
    magic, version, n, degree, bits, _, _ = struct.unpack("<4sIIBBBB", raw[:16])
    assert (magic, version) == (b"NGSP", 3)
    count = (degree + 1) ** 2 - 1
    sizes = np.cumsum([16, 9 * n, n, 3 * n, 3 * n, 4 * n, 3 * n * count])
    assert sizes[-1] == len(raw)
    parts = [np.frombuffer(raw[a:b], np.uint8) for a, b in pairwise(sizes)]
    place = parts[0].reshape(n, 3, 3).astype(np.int64) @ (1, 2**8, 2**16)
    means = np.where(place < 2**23, place, place - 2**24) / 2.0**bits
    dc = (parts[2].reshape(n, 3) / 255 - 0.5) / 0.15
    packed = parts[4].view("<u4")
    fields = np.stack([packed >> s & 1023 for s in (20, 10, 0)], 1).astype(np.int64)
    three = np.where(fields & 512, -1, 1) * (fields & 511) / 511 / np.sqrt(2)
    x, y, z, w = smallest_three(three, packed >> 30).T
    sh = np.concatenate((dc[:, None], (parts[5].reshape(n, count, 3) - 128.0) / 128), 1)
    return gaussians_of(
        means * (1, -1, -1),
        np.stack((w, x, -y, -z), 1),
        np.exp(parts[3].reshape(n, 3) / 16 - 10),
        parts[1] / 255,
        sh * np.array(FLIPPED_SH[: count + 1])[:, None],
    )


def read_splat(data: bytes) -> Gaussians:
    """antimatter15's: 32 bytes each."""
    kind = [("place", "<f4", 3), ("size", "<f4", 3), ("color", "u1", 4), ("turn", "u1", 4)]
    rows = np.frombuffer(data, np.dtype(kind))
    color = rows["color"] / 255
    sh = (color[:, None, :3] - 0.5) / SH_C0
    return gaussians_of(rows["place"], (rows["turn"] - 128.0) / 128, rows["size"], color[:, 3], sh)


def read_sog(data: bytes) -> Gaussians:
    """PlayCanvas's, version 2; it has the axes of a PLY."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    meta = json.loads(archive.read("meta.json"))
    n = meta["count"]

    def image(name: str) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA")).astype(int)

    def pixels(key: str, k: int = 0) -> np.ndarray:
        return image(meta[key]["files"][k]).reshape(-1, 4)[:n]

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    share = (pixels("means", 1)[:, :3] * 256 + pixels("means", 0)[:, :3]) / 65535
    log = low + (high - low) * share
    quats, color = pixels("quats"), pixels("sh0")
    bands = meta["shN"]["bands"]
    count = (bands + 1) ** 2 - 1
    label = pixels("shN", 1) @ (1, 256, 0, 0)
    palette = image(meta["shN"]["files"][0])
    columns = (label % 64 * count)[:, None] + np.arange(count)
    rest = np.array(meta["shN"]["codebook"])[palette[(label // 64)[:, None], columns, :3]]
    dc = np.array(meta["sh0"]["codebook"])[color[:, :3]]
    return gaussians_of(
        np.sign(log) * np.expm1(np.abs(log)),
        smallest_three((quats[:, :3] / 255 - 0.5) * np.sqrt(2), quats[:, 3] - 252),
        np.exp(np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]]),
        color[:, 3] / 255,
        np.concatenate((dc[:, None], rest), 1),
    )


def read_compressed_ply(data: bytes) -> Gaussians:
    """PlayCanvas's: chunks of 256 with their bounds, four packed numbers each, SH of 8 bits."""
    head, body = data.split(b"end_header\n", 1)
    counts = dict(re.findall(r"element (\w+) (\d+)", head.decode()))
    n, chunks = int(counts["vertex"]), int(counts["chunk"])
    bounds = np.frombuffer(body, "<f4", 18 * chunks).reshape(chunks, 18)[np.arange(n) // 256]
    packed = np.frombuffer(body, "<u4", 4 * n, 72 * chunks).reshape(n, 4)
    count = head.count(b"f_rest_") // 3
    rest = np.frombuffer(body, np.uint8, 3 * n * count, 72 * chunks + 16 * n)

    def vector(column: int, first: int) -> np.ndarray:
        at = packed[:, column]
        share = np.stack(((at >> 21) / 2047, (at >> 11 & 1023) / 1023, (at & 2047) / 2047), 1)
        low, high = bounds[:, first : first + 3], bounds[:, first + 3 : first + 6]
        return low + (high - low) * share

    turn, color = packed[:, 1], packed[:, 3]
    three = np.stack([turn >> s & 1023 for s in (20, 10, 0)], 1) / 1023 - 0.5
    rgba = np.stack([color >> s & 255 for s in (24, 16, 8, 0)], 1) / 255
    rgb = bounds[:, 12:15] + (bounds[:, 15:18] - bounds[:, 12:15]) * rgba[:, :3]
    share = np.where(rest == 255, 1, np.where(rest == 0, 0, (rest + 0.5) / 256))
    sh = ((share - 0.5) * 8).reshape(n, 3, count).transpose(0, 2, 1)
    return gaussians_of(
        vector(0, 0),
        smallest_three(three * np.sqrt(2), turn >> 30),
        np.exp(vector(2, 6)),
        rgba[:, 3],
        np.concatenate((((rgb - 0.5) / SH_C0)[:, None], sh), 1),
    )


READERS = {
    "spz": (read_spz, 35),
    "sog": (read_sog, 30),
    "compressed-ply": (read_compressed_ply, 30),
    "splat": (read_splat, 20),
}


@pytest.mark.parametrize("name", READERS)
def test_what_is_read_back_draws_the_picture(name, request_of, psnr_to_ours, tmp_path):
    reader, least = READERS[name]
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
        read = reader(path.read_bytes())
        score = psnr_to_ours(read, 0)
    finally:
        with torch.no_grad():
            entity.sh.copy_(before)
    assert score > least
    told = float(re.search(r": ([\d.]+) dB", done.omitted["precision"])[1])
    assert told == pytest.approx(score, abs=0.2)
    assert path.stat().st_size < 0.4 * len(read) * 4 * (17 + 3 * (entity.sh.shape[1] - 1))
    assert ("view-dependent colour" in done.omitted) == (name == "splat")


@pytest.mark.parametrize("antialiased", [True, False])
def test_files_say_how_their_gaussians_were_trained(antialiased, request_of, monkeypatch, tmp_path):
    request = request_of("object")
    monkeypatch.setattr(request.scene, "antialiased", antialiased)
    for name, mark in (
        ("spz", lambda data: bool(gzip.decompress(data)[14] & 1)),
        ("sog", lambda data: json.loads(zipfile.ZipFile(io.BytesIO(data)).read("meta.json"))),
    ):
        default_registry().get(f"exporter:{name}")().export(request, tmp_path / name)
        found = mark((tmp_path / name / f"scene.{name}").read_bytes())
        assert (found if name == "spz" else found["antialias"]) is antialiased

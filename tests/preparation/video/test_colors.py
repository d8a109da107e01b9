"""Every pixel format comes out as FFmpeg's own conversion; HDR and wide colours as sRGB."""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.filter import Graph

from hoigs.preparation.video.frames import open_frames
from hoigs.preparation.video.pictures import VideoPicture, converted
from hoigs.preparation.video.source import SourceError, find_source
from hoigs.viewing.annotate.video import ScrubbedVideo

WIDTH, HEIGHT = 64, 48
LIMIT = 2.0  # of 255, mean
MATRICES = ("bt709", "bt601", "bt2020nc", "fcc", "smpte240m", "unknown")
# lossless or nearly so; containers that keep their tags
ENCODERS = {
    "ffv1": "mkv", "libx264": "mp4", "libx264rgb": "mkv", "libx265": "mp4", "libvpx-vp9": "webm",
    "prores_ks": "mov", "mjpeg": "avi", "mpeg4": "mp4", "mpeg2video": "mkv", "huffyuv": "avi",
    "utvideo": "avi", "qtrle": "mov", "png": "mov", "rawvideo": "nut",
    "v210": "mov", "libaom-av1": "mp4", "libsvtav1": "mp4",
}  # fmt: skip


def picture(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Smooth and colourful, RGB."""
    y, x = np.mgrid[:height, :width]
    ramp = np.stack([40 + 170 * x / width, 40 + 170 * y / height, 200 - 130 * x / width], -1)
    return ramp.round().astype(np.uint8)


def through(frame: Any, form: str, scale: str = "") -> Any:
    """FFmpeg's own conversion."""
    graph = Graph()
    size = {"width": frame.width, "height": frame.height}
    chain = [graph.add_buffer(format=frame.format, time_base=Fraction(1, 1000), **size)]
    chain += [graph.add("scale", f"flags=accurate_rnd+full_chroma_int+bicubic{scale}")]
    chain += [graph.add("format", form), graph.add("buffersink")]
    for first, second in itertools.pairwise(chain):
        first.link_to(second)
    graph.configure()
    graph.push(frame)
    return graph.pull()


def difference(pixels: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(pixels.astype(int) - other).mean())


def saturation(pixels: np.ndarray) -> float:
    return float(np.ptp(pixels.astype(int), -1).mean())


def tags(frame: Any, **values: int) -> Any:
    for name, value in values.items():
        setattr(frame, name, value)
    return frame


# one of each layout: planes, pairs, packed, without colour, with alpha, RGB; 8 to 16 bits
LAYOUTS = (
    "yuv420p", "yuvj422p", "yuv444p16le", "nv12", "p010le", "uyvy422", "gray10le", "yuva420p",
    "rgb24", "gbrp12le", "pal8",
)  # fmt: skip


@pytest.mark.parametrize("span", ["tv", "pc", "unknown"])
@pytest.mark.parametrize("matrix", MATRICES)
def test_every_matrix_and_span(matrix: str, span: str) -> None:
    assert formats_converted(LAYOUTS, matrix, span) == len(LAYOUTS)


@pytest.mark.parametrize("span", ["tv", "pc"])
def test_every_pixel_format(span: str) -> None:
    assert formats_converted(sorted(av.video.format.names), "bt709", span) > 150


def formats_converted(names: Iterable[str], matrix: str, span: str) -> int:
    """How many formats were compared with FFmpeg's own conversion."""
    rgb, tried = av.VideoFrame.from_ndarray(picture()), 0
    for name in names:
        options = f":out_range={span}" + (f":out_color_matrix={matrix}" * (matrix != "unknown"))
        try:
            frame = through(rgb, name, options)
            want = through(frame, "rgb24").to_ndarray()
        except (av.error.FFmpegError, NotImplementedError):  # FFmpeg does not write it, or read it
            continue
        assert difference(converted(frame, WIDTH, HEIGHT).to_ndarray(), want) <= LIMIT, name
        tried += 1
    return tried


def encode(
    path: Path,
    frames: list[np.ndarray],
    codec: str,
    pixels: str,
    *,
    form: str = "rgb24",
    aspect: Fraction | None = None,
    options: dict[str, str] | None = None,
    **colors: int,
) -> None:
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream(codec, rate=25, options=options or {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        if aspect:
            stream.codec_context.sample_aspect_ratio = aspect
        tags(stream.codec_context, **colors)
        for frame in frames:
            made = av.VideoFrame.from_ndarray(frame, format=form).reformat(format=pixels)
            out.mux(stream.encode(tags(made, **colors)))
        out.mux(stream.encode())


@pytest.mark.parametrize("codec", ENCODERS)
def test_every_format_that_an_encoder_writes(tmp_path: Path, codec: str) -> None:
    try:
        formats = [f.name for f in av.Codec(codec, "w").video_formats or ()]
    except av.codec.codec.UnknownCodecError:
        pytest.skip(f"this FFmpeg has no {codec}")
    tried, refused = 0, set()
    for pixels in formats or ("yuv420p", "rgb24", "gray", "yuyv422"):
        for matrix, span in ((1, 1), (5, 2), (9, 1)):
            path = tmp_path / f"{pixels}-{matrix}-{span}.{ENCODERS[codec]}"
            yuv = pixels.startswith(("yuv", "nv", "p0"))
            colors = {"colorspace": matrix, "color_range": span} if yuv else {}
            try:
                encode(path, [picture(64, 64)], codec, pixels, **colors)
                with av.open(str(path)) as container:
                    want = through(next(container.decode(video=0)), "rgb24").to_ndarray()
            except (av.error.FFmpegError, NotImplementedError, ValueError) as error:
                refused.add(f"{pixels}: {str(error).partition(': ')[0]}")
                continue
            assert difference(next(iter(open_frames(path))), want) <= LIMIT, path.name
            tried += 1
            if not yuv:
                break
    if not tried:
        pytest.skip(f"this FFmpeg reads no {codec} that it writes: {sorted(refused)}")


def hdr(pixels: np.ndarray, curve: int) -> np.ndarray:
    """The BT.2020 signal, 16 bit, of an sRGB picture whose white is at 203 cd/m² (BT.2408)."""
    v = pixels / 255.0
    light = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    light = (
        light
        @ np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]).T
    )
    if curve == 18:
        scene, a, b, c = 0.2645 * light, 0.17883277, 0.28466892, 0.55991073
        high = a * np.log((12 * scene - b).clip(1e-6)) + c
        signal = np.where(scene <= 1 / 12, np.sqrt(3 * scene), high)
    else:
        y = (light * 203 / 10000) ** (2610 / 16384)
        signal = ((3424 / 4096 + 2413 / 128 * y) / (1 + 2392 / 128 * y)) ** (2523 / 32)
    return (signal.clip(0, 1) * 65535).round().astype(np.uint16)


@pytest.mark.slow
@pytest.mark.parametrize("curve", [16, 18])
def test_hdr_keeps_its_colours(tmp_path: Path, curve: int) -> None:
    """PQ and HLG of ten bits in BT.2020, as phones write them."""
    path, truth = tmp_path / "phone.mkv", picture()
    encode(
        path, [hdr(truth, curve)] * 2, "ffv1", "yuv420p10le", form="rgb48le",
        colorspace=9, color_range=1, color_trc=curve, color_primaries=9,
    )  # fmt: skip
    first, second = open_frames(path)
    assert saturation(first) > 0.85 * saturation(truth)
    assert difference(first, truth) < 20 and (first == second).all()


@pytest.mark.slow
def test_wide_primaries_keep_their_colours() -> None:
    """BT.2020 of standard brightness: colours as they are, not paler."""
    truth = picture()
    light = (truth / 255.0) ** 2.2 @ np.linalg.inv(
        [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    ).T
    coded = (light.clip(0, 1) ** (1 / 2.2) * 65535).round().astype(np.uint16)
    frame = av.VideoFrame.from_ndarray(coded, format="rgb48le").reformat(format="yuv444p10le")
    tags(frame, color_trc=14, color_primaries=9)
    assert difference(through(frame, "rgb24").to_ndarray(), truth) > 6
    assert difference(converted(frame, WIDTH, HEIGHT).to_ndarray(), truth) < 4


@pytest.mark.parametrize(
    ("colors", "name"),
    [
        ({"colorspace": 8}, "YCgCo"),
        ({"colorspace": 14}, "ICtCp"),
        ({"color_trc": 9}, "logarithmic"),
    ],
)
def test_colours_that_cannot_be_converted_are_named(colors: dict[str, int], name: str) -> None:
    frame = av.VideoFrame.from_ndarray(picture()).reformat(format="yuv420p")
    with pytest.raises(SourceError, match=name):
        converted(tags(frame, **colors), WIDTH, HEIGHT)


@pytest.mark.parametrize("curve", [0, 1, 2, 3, 4, 5, 6, 7, 11, 12, 13, 14, 15])
def test_curves_of_displays_are_shown_as_they_are(curve: int) -> None:
    frame = av.VideoFrame.from_ndarray(picture()).reformat(format="yuv444p")
    found = converted(tags(frame, color_trc=curve), WIDTH, HEIGHT).to_ndarray()
    assert difference(found, picture()) <= LIMIT


@pytest.mark.parametrize(("aspect", "shown"), [((2, 1), (160, 96)), ((8, 9), (80, 108))])
def test_pixels_that_are_not_square(
    tmp_path: Path, aspect: tuple[int, int], shown: tuple[int, int]
) -> None:
    path = tmp_path / "wide.mp4"
    encode(path, [picture(80, 96)] * 2, "libx264", "yuv420p", aspect=Fraction(*aspect))
    frames = open_frames(path)
    assert (frames.width, frames.height) == shown
    assert difference(next(iter(frames)), picture(*shown)) < 6
    scrubbed = ScrubbedVideo(path)
    assert (scrubbed.width, scrubbed.height) == shown
    assert scrubbed.rgb(1).shape == (shown[1], shown[0], 3)
    scrubbed.close()


def test_pixels_of_no_picture_are_refused() -> None:
    with pytest.raises(SourceError, match="1:200"):
        VideoPicture(av.VideoFrame.from_ndarray(picture()), Fraction(1, 200))


# a matrix as in a video's header, and where the stored picture's first and last pixels are shown
TURNED = {
    "as it is": ((1, 0, 0, 1), lambda p: p),
    "clockwise": ((0, 1, -1, 0), lambda p: np.rot90(p, -1)),
    "upside down": ((-1, 0, 0, -1), lambda p: np.rot90(p, 2)),
    "counter-clockwise": ((0, -1, 1, 0), np.rot90),
    "mirrored": ((-1, 0, 0, 1), lambda p: p[:, ::-1]),
    "flipped": ((1, 0, 0, -1), lambda p: p[::-1]),
    "transposed": ((0, 1, 1, 0), lambda p: p.transpose(1, 0, 2)),
    "transposed otherwise": ((0, -1, -1, 0), lambda p: np.rot90(p, 2).transpose(1, 0, 2)),
}


@pytest.mark.parametrize("turn", TURNED)
def test_a_phones_orientation_is_obeyed(tmp_path: Path, turn: str) -> None:
    (a, b, c, d), upright = TURNED[turn]
    path = tmp_path / "phone.mp4"
    encode(path, [picture()] * 2, "libx264", "yuv420p")
    data, one = bytearray(path.read_bytes()), 1 << 16
    at = data.index(b"tkhd") + 44  # the track's matrix
    data[at : at + 36] = struct.pack(">9i", a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    frames, want = open_frames(path), upright(picture())
    assert (frames.height, frames.width) == want.shape[:2]
    assert difference(next(iter(frames)), want) < 6


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_a_pipe_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pipe.mp4"
    os.mkfifo(path)
    for reads in (open_frames, ScrubbedVideo, find_source):
        with pytest.raises(SourceError, match=r"pipe\.mp4"):
            reads(path)

"""Pictorial textures: leaves, framed prints, a window, the handled box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw

from hoigs.synthesis.room.textures import Color, fractal_noise, hex_color

Array = np.ndarray


def painted(
    size: tuple[int, int], color: Color, paint: Callable[[ImageDraw.ImageDraw], None]
) -> Array:
    """A picture drawn with PIL at twice the size and shrunk, so that edges are smooth."""
    height, width = size
    image = Image.new("RGB", (2 * width, 2 * height), rgb8(color))
    paint(ImageDraw.Draw(image))
    return np.asarray(image.resize((width, height), Image.Resampling.BOX), float) / 255


def rgb8(color: Color) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in color)
    return red, green, blue


def foliage(rng: np.random.Generator, size: int) -> Array:
    """Leaves as overlapping ellipses in many greens."""

    def paint(draw: ImageDraw.ImageDraw) -> None:
        for _ in range(420):
            x, y = rng.uniform(0, 2 * size, 2)
            a, b = rng.uniform(12, 34), rng.uniform(6, 16)
            if rng.uniform() < 0.5:
                a, b = b, a
            shade = rng.uniform(0.55, 1.25)
            green = (0.20 * shade + 0.05, 0.47 * shade, 0.18 * shade)
            draw.ellipse((x - a, y - b, x + a, y + b), fill=rgb8(green))

    return painted((size, size), (0.10, 0.27, 0.10), paint)


def poster(rng: np.random.Generator, height: int, width: int, style: int) -> Array:
    """A framed print: 0 hills under a sun, 1 coloured blocks, 2 rings."""

    def hills(draw: ImageDraw.ImageDraw) -> None:
        w, h = 2 * width, 2 * height
        draw.ellipse((0.55 * w, 0.16 * h, 0.82 * w, 0.16 * h + 0.27 * w), fill="#f2c14e")
        for k, tone in enumerate(("#7aa5a8", "#4c7d83", "#2d5a63", "#1c3b45")):
            x = np.linspace(0, w, 40)
            y = h * (0.48 + 0.13 * k) + 0.07 * h * np.sin(x / w * (5 + 2 * k) + rng.uniform(0, 6))
            draw.polygon([*zip(x, y, strict=True), (w, h), (0, h)], fill=tone)

    def blocks(draw: ImageDraw.ImageDraw) -> None:
        tones = ("#d1495b", "#edae49", "#00798c", "#30638e", "#003d5b", "#f4f1de", "#f4f1de")
        for row in range(5):
            for column in range(4):
                x, y = column * width / 2, row * 2 * height / 5
                draw.rectangle((x + 3, y + 3, x + width / 2 - 3, y + 2 * height / 5 - 3),
                               fill=str(rng.choice(tones)))  # fmt: skip

    def rings(draw: ImageDraw.ImageDraw) -> None:
        for k, tone in enumerate(("#e76f51", "#f4a261", "#e9c46a", "#2a9d8f", "#264653")):
            r = (0.86 - 0.17 * k) * width
            draw.ellipse((width - r, height - r, width + r, height + r), fill=tone)

    inside = painted((height, width), (0.95, 0.92, 0.84), (hills, blocks, rings)[style % 3])
    edge = max(4, width // 20)
    frame = np.broadcast_to(np.asarray((0.20, 0.14, 0.10)), inside.shape).copy()
    mount = np.broadcast_to(np.asarray((0.96, 0.95, 0.92)), inside.shape)
    frame[edge:-edge, edge:-edge] = mount[edge:-edge, edge:-edge]
    frame[2 * edge : -2 * edge, 2 * edge : -2 * edge] = inside[
        2 * edge : -2 * edge, 2 * edge : -2 * edge
    ]
    return frame


def window_view(rng: np.random.Generator, height: int, width: int) -> Array:
    """A bright window: sky, far trees, white bars."""
    v, u = (np.mgrid[0:height, 0:width] + 0.5) / np.array([height, width]).reshape(2, 1, 1)
    sky = (
        np.array([0.55, 0.75, 0.95]) * (1 - v[..., None])
        + np.array([0.92, 0.96, 1.0]) * v[..., None]
    )
    cloud = np.clip(fractal_noise(rng, height, width, (4, 3), 4) * 1.8, 0, 1)[..., None]
    image = sky * (1 - cloud) + cloud
    trees = v > 0.72 + 0.09 * fractal_noise(rng, height, width, (1, 8), 4)
    green = (
        np.array([0.36, 0.54, 0.34])
        * (1 + 0.3 * fractal_noise(rng, height, width, (20, 20), 3))[..., None]
    )
    image = np.where(trees[..., None], green, image)
    bar = (np.minimum(np.minimum(u, 1 - u), np.abs(u - 0.5)) * width < 9) | (
        np.minimum(np.minimum(v, 1 - v), np.abs(v - 0.45)) * width < 9
    )
    return np.clip(np.where(bar[..., None], np.array([0.97, 0.96, 0.94]), image), 0, 1)


def faded(image: Array, contrast: float) -> Array:
    """An image blended with its mean colour; a contrast of 1 changes nothing."""
    if contrast == 1:
        return image
    mean = image.mean((0, 1))
    faded: Array = mean + contrast * (image - mean)
    return faded


def crate_faces(rng: np.random.Generator, size: int, textured: bool = True) -> list[Array]:
    """Six faces (+x -x +y -y +z -z) of the handled box, each with a pattern of its own, so that a
    turn is always visible."""
    if not textured:
        return [np.full((8, 8, 3), hex_color("#d9853b"))] * 6
    n = 2 * size
    cream, coral, teal, navy, sun = "#f6ecd2", "#e4572e", "#17838c", "#22395b", "#f3a712"

    def checks(draw: ImageDraw.ImageDraw) -> None:
        step = n / 6
        for i in range(6):
            for j in range(6):
                if (i + j) % 2:
                    draw.rectangle((i * step, j * step, (i + 1) * step, (j + 1) * step), fill=teal)

    def stripes(draw: ImageDraw.ImageDraw) -> None:
        for k in range(-6, 7):
            x = k * n / 3.5
            draw.polygon([(x, 0), (x + n / 7, 0), (x + n / 7 + n, n), (x + n, n)], fill=coral)

    def dots(draw: ImageDraw.ImageDraw) -> None:
        for i in range(4):
            for j in range(4):
                x, y, r = (i + 0.5) * n / 4, (j + 0.5) * n / 4, n / 12
                draw.ellipse((x - r, y - r, x + r, y + r), fill=cream if (i + j) % 2 else sun)

    def star(draw: ImageDraw.ImageDraw) -> None:
        draw.rectangle((0, 0.40 * n, n, 0.60 * n), fill=navy)
        angle = np.arange(10) * np.pi / 5 - np.pi / 2
        radius = np.where(np.arange(10) % 2, 0.17, 0.40) * n
        draw.polygon([(n / 2 + r * np.cos(a), n / 2 + r * np.sin(a))
                      for r, a in zip(radius, angle, strict=True)], fill=coral)  # fmt: skip

    def ribbon(draw: ImageDraw.ImageDraw) -> None:
        draw.rectangle((0.40 * n, 0, 0.60 * n, n), fill=coral)
        draw.rectangle((0, 0.40 * n, n, 0.60 * n), fill=sun)
        draw.ellipse((0.36 * n, 0.36 * n, 0.64 * n, 0.64 * n), fill=cream)

    designs: list[tuple[str, Callable[[ImageDraw.ImageDraw], None]]] = [
        (cream, checks), (sun, stripes), (teal, ribbon), (navy, checks), (cream, star),
        (navy, dots),
    ]  # fmt: skip
    faces = []
    for ground, design in designs:
        face = painted((size, size), hex_color(ground), design)
        v, u = (np.mgrid[0:size, 0:size] + 0.5) / size
        rim = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
        worn = 1 + 0.05 * fractal_noise(rng, size, size, (6, 6), 4)
        edge = np.where(rim < 0.035, 0.62, 1.0)
        faces.append(np.clip(face * (worn * edge)[..., None], 0, 1))
    return faces

"""Procedural textures (sRGB arrays in [0, 1]) and the atlas of linear mip levels a kernel reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from PIL import Image, ImageDraw

Array = np.ndarray
Color = tuple[float, float, float]


def to_linear(srgb: Array) -> Array:
    """sRGB to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Array) -> Array:
    """Linear light to sRGB, clipped to [0, 1]."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def hex_color(code: str) -> Color:
    """ "#rrggbb" as three numbers in [0, 1]."""
    red, green, blue = (int(code[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


@dataclass(frozen=True)
class TextureAtlas:
    """All textures with their mip levels in one flat array.

    Attributes:
        texels: linear RGB. levels: (start, width, height) by texture and level.
    """

    texels: Float[Array, "T 3"]
    levels: Int[Array, "N L 3"]

    @staticmethod
    def pack(images: Sequence[Array], levels: int = 8) -> TextureAtlas:
        """Args: images: sRGB [H, W, 3] in [0, 1]."""
        texels, table, start = [], [], 0
        for image in images:
            level: Array = to_linear(np.asarray(image, np.float32)).astype(np.float32)
            rows = []
            for _ in range(levels):
                height, width = level.shape[:2]
                rows.append((start, width, height))
                texels.append(level.reshape(-1, 3))
                start += width * height
                if min(height, width) > 1:
                    even = level[: height // 2 * 2, : width // 2 * 2]
                    rows_summed = even[0::2] + even[1::2]
                    level = 0.25 * (rows_summed[:, 0::2] + rows_summed[:, 1::2])
            table.append(rows)
        return TextureAtlas(np.concatenate(texels), np.asarray(table, np.int32))

    def extended(self, images: Sequence[Array]) -> TextureAtlas:
        """These textures and more, with the next numbers."""
        more = TextureAtlas.pack(images, self.levels.shape[1])
        levels = more.levels + np.array([len(self.texels), 0, 0], np.int32)
        return TextureAtlas(
            np.concatenate((self.texels, more.texels)), np.concatenate((self.levels, levels))
        )


def fractal_noise(
    rng: np.random.Generator, height: int, width: int, cells: tuple[float, float], octaves: int = 4
) -> Float[Array, "H W"]:
    """Value noise in about [-1, 1]; the first octave has `cells` lattice cells down and across."""
    total, weight = np.zeros((height, width)), 0.0
    for k in range(octaves):
        rows, columns = (max(2, int(c * 2**k)) + 3 for c in cells)
        lattice = rng.uniform(-1, 1, (min(rows, height + 3), min(columns, width + 3)))
        y = np.linspace(1, lattice.shape[0] - 2, height)
        x = np.linspace(1, lattice.shape[1] - 2, width)
        total += _separable(lattice, y, x) * 0.5**k
        weight += 0.5**k
    return total / weight


def _separable(lattice: Array, y: Array, x: Array) -> Array:
    """Smoothstep interpolation of a lattice at rows y and columns x."""

    def weights(position: Array, size: int) -> tuple[Array, Array, Array]:
        low = np.clip(position.astype(int), 0, size - 2)
        f = position - low
        return low, low + 1, f * f * (3 - 2 * f)

    y0, y1, fy = weights(y, lattice.shape[0])
    x0, x1, fx = weights(x, lattice.shape[1])
    rows = lattice[y0] * (1 - fy)[:, None] + lattice[y1] * fy[:, None]
    return rows[:, x0] * (1 - fx) + rows[:, x1] * fx


def planks(
    rng: np.random.Generator,
    height: int,
    width: int,
    rows: int,
    color: Color = (0.70, 0.52, 0.35),
    contrast: float = 1.0,
) -> Array:
    """Wooden boards along x, each with its own shade, grain and end joint."""
    grain = fractal_noise(rng, height, width, (rows * 6, 5), 4)
    fine = fractal_noise(rng, height, width, (height // 3, 24), 2)
    board = height / rows
    row = np.minimum((np.arange(height) / board).astype(int), rows - 1)
    starts = rng.uniform(0, 1, rows)
    length = rng.uniform(0.28, 0.42, rows)
    x = np.arange(width)[None] / width
    piece = np.floor((x + starts[row][:, None]) / length[row][:, None])
    shade = np.sin(piece * 12.9898 + row[:, None] * 78.233) * 43758.5453
    shade = shade - np.floor(shade)
    value = 1 + contrast * (0.20 * (shade - 0.5) + 0.14 * grain + 0.06 * fine)
    image = np.asarray(color) * value[..., None]
    image = image * (1 + contrast * 0.06 * (shade - 0.5)[..., None] * np.array([1, 0, -1]))
    across = (np.arange(height) / board) % 1
    seam = np.clip((np.minimum(across, 1 - across) * board) / 1.6, 0, 1)
    joint = ((x + starts[row][:, None]) / length[row][:, None]) % 1
    joint = np.clip(np.minimum(joint, 1 - joint) * length[row][:, None] * width / 1.6, 0, 1)
    return np.clip(image * (0.55 + 0.45 * np.minimum(seam[:, None], joint))[..., None], 0, 1)


def plaster(
    rng: np.random.Generator, height: int, width: int, color: Color, amount: float = 0.05
) -> Array:
    """A painted wall: slow blotches and a fine grain."""
    blotch = fractal_noise(rng, height, width, (5, 7), 4)
    grain = fractal_noise(rng, height, width, (height // 4, width // 4), 2)
    return np.clip(np.asarray(color) * (1 + amount * (blotch + 0.8 * grain))[..., None], 0, 1)


def wallpaper(rng: np.random.Generator, height: int, width: int, colors: Sequence[Color],
              repeat: int) -> Array:  # fmt: skip
    """A wall of broad soft stripes with a small lozenge on every second one."""
    base = plaster(rng, height, width, colors[0], 0.045)
    v, u = np.mgrid[0:height, 0:width] / np.array([height, width]).reshape(2, 1, 1)
    phase = (u * repeat) % 1
    stripe = _band(phase, 0.0, 0.5, 0.02)
    base = base * (1 + 0.07 * stripe[..., None])
    rows = repeat * height / width * 1.6
    shift = (np.floor(u * repeat) % 2) * 0.5
    cell = np.abs((v * rows + shift) % 1 - 0.5)
    lozenge = np.abs(phase - 0.25) / 0.16 + cell / 0.22
    mark = np.clip((1 - lozenge) * 6, 0, 1)[..., None]
    return np.clip(base * (1 - 0.4 * mark) + 0.4 * mark * np.asarray(colors[1]), 0, 1)


def rug(rng: np.random.Generator, size: int, colors: Sequence[Color]) -> Array:
    """A woven square: border bands and a field of nested lozenges."""
    v, u = (np.mgrid[0:size, 0:size] + 0.5) / size
    rim = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    lozenges = (np.abs((u * 3) % 1 - 0.5) + np.abs((v * 3) % 1 - 0.5)) * 2
    palette = np.asarray(colors)
    index = np.where(
        lozenges < 0.35, 1, np.where(lozenges < 0.6, 2, np.where(lozenges < 0.75, 3, 0))
    )
    index = np.where(rim < 0.11, 3, index)
    index = np.where(rim < 0.085, 1, index)
    index = np.where(rim < 0.055, 2, index)
    teeth = (np.floor((u + v) * 30) + np.floor((u - v) * 30)) % 2
    index = np.where((rim < 0.10) & (rim > 0.06) & (teeth > 0), 2, index)
    index = np.where(rim < 0.02, 3, index)
    weave = 1 + 0.07 * fractal_noise(rng, size, size, (size / 3, size / 3), 1)
    return np.clip(palette[index] * weave[..., None], 0, 1)


def fabric(rng: np.random.Generator, size: int, color: Color) -> Array:
    """Plain cloth with a coarse weave."""
    v, u = np.mgrid[0:size, 0:size]
    weave = 0.05 * np.sin(u * np.pi / 4) * np.sin(v * np.pi / 4)
    value = 1 + weave + 0.06 * fractal_noise(rng, size, size, (12, 12), 4)
    return np.clip(np.asarray(color) * value[..., None], 0, 1)


def _band(phase: Array, start: float, end: float, soft: float) -> Array:
    """1 between start and end, with soft edges."""
    return np.clip((phase - start) / soft, 0, 1) * np.clip((end - phase) / soft, 0, 1)


# Pictorial textures: leaves, framed prints, a window, the handled box.


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
    return mean + contrast * (image - mean)


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

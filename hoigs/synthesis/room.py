"""The static room: floor, walls, furniture and pictures, every surface with a texture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hoigs.synthesis import textures as designs
from hoigs.synthesis import textures as tx
from hoigs.synthesis.meshes import TexturedMesh, ball, box, cylinder, lathe, quad

LOW, HIGH = (-2.7, 0.0, -1.75), (2.7, 2.75, 4.6)


@dataclass
class Palette:
    """Collects textures and numbers them."""

    images: list[np.ndarray] = field(default_factory=list)

    def add(self, image: np.ndarray) -> int:
        self.images.append(image)
        return len(self.images) - 1

    def plain(self, code: str) -> int:
        return self.add(np.full((4, 4, 3), tx.hex_color(code)))


@dataclass(frozen=True)
class Stand:
    """Something the object stands on: a square stool whose top is at `height`."""

    x: float
    z: float
    height: float
    width: float = 0.42
    depth: float = 0.42
    yaw: float = 0.0


@dataclass(frozen=True)
class Room:
    """shell: floor, walls, ceiling; they cast no shadow, the sun shines through them. props: all
    else that stands still."""

    shell: TexturedMesh
    props: TexturedMesh


def build_room(palette: Palette, stands: Sequence[Stand], seed: int) -> Room:
    """A living room 5.4 m wide; `stands` are the stools that the choreography needs."""
    rng = np.random.default_rng(seed)
    props = [
        *_rug(palette, rng),
        *_pictures(palette, rng),
        *_bookcase(palette, rng),
        *_plant(palette, rng),
        *_lamp(palette),
        *_armchair(palette, rng),
        *_skirting(palette),
        *_stools(palette, rng, stands),
    ]
    return Room(_shell(palette, rng), TexturedMesh.join(props))


def _shell(palette: Palette, rng: np.random.Generator) -> TexturedMesh:
    (x0, y0, z0), (x1, y1, z1) = LOW, HIGH
    floor = palette.add(tx.planks(rng, 1024, 1024, 26, (0.70, 0.53, 0.37)))
    sand, sage = (0.86, 0.81, 0.71), (0.56, 0.66, 0.60)
    back = palette.add(tx.wallpaper(rng, 512, 1024, (sage, (0.90, 0.88, 0.78)), 22))
    side = palette.add(tx.plaster(rng, 512, 1024, sand))
    front = palette.add(tx.plaster(rng, 256, 512, (0.80, 0.77, 0.72)))
    top = palette.plain("#f4f1ea")
    return TexturedMesh.join(
        [
            quad(np.array([[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]]), floor),
            quad(np.array([[x0, y1, z0], [x1, y1, z0], [x1, y0, z0], [x0, y0, z0]]), back),
            quad(np.array([[x0, y1, z1], [x0, y1, z0], [x0, y0, z0], [x0, y0, z1]]), side),
            quad(np.array([[x1, y1, z0], [x1, y1, z1], [x1, y0, z1], [x1, y0, z0]]), side),
            quad(np.array([[x1, y1, z1], [x0, y1, z1], [x0, y0, z1], [x1, y0, z1]]), front),
            quad(np.array([[x0, y1, z1], [x1, y1, z1], [x1, y1, z0], [x0, y1, z0]]), top),
        ]
    )


def _rug(palette: Palette, rng: np.random.Generator) -> list[TexturedMesh]:
    colors = [tx.hex_color(c) for c in ("#a63d40", "#e9d8a6", "#1f4e5f", "#d98e4a")]
    weave = palette.add(tx.rug(rng, 512, colors))
    edge = palette.plain("#5b2a2c")
    return [box((2.3, 0.012, 1.9), [edge, edge, weave, edge, edge, edge]).moved(
        shift=(0, 0.0065, 0.25))]  # fmt: skip


def _pictures(palette: Palette, rng: np.random.Generator) -> list[TexturedMesh]:
    frame = palette.plain("#33241a")
    placed = []
    for x, y, width, height, style in ((-0.62, 1.72, 0.62, 0.80, 0), (0.20, 1.80, 0.52, 0.52, 2),
                                       (0.20, 1.16, 0.52, 0.40, 1)):  # fmt: skip
        image = palette.add(designs.poster(rng, int(320 * height / width), 320, style))
        picture = box((width, height, 0.03), [frame, frame, frame, frame, image, frame])
        placed.append(picture.moved(shift=(x, y, LOW[2] + 0.016)))
    view = palette.add(designs.window_view(rng, 512, 448))
    sill = palette.plain("#efece4")
    window = box((0.05, 1.35, 1.20), [view, sill, sill, sill, sill, sill])
    placed.append(window.moved(shift=(LOW[0] + 0.026, 1.55, 0.2)))
    ledge = box((0.16, 0.04, 1.32), sill)
    placed.append(ledge.moved(shift=(LOW[0] + 0.08, 0.85, 0.2)))
    return placed


def _bookcase(palette: Palette, rng: np.random.Generator) -> list[TexturedMesh]:
    wood = palette.add(tx.planks(rng, 256, 256, 5, (0.50, 0.34, 0.22), 0.8))
    back = palette.add(tx.planks(rng, 128, 128, 6, (0.38, 0.26, 0.17), 0.8))
    spines = [palette.add(_spine(rng, code)) for code in
              ("#b23a48", "#2f6690", "#e0a458", "#3f7d58", "#f0ead6", "#5d4e75", "#d9654b",
               "#27474e")]  # fmt: skip
    width, depth, height, shelves = 1.15, 0.30, 1.86, 5
    x, z = 1.72, LOW[2] + depth / 2 + 0.01
    parts = [box((width, height, 0.02), back).moved(shift=(x, height / 2, LOW[2] + 0.012))]
    for side in (-1, 1):
        post = box((0.035, height, depth), wood)
        parts.append(post.moved(shift=(x + side * (width / 2 - 0.0175), height / 2, z)))
    gap = (height - 0.10) / shelves
    for level in range(shelves + 1):
        board = box((width - 0.07, 0.03, depth), wood)
        y = 0.065 + level * gap
        parts.append(board.moved(shift=(x, y, z)))
        if level < shelves:
            parts += _books(
                rng, spines, x - width / 2 + 0.05, x + width / 2 - 0.05, y + 0.016, z, gap
            )
    return parts


def _spine(rng: np.random.Generator, code: str) -> np.ndarray:
    image = tx.fabric(rng, 64, tx.hex_color(code))
    for row in (8, 12, 50, 54):
        image[row : row + 2] = image[row : row + 2] * 0.35 + 0.62 * np.array([0.95, 0.86, 0.60])
    image[22:40, 18:46] = image[22:40, 18:46] * 0.5 + 0.45
    return image


def _books(
    rng: np.random.Generator, spines: list[int], left: float, right: float, floor: float, z: float,
    gap: float,
) -> list[TexturedMesh]:  # fmt: skip
    """A row of books that fills most of a shelf, with one gap somewhere."""
    parts, x = [], left
    hole = rng.uniform(left + 0.15, right - 0.25)
    while x < right - 0.06:
        thick, tall = rng.uniform(0.030, 0.068), gap * rng.uniform(0.58, 0.85)
        deep = rng.uniform(0.17, 0.23)
        if hole < x < hole + 0.12:
            x = hole + 0.14
            continue
        book = box((thick - 0.003, tall, deep), int(rng.choice(spines)))
        parts.append(book.moved(shift=(x + thick / 2, floor + tall / 2, z + 0.13 - deep / 2)))
        x += thick
    return parts


def _plant(palette: Palette, rng: np.random.Generator) -> list[TexturedMesh]:
    leaves = palette.add(designs.foliage(rng, 256))
    clay = palette.add(tx.plaster(rng, 64, 64, (0.74, 0.42, 0.28), 0.12))
    soil = palette.plain("#3a2a20")
    pot = lathe([(0.20, 0.38), (0.21, 0.34), (0.18, 0.32), (0.14, 0.0)], clay)
    top = lathe([(1e-3, 0.35), (0.19, 0.35)], soil)
    bushes = [((0, 0.72, 0), 0.26), ((0.12, 0.96, 0.05), 0.20), ((-0.12, 0.92, -0.05), 0.19),
              ((0.02, 1.16, 0.0), 0.16), ((-0.10, 0.66, 0.14), 0.17)]  # fmt: skip
    crown = [ball(r, leaves, 1.1).moved(shift=c) for c, r in bushes]
    return [part.moved(shift=(-2.05, 0, -1.15)) for part in (pot, top, *crown)]


def _lamp(palette: Palette) -> list[TexturedMesh]:
    steel, shade = palette.plain("#4a4642"), palette.plain("#f7dfae")
    parts = [
        cylinder(0.15, 0.025, steel),
        cylinder(0.014, 1.45, steel),
        lathe([(0.13, 1.74), (0.22, 1.42)], shade),
        lathe([(1e-3, 1.73), (0.13, 1.73)], shade),
    ]
    return [part.moved(shift=(-1.32, 0, -1.42)) for part in parts]


def _armchair(palette: Palette, rng: np.random.Generator) -> list[TexturedMesh]:
    cloth = palette.add(tx.fabric(rng, 128, (0.80, 0.60, 0.24)))
    cushion = palette.add(_checks(rng))
    wood = palette.plain("#5a3f2a")
    parts = [
        box((0.66, 0.20, 0.62), cloth).moved(shift=(0, 0.30, 0)),
        box((0.66, 0.62, 0.14), cloth).moved(shift=(0, 0.58, -0.30)),
        box((0.13, 0.36, 0.66), cloth).moved(shift=(0.36, 0.42, 0)),
        box((0.13, 0.36, 0.66), cloth).moved(shift=(-0.36, 0.42, 0)),
        box((0.36, 0.34, 0.10), cushion).moved(_pitch(-0.25), (0, 0.58, -0.17)),
        *[
            box((0.05, 0.20, 0.05), wood).moved(shift=(sx * 0.34, 0.10, sz * 0.27))
            for sx in (-1, 1)
            for sz in (-1, 1)
        ],
    ]
    return [part.moved(yaw_matrix(-0.95), (2.08, 0, 0.05)) for part in parts]


def _checks(rng: np.random.Generator) -> np.ndarray:
    image = tx.fabric(rng, 128, (0.92, 0.90, 0.84))
    v, u = np.mgrid[0:128, 0:128] // 16
    return np.where(((u + v) % 2 == 0)[..., None], image, image * np.array([0.25, 0.45, 0.55]))


def _skirting(palette: Palette) -> list[TexturedMesh]:
    white = palette.plain("#e9e4d8")
    (x0, _, z0), (x1, _, z1) = LOW, HIGH
    along_x = box((x1 - x0, 0.10, 0.02), white)
    along_z = box((0.02, 0.10, z1 - z0), white)
    middle = (z0 + z1) / 2
    return [
        along_x.moved(shift=(0, 0.05, z0 + 0.01)),
        along_z.moved(shift=(x0 + 0.01, 0.05, middle)),
        along_z.moved(shift=(x1 - 0.01, 0.05, middle)),
    ]


def _stools(
    palette: Palette, rng: np.random.Generator, stands: Sequence[Stand]
) -> list[TexturedMesh]:
    parts = []
    for number, stand in enumerate(stands):
        tone = ((0.62, 0.43, 0.27), (0.30, 0.50, 0.56))[number % 2]
        wood = palette.add(tx.planks(rng, 128, 128, 4, tone, 0.9))
        top = box((stand.width, 0.035, stand.depth), wood).moved(
            shift=(0, stand.height - 0.0175, 0))  # fmt: skip
        rail = box((stand.width - 0.06, 0.05, stand.depth - 0.06), wood).moved(
            shift=(0, stand.height - 0.06, 0))  # fmt: skip
        legs = [
            box((0.045, stand.height - 0.04, 0.045), wood).moved(
                shift=(
                    sx * (stand.width / 2 - 0.04),
                    (stand.height - 0.04) / 2,
                    sz * (stand.depth / 2 - 0.04),
                )
            )
            for sx in (-1, 1)
            for sz in (-1, 1)
        ]
        parts += [p.moved(yaw_matrix(stand.yaw), (stand.x, 0, stand.z)) for p in (top, rail, *legs)]
    return parts


def yaw_matrix(angle: float) -> np.ndarray:
    """Rotation about y: z turns towards x, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _pitch(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])

"""Small images around the object, one a frame, with cameras of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from scipy import ndimage
from scipy.spatial.distance import cdist
from torch import Tensor

from hoigs.core.maths.frame_times import fill_gaps
from hoigs.core.values.camera import Camera
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.masks.separate import Images

MARGIN = 1.6  # side of a crop over the longer side of the mask's box
EDGES = 96  # pixels of the outline that a crop keeps
LIMB, NEAR = 0.08, 0.05  # metres: about a limb's bone, and in front of the camera
DARK = 0.05  # added before logarithms of brightness


@dataclass(frozen=True)
class Crops:
    """Square crops of one size.

    Attributes:
        frames: numbers of the frames that show the object. images: RGB in [0, 1].
        K, world_to_camera: of the crops' own cameras.
        masks: the object's. hidden: pixels of the person or of other objects that may hide a part
            of it, and those beyond the image.
        outside: pixels from the nearest one on which the object may be: its own, or hidden ones.
        edges: pixels of the mask's outline against the background, repeated to a fixed number.
    """

    frames: np.ndarray
    images: Float[Tensor, "C 3 S S"]
    K: Float[Tensor, "C 3 3"]
    world_to_camera: Float[Tensor, "C 4 4"]
    masks: Float[Tensor, "C 1 S S"]
    hidden: Float[Tensor, "C 1 S S"]
    outside: Float[Tensor, "C 1 S S"]
    edges: Float[Tensor, "C E 2"]
    edge_weights: Float[Tensor, " C"]

    def rows(self, rows: np.ndarray) -> Crops:
        """Some of the crops."""
        return Crops(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    @property
    def size(self) -> int:
        return self.images.shape[-1]

    def __len__(self) -> int:
        return len(self.frames)

    def project(
        self, points: Float[Tensor, "C P 3"]
    ) -> tuple[Float[Tensor, "C P 2"], Float[Tensor, "C P"]]:
        """Pixels of world points in the crop of each frame, and their depth."""
        view = self.world_to_camera
        seen = points @ view[:, :3, :3].mT + view[:, None, :3, 3]
        depth = seen[..., 2].clamp_min(0.05)
        xy = seen[..., :2] / depth[..., None]
        focal = torch.stack((self.K[:, 0, 0], self.K[:, 1, 1]), -1)
        return xy * focal[:, None] + self.K[:, None, :2, 2], depth

    def centers(self) -> Float[Tensor, "C 3"]:
        """Of the cameras."""
        view = self.world_to_camera
        return -(view[:, :3, :3].mT @ view[:, :3, 3:])[..., 0]

    def middles(self, rows: np.ndarray) -> Float[np.ndarray, "N 3"]:
        """Unit rays through the middles of the masks' boxes, world."""
        found = []
        for row in rows.tolist():
            y, x = self.masks[row, 0].nonzero().double().T.numpy() + 0.5
            middle = np.array([(x.min() + x.max()) / 2, (y.min() + y.max()) / 2, 1.0])
            ray = np.linalg.solve(self.K[row].double().numpy(), middle)
            ray = self.world_to_camera[row, :3, :3].double().numpy().T @ ray
            found.append(ray / np.linalg.norm(ray))
        return np.stack(found)

    def sample(self, maps: Float[Tensor, "C D S S"], xy: Float[Tensor, "C P 2"]) -> Tensor:
        """Bilinear values [C P D] of maps at pixels; those of the border beyond it."""
        grid = (xy / self.size * 2 - 1)[:, None]
        values = torch.nn.functional.grid_sample(
            maps, grid, mode="bilinear", padding_mode="border", align_corners=False
        )
        return values[:, :, 0].mT

    def features(self, blur: float) -> Float[Tensor, "C D S S"]:
        """Log colours between two blurs, of the object alone: texture without its lighting."""
        logs = torch.log(self.images + DARK)
        fine = _masked_blur(logs, self.masks, blur)
        return fine - _masked_blur(logs, self.masks, 4 * blur + 2)

    def hues(self, blur: float) -> Float[Tensor, "C D S S"]:
        """Log ratios of colours, which neither shading nor other sides beside a point change, and
        brightness between two blurs, which is all that something grey has."""
        logs = _masked_blur(torch.log(self.images + DARK), self.masks, blur)
        light = self.features(blur).mean(1, keepdim=True)
        return torch.cat((logs[:, :1] - logs[:, 1:2], logs[:, 2:] - logs[:, 1:2], light), 1)

    def contrast(self, blur: float) -> float:
        """Relative variation of brightness within the object."""
        maps = self.features(blur).mean(1, keepdim=True)
        return float(maps[self.masks > 0].std())


def make_crops(
    images: Images,
    masks: MaskStack,
    humans: MaskStack,
    others: MaskStack,
    cameras: Sequence[Camera],
    shown: Bool[np.ndarray, " F"],
    size: int,
    body: Float[Tensor, "F B 3"],
    behind: Float[np.ndarray, " F"],
) -> Crops:
    """Crops of the frames in `shown`, `size` pixels wide (an object is 0.6 of that).

    Args:
        others: pixels of other objects, whose depth is unknown: they hide whatever they cover.
        body: points of the person, world, metres. behind: depths from which on the person is
            behind all of the object, and hides nothing of it.
    """
    boxes = _boxes(masks, shown)
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("image", "K", "view", "mask", "hidden", "outside", "edges", "share")
    }
    for i, image in enumerate(images()):
        if not shown[i]:
            continue
        box = boxes[i]
        scale = size / (box[2] - box[0])
        mask = _cut(masks[i], box, size)
        inside = _cut(np.ones_like(masks[i]), box, size)
        K = cameras[i].K.double().numpy().copy()
        K[:2, 2] -= box[:2]
        K[:2] *= scale
        person = _cut(humans[i], box, size) & ~mask
        depths = _nearest_depths(person, K, cameras[i].to_camera(body[i]))
        hidden = person & (depths < behind[i]) | _cut(others[i], box, size) & ~mask
        cut = Image.fromarray(image).crop(tuple(box.round().astype(int)))
        edges, share = _edges(mask, hidden | ~inside, i)
        rows["image"].append(np.asarray(cut.resize((size, size), Image.Resampling.BOX)) / 255.0)
        rows["K"].append(K)
        rows["view"].append(cameras[i].world_to_camera.double().numpy())
        rows["mask"].append(mask)
        rows["hidden"].append(hidden | ~inside)
        rows["outside"].append(ndimage.distance_transform_edt(~(mask | hidden) & inside))
        rows["edges"].append(edges)
        rows["share"].append(np.array(share))
    stacks = {name: torch.from_numpy(np.stack(v)).float() for name, v in rows.items()}
    return Crops(
        np.flatnonzero(shown),
        stacks["image"].permute(0, 3, 1, 2).contiguous(),
        stacks["K"],
        stacks["view"],
        stacks["mask"][:, None],
        stacks["hidden"][:, None],
        stacks["outside"][:, None],
        stacks["edges"],
        stacks["share"],
    )


def _boxes(masks: MaskStack, shown: Bool[np.ndarray, " F"]) -> Float[np.ndarray, "F 4"]:
    """Square boxes about the masks, whole pixels: left, top, right, bottom."""
    found = np.zeros((len(masks), 3))
    for i in np.flatnonzero(shown).tolist():
        rows, columns = np.nonzero(masks[i])
        x, y = (columns.min() + columns.max() + 1) / 2, (rows.min() + rows.max() + 1) / 2
        found[i] = x, y, max(np.ptp(rows), np.ptp(columns)) + 1
    found = fill_gaps(found, shown)
    half = np.ceil(MARGIN * found[:, 2:] / 2)
    centers = found[:, :2].round()
    return np.concatenate((centers - half, centers + half), -1)


def _cut(mask: Bool[np.ndarray, "H W"], box: Float[np.ndarray, " 4"], size: int) -> np.ndarray:
    """A mask's part in a box, resized; nothing outside the image."""
    cut = Image.fromarray(mask.astype(np.uint8) * 255).crop(tuple(box.round().astype(int)))
    return np.asarray(cut.resize((size, size), Image.Resampling.BILINEAR)) > 127


def _nearest_depths(
    pixels: Bool[np.ndarray, "S S"], K: Float[np.ndarray, "3 3"], body: Float[Tensor, "B 3"]
) -> Float[np.ndarray, "S S"]:
    """Depth of the person at some pixels: the least of the points within `LIMB` in the image, or
    that of the nearest point; infinite elsewhere."""
    depths = np.full(pixels.shape, np.inf)
    rows, columns = np.nonzero(pixels)
    seen = body.double().numpy()
    seen = seen[seen[:, 2] > NEAR]
    if not len(rows) or not len(seen):
        return np.where(pixels, 0.0, depths)
    xy = seen[:, :2] / seen[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    away = cdist(np.stack((columns, rows), -1) + 0.5, xy) / K[0, 0] * seen[:, 2]
    close = away <= np.maximum(away.min(1, keepdims=True), LIMB)
    depths[rows, columns] = np.where(close, seen[:, 2], np.inf).min(1)
    return depths


def _edges(
    mask: Bool[np.ndarray, "S S"], hidden: Bool[np.ndarray, "S S"], seed: int
) -> tuple[Float[np.ndarray, "E 2"], float]:
    """Pixels of the outline that border on the background, and their share of the outline."""
    border = mask & ~ndimage.binary_erosion(mask)
    sure = border & ~ndimage.binary_dilation(hidden, iterations=2)
    rows, columns = np.nonzero(sure)
    if len(rows) < 8:
        return np.zeros((EDGES, 2)), 0.0
    chosen = np.random.default_rng(seed).choice(len(rows), EDGES, replace=len(rows) < EDGES)
    xy = np.stack((columns, rows), -1)[chosen] + 0.5
    return xy, len(rows) / max(1, int(border.sum()))


def _masked_blur(
    values: Float[Tensor, "C D S S"], masks: Float[Tensor, "C 1 S S"], sigma: float
) -> Float[Tensor, "C D S S"]:
    """Gaussian blur of what lies inside the masks, which nothing outside enters."""
    radius = max(1, round(2.5 * sigma))
    line = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / max(sigma, 0.3)) ** 2)
    line = line / line.sum()

    def blurred(maps: Tensor) -> Tensor:
        flat = maps.flatten(0, 1)[:, None]
        flat = torch.nn.functional.conv2d(flat, line[None, None, None], padding=(0, radius))
        flat = torch.nn.functional.conv2d(flat, line[None, None, :, None], padding=(radius, 0))
        return flat[:, 0].unflatten(0, maps.shape[:2])

    return blurred(values * masks) / blurred(masks).clamp_min(1e-3)

"""How an object moves, turns and grows in the image, against what one frame shows of it.

A mask's centroid and long axis say little where the border cuts it, where a hand hides a part, or
where it is as broad as long. So the mask and the colours of one frame are laid over those of every
other: of many angles, each at its best place and size, the way of least cost through the video is
taken (Viterbi), and refined.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from scipy import ndimage
from torch import Tensor

from hoigs.core.system.threads import one_thread
from hoigs.preparation.mask_stack import Outlines
from hoigs.preparation.objects.filmed import Filmed

CELLS, HALF = 28, 0.75  # of the template, and its half side in longer sides of the mask's box
BLUR = 0.9  # cells, of masks and colours
ANGLES = 24
PERSON = 0.3  # weight of a pixel that a person may hide
PHOTO = 0.4  # weight of the colours' correlation against the masks' overlap
TURN, FLIP = 0.15, 1.0  # cost of a radian a frame, squared, and the most that a turn costs
STEPS, REFINED = 5, 24  # of Adam: of all angles, and of the chosen ones
RATES = (0.03, 0.04, 0.02)  # of angle, log size, and place in template halves


@dataclass(frozen=True)
class Registered:
    """The object in each frame against frame `template`; NaN where it is not seen.

    Attributes:
        angles: radians from x to y in the image. sizes: 1 in that frame. centers: pixels of what
            is the mask's centroid there. overlaps: intersection over union of both masks.
    """

    template: int
    angles: Float[np.ndarray, " F"]
    sizes: Float[np.ndarray, " F"]
    centers: Float[np.ndarray, "F 2"]
    overlaps: Float[np.ndarray, " F"]


@one_thread()
def registered(filmed: Filmed, outlines: Outlines) -> Registered:
    """Every frame that shows the object against the one that shows most of it: the largest mask
    that the border does not cut, or one twice as large that it does."""
    masks = filmed.masks
    best = int((outlines.areas * np.where(outlines.whole, 1.0, 0.5)).argmax())
    rows, columns = np.nonzero(masks[best])
    half = HALF * float(max(np.ptp(rows), np.ptp(columns)) + 1)
    scale = min(1.0, CELLS / 2 / half)
    frames = np.flatnonzero(outlines.observed)
    maps = dict(zip(frames.tolist(), _maps(filmed, outlines.observed, scale), strict=True))
    centers = torch.from_numpy(outlines.centers * scale).float()
    template = _Template.of(maps[best], centers[best], half * scale)
    turns = torch.arange(ANGLES) * (2 * torch.pi / ANGLES)
    found = []
    for i in frames.tolist():
        ratio = outlines.areas[i] / outlines.areas[best] if outlines.whole[i] else 1.0
        start = torch.zeros(ANGLES, 4)
        start[:, 0], start[:, 1], start[:, 2:] = turns, 0.5 * np.log(ratio), centers[i]
        found.append(template.fitted(maps[i], start, STEPS, turning=False))
    way = _cheapest(torch.stack([cost for _, cost in found]).numpy(), frames, best)
    nothing = np.full(len(masks), np.nan)
    result = Registered(
        best, nothing.copy(), nothing.copy(), np.full((len(masks), 2), np.nan), nothing.copy()
    )
    for i, k, (poses, _) in zip(frames.tolist(), way, found, strict=True):
        pose, _ = template.fitted(maps[i], poses[k : k + 1], REFINED, turning=True)
        angle, size, *place = pose[0].tolist()
        result.angles[i], result.sizes[i] = angle, np.exp(size)
        result.centers[i] = np.array(place) / scale
        result.overlaps[i] = float(template.overlap(maps[i], pose)[0])
    return result


def _maps(
    filmed: Filmed, shown: Bool[np.ndarray, " F"], scale: float
) -> Iterator[Float[Tensor, "1 5 h w"]]:
    """Of each shown frame, reduced: the mask, the weight of other pixels, and three colours."""
    for i, image in enumerate(filmed.images()):
        if not shown[i]:
            continue
        mask, person, other = filmed.masks[i], filmed.humans[i], filmed.others[i]
        free = np.where(other, 0.0, np.where(person, PERSON, 1.0))
        size = (max(8, round(image.shape[1] * scale)), max(8, round(image.shape[0] * scale)))
        layers = [mask * 1.0, free, *np.moveaxis(np.log(image / 255 + 0.05), -1, 0)]
        small = [
            Image.fromarray(layer.astype(np.float32)).resize(size, Image.Resampling.BOX)
            for layer in layers
        ]
        blurred = [
            ndimage.gaussian_filter(np.asarray(layer), 0 if k == 1 else BLUR)
            for k, layer in enumerate(small)
        ]
        yield torch.from_numpy(np.stack(blurred))[None].float()


@dataclass(frozen=True)
class _Template:
    """One frame's square about the object.

    Attributes:
        grid: places of its cells about the middle, pixels of the reduced frames. half: its side.
    """

    mask: Float[Tensor, " N"]
    colors: Float[Tensor, "3 N"]
    grid: Float[Tensor, "N 2"]
    half: float

    @classmethod
    def of(cls, maps: Float[Tensor, "1 5 h w"], center: Tensor, half: float) -> _Template:
        line = (torch.arange(CELLS) + 0.5) / CELLS * 2 - 1
        grid = half * torch.cartesian_prod(line, line)
        values = _sampled(maps, (center + grid)[None])[0]
        return cls(values[0], values[2:], grid, half)

    def fitted(
        self, maps: Float[Tensor, "1 5 h w"], start: Float[Tensor, "B 4"], steps: int, turning: bool
    ) -> tuple[Float[Tensor, "B 4"], Float[Tensor, " B"]]:
        """Angle, log size and place from some starts, each moved to its own best, and its cost."""
        rates = torch.tensor((RATES[0] * turning, RATES[1], *(2 * [RATES[2] * self.half])))
        moved = torch.zeros_like(start, requires_grad=True)
        adam = torch.optim.Adam([moved], lr=1.0)
        for step in range(steps):
            adam.param_groups[0]["lr"] = 1.0 - step / steps
            adam.zero_grad()
            self.costs(maps, start + rates * moved).sum().backward()
            adam.step()
        with torch.no_grad():
            poses = start + rates * moved
            return poses, self.costs(maps, poses)

    def costs(self, maps: Tensor, poses: Float[Tensor, "B 4"]) -> Float[Tensor, " B"]:
        values = _sampled(maps, self._places(poses))
        shares = self._shares(values)
        weight = self.mask * values[:, 0]
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1e-3)
        own = self.colors - (weight[:, None] * self.colors).sum(-1, keepdim=True)
        theirs = values[:, 2:] - (weight[:, None] * values[:, 2:]).sum(-1, keepdim=True)
        dot, one, two = (
            (weight[:, None] * v).sum((1, 2)) for v in (own * theirs, own**2, theirs**2)
        )
        alike = dot / (one * two + 1e-6).sqrt()
        return (1 - shares) + PHOTO * (1 - alike)

    def overlap(self, maps: Tensor, poses: Float[Tensor, "B 4"]) -> Float[Tensor, " B"]:
        return self._shares(_sampled(maps, self._places(poses)))

    def _places(self, poses: Float[Tensor, "B 4"]) -> Float[Tensor, "B N 2"]:
        c, s = poses[:, 0].cos(), poses[:, 0].sin()
        turns = torch.stack((torch.stack((c, -s), -1), torch.stack((s, c), -1)), 1)
        scaled = poses[:, 1].exp()[:, None, None] * self.grid
        return scaled @ turns.mT + poses[:, None, 2:]

    def _shares(self, values: Float[Tensor, "B 5 N"]) -> Float[Tensor, " B"]:
        mask, free = values[:, 0], values[:, 1]
        weight = torch.maximum(mask, free)
        both = (weight * torch.minimum(mask, self.mask)).sum(-1)
        return both / (weight * torch.maximum(mask, self.mask)).sum(-1).clamp_min(1e-3)


def _sampled(maps: Float[Tensor, "1 5 h w"], xy: Float[Tensor, "B N 2"]) -> Float[Tensor, "B 5 N"]:
    """Bilinear values at pixels; zero, so of no weight, beyond the image."""
    size = torch.tensor((maps.shape[3], maps.shape[2]))
    grid = (xy / size * 2 - 1).reshape(1, 1, -1, 2)
    found = torch.nn.functional.grid_sample(maps, grid, align_corners=False)[0, :, 0]
    return found.unflatten(1, xy.shape[:2]).movedim(1, 0)


def _cheapest(
    costs: Float[np.ndarray, "F K"], frames: Float[np.ndarray, " F"], template: int
) -> Sequence[int]:
    """The angle of each frame: costs and turns add up to the least; none in the template."""
    steps = np.arange(ANGLES)
    turns = np.abs((steps[:, None] - steps + ANGLES // 2) % ANGLES - ANGLES // 2)
    turns = turns * (2 * np.pi / ANGLES)
    costs = costs.copy()
    costs[frames == template, 1:] = np.inf
    total, back = costs[0], []
    for row in range(1, len(costs)):
        gap = frames[row] - frames[row - 1]
        step = total[:, None] + np.minimum(TURN * turns**2 / gap, FLIP)
        back.append(step.argmin(0))
        total = step.min(0) + costs[row]
    way = [int(total.argmin())]
    for parents in reversed(back):
        way.append(int(parents[way[-1]]))
    return way[::-1]

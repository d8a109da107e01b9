"""What an object looks like: features of small cells, and a network learnt on the video itself.

Colours alone call a white door a white board. The features of a cell are its colour, that around
it, and histograms of the directions of edges at two sizes (Dalal and Triggs 2005); a network of two
small layers tells the object's cells from all others of the frames in which the object is known.
Since these are few, it also learns from pictures of them that are turned, scaled and lit otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional as F

from hoigs.core.system.threads import one_thread
from hoigs.plugins.estimators.object_tracker.footage import Footage

DIRECTIONS = 8
FINE, COARSE = 1, 4  # sides of a cell, pixels: least and largest
CELLS = 6  # cells across the radius of the object, about
WHOLE, FREE = 0.7, 0.05  # shares of a cell that are the object's and none of it
VIEWS = 16  # turned and scaled pictures of all known frames together
STEPS, OF_OBJECT, OF_OTHERS = 250, 256, 768  # of the training, and cells in each step
RATE = 0.01
HIDDEN = 48
LIMIT = 4.0  # largest log-odds
UNITS = (8.0, 3.0)  # of colours and of edges, so that both are of order one


def cell_features(colors: Float[np.ndarray, "h w 3"], side: int) -> Float[Tensor, "C r c"]:
    """Features of square cells of `side` pixels that cover a picture from its upper left corner."""
    image = torch.from_numpy(np.ascontiguousarray(colors)).permute(2, 0, 1)[None]
    light = image[:, :1] / 0.3
    across = F.pad(light[..., 2:] - light[..., :-2], (1, 1))
    down = F.pad(light[..., 2:, :] - light[..., :-2, :], (0, 0, 1, 1))
    length, angle = torch.hypot(across, down).sqrt(), torch.atan2(down, across)
    ways = torch.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    edges = torch.cos(angle - ways[:, None, None]).clamp(min=0) ** 4 * length
    cells = F.avg_pool2d(torch.cat([image / UNITS[0], edges / UNITS[1]], 1), side)
    color, edge = cells[:, :3], cells[:, 3:]
    around = [_around(color, 3), _around(edge, 3), _around(edge, 5)]
    return torch.cat([color, *around], 1)[0]


def _around(cells: Tensor, width: int) -> Tensor:
    """Means of squares of `width` cells about each, less of them at the picture's edge."""
    return F.avg_pool2d(cells, width, 1, width // 2, count_include_pad=False)


def half_breadth(mask: Bool[np.ndarray, "h w"]) -> float:
    """Pixels from the middle of a mask to its rim along its shorter axis, by second moments: the
    radius of a disc, and of a plate seen from its side half its thickness."""
    at = np.argwhere(mask)
    return 2 * float(np.sqrt(max(np.linalg.eigvalsh(np.cov(at.T))[0], 0))) if len(at) > 1 else 0.0


def cell_shares(mask: np.ndarray, side: int) -> Float[np.ndarray, "r c"]:
    """The share of each cell that a mask covers."""
    rows, columns = mask.shape[0] // side, mask.shape[1] // side
    cut = mask[: rows * side, : columns * side].astype(np.float32)
    return cut.reshape(rows, side, columns, side).mean((1, 3))


@dataclass(frozen=True)
class Appearance:
    """Log-odds of pixels to be the object's, by the looks of their surroundings.

    Attributes:
        side: of a cell, pixels. mean, spread: of the features.
    """

    footage: Footage
    side: int
    network: nn.Module
    mean: Float[Tensor, "C"]
    spread: Float[Tensor, "C"]
    _kept: dict[int, np.ndarray] = field(default_factory=dict)

    @classmethod
    @one_thread()
    def learnt(
        cls,
        footage: Footage,
        known: Mapping[int, Bool[np.ndarray, "h w"]],
        twins: Mapping[int, Bool[np.ndarray, "h w"]] | None = None,
    ) -> Appearance:
        """From frames in which the object's mask is known.

        Args:
            twins: pixels of things that look like it, from which nothing is learnt.
        """
        area = float(np.mean([mask.sum() for mask in known.values()]))
        side = int(np.clip(np.sqrt(area / np.pi) / CELLS, FINE, COARSE))
        of_object, others = [], []
        for image, mask, free in _pictures(footage, known, twins or {}):
            cells, share = cell_features(image, side), cell_shares(mask, side)
            allowed = cell_shares(free, side) > WHOLE
            flat = cells.flatten(1).T
            of_object.append(flat[torch.from_numpy((share > WHOLE).ravel())])
            others.append(flat[torch.from_numpy(((share < FREE) & allowed).ravel())])
        inside, outside = torch.cat(of_object), torch.cat(others)
        if not len(inside) or not len(outside):
            inside = outside = torch.cat([inside, outside])  # nothing to tell apart
        every = torch.cat([inside, outside])
        mean, spread = every.mean(0), every.std(0) + 1e-3
        network = _trained((inside - mean) / spread, (outside - mean) / spread)
        return cls(footage, side, network, mean, spread)

    def scaled(self, features: Float[Tensor, "C r c"]) -> Float[Tensor, "N C"]:
        """Features of a frame's cells, one a row, of spread one."""
        return (features.flatten(1).T - self.mean) / self.spread

    def cells(self, i: int) -> Float[np.ndarray, "r c"]:
        """Log-odds of the cells of a frame."""
        if i not in self._kept:
            features = cell_features(self.footage.colors(i), self.side)
            rows, columns = features.shape[1:]
            with torch.inference_mode():
                odds = self.network(self.scaled(features)).clamp(-LIMIT, LIMIT)
            self._kept[i] = odds.reshape(rows, columns).numpy().astype(np.float16)
        return self._kept[i].astype(np.float32)

    def odds(self, i: int) -> Float[np.ndarray, "h w"]:
        """Log-odds of the pixels of a frame."""
        cells, (height, width) = self.cells(i), self.footage.shape
        if self.side == 1:
            return cells
        rows, columns = (n * self.side for n in cells.shape)
        full = F.interpolate(
            torch.from_numpy(cells)[None, None], (rows, columns), mode="bilinear",
            align_corners=False,
        )  # fmt: skip
        beyond = (0, width - columns, 0, height - rows)
        return F.pad(full, beyond, mode="replicate")[0, 0].numpy()


TWIN = (0.7, 1.5, 0.8)  # least and largest area of the object's, least mean probability


def twins_of(
    looks: Appearance, known: Mapping[int, Bool[np.ndarray, "h w"]]
) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Other things of the known frames that look like the object, with their rims; frames without
    are left out. The network gives them away although it was told that they are others: cells that
    cannot be told apart are the object's more often than not, of as many of both."""
    found = {}
    for i, mask in known.items():
        own = ndimage.binary_dilation(mask, iterations=2 * looks.side)
        chance = 1 / (1 + np.exp(-looks.odds(i)))
        labels, count = ndimage.label((chance > 0.5) & ~own)
        rows = np.arange(1, count + 1)
        area = ndimage.sum_labels(np.ones_like(chance), labels, rows) / mask.sum()
        sure = ndimage.mean(chance, labels, rows) if count else area
        like = (area > TWIN[0]) & (area < TWIN[1]) & (sure > TWIN[2])
        if like.any():
            twins = np.isin(labels, rows[like])
            reach = max(4, int(0.15 * np.sqrt(mask.sum())))
            found[i] = ndimage.binary_dilation(twins, iterations=reach) & ~mask
    return found


def learnt_beside_twins(
    footage: Footage, known: Mapping[int, Bool[np.ndarray, "h w"]]
) -> tuple[Appearance, dict[int, Bool[np.ndarray, "h w"]]]:
    """Looks, and the `twins_of` the object in known frames, from which nothing was learnt."""
    looks = Appearance.learnt(footage, known)
    twins = twins_of(looks, known)
    return Appearance.learnt(footage, known, twins) if twins else looks, twins


def _pictures(
    footage: Footage,
    known: Mapping[int, Bool[np.ndarray, "h w"]],
    twins: Mapping[int, Bool[np.ndarray, "h w"]],
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Known frames and views of them: colours, the object's mask, and pixels to learn from."""
    rng = np.random.default_rng(0)
    each = max(1, VIEWS // len(known))
    for i, mask in known.items():
        colors, shown = footage.colors(i), ~footage.blank[i]
        if i in twins:
            shown = shown & ~twins[i]
        yield colors, mask, shown
        y, x = np.nonzero(mask)
        if not len(y):
            continue
        middle = np.array([y.mean(), x.mean()])
        half = float(max(np.ptp(y), np.ptp(x))) + 16
        for view in range(each):
            turn = rng.uniform(-np.pi, np.pi) if view % 2 else rng.uniform(-0.6, 0.6)
            size, light = np.exp(rng.uniform(-0.5, 0.5)), rng.uniform(0.85, 1.2)
            at = _window(middle, half, turn, size)
            layers = [*np.moveaxis(colors, -1, 0), mask.astype(np.float32), shown * 1.0]
            seen = [ndimage.map_coordinates(layer, at, order=1, mode="nearest") for layer in layers]
            inside = (at > -0.5).all(0) & (at[0] < colors.shape[0]) & (at[1] < colors.shape[1])
            image = np.stack(seen[:3], -1).astype(np.float32) * (light, 1.0, 1.0)
            yield image.astype(np.float32), (seen[3] > 0.5) & inside, (seen[4] > 0.5) & inside


def _window(
    middle: np.ndarray, half: float, turn: float, size: float
) -> Float[np.ndarray, "2 n n"]:
    """Rows and columns of the pixels that a turned and scaled picture takes from a frame."""
    n = int(half * size)
    y, x = np.mgrid[-n:n, -n:n] / size
    turned = np.sin(turn) * x + np.cos(turn) * y, np.cos(turn) * x - np.sin(turn) * y
    return np.stack(turned) + middle[:, None, None]


def _trained(inside: Float[Tensor, "N C"], outside: Float[Tensor, "M C"]) -> nn.Module:
    """A network that gives the log-odds of features, both kinds being equally probable before."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = nn.Sequential(
            nn.Linear(inside.shape[1], HIDDEN), nn.ReLU(),
            nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1), nn.Flatten(0),
        )  # fmt: skip
        optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=0.01)
        for step in range(STEPS):
            a = inside[torch.randint(len(inside), (OF_OBJECT,))]
            b = outside[torch.randint(len(outside), (OF_OTHERS,))]
            loss = F.softplus(-network(a)).mean() + F.softplus(network(b)).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            for group in optimizer.param_groups:
                group["lr"] = RATE * (1 - step / STEPS)
    return network.eval()

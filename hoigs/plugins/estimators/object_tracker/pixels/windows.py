"""Square windows around the object, at a size of at most about 120 pixels a side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIDE = 120


@dataclass(frozen=True)
class Window:
    """A square of `n` by `n` cells of `step` pixels each, from the pixel (x, y)."""

    x: int
    y: int
    n: int
    step: int

    @classmethod
    def around(cls, x: float, y: float, half: float) -> Window:
        step = max(1, int(np.ceil(2 * half / SIDE)))
        n = int(np.ceil(2 * half / step))
        return cls(round(x - n * step / 2), round(y - n * step / 2), n, step)

    def at(self, x: float, y: float) -> Window:
        """Of the same size around another point."""
        side = self.n * self.step / 2
        return Window(round(x - side), round(y - side), self.n, self.step)

    @property
    def center(self) -> tuple[float, float]:
        side = self.n * self.step / 2
        return self.x + side, self.y + side

    def cells(self, x: np.ndarray | float, y: np.ndarray | float) -> tuple:
        """Pixels of the image to cells of the window."""
        return (x - self.x) / self.step, (y - self.y) / self.step

    def cut(self, image: np.ndarray, outside: float = 0.0) -> np.ndarray:
        """The mean of each cell as float32; `outside` where the window leaves the image."""
        side = self.n * self.step
        h, w = image.shape[:2]
        part = np.full((side, side, *image.shape[2:]), outside, np.float32)
        y0, y1 = max(self.y, 0), min(self.y + side, h)
        x0, x1 = max(self.x, 0), min(self.x + side, w)
        if y0 < y1 and x0 < x1:
            part[y0 - self.y : y1 - self.y, x0 - self.x : x1 - self.x] = image[y0:y1, x0:x1]
        if self.step == 1:
            return part
        return part.reshape(self.n, self.step, self.n, self.step, *image.shape[2:]).mean((1, 3))

    def inside(self, shape: tuple[int, int]) -> np.ndarray:
        """Cells that lie in the image."""
        return self.cut(np.ones(shape, np.uint8)) > 0.5

    def paste(self, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """The window's values on a black image, interpolated to pixels."""
        from PIL import Image

        side = self.n * self.step
        grey = Image.fromarray(np.rint(values * 255).clip(0, 255).astype(np.uint8))
        full = np.asarray(grey.resize((side, side), Image.Resampling.BILINEAR))
        out = np.zeros(shape, np.uint8)
        y0, y1 = max(self.y, 0), min(self.y + side, shape[0])
        x0, x1 = max(self.x, 0), min(self.x + side, shape[1])
        if y0 < y1 and x0 < x1:
            out[y0:y1, x0:x1] = full[y0 - self.y : y1 - self.y, x0 - self.x : x1 - self.x]
        return out

"""Resolution: how many pixels are drawn while the picture moves, so that each fits its time."""

from __future__ import annotations

Size = tuple[int, int]

BUDGET_S = 0.07  # drawing and encoding of a moving picture: about 14 a second
SMALLEST = 128  # pixels of width
STEP = 16  # widths are multiples, so that a steady view keeps its size


class Resolution:
    """The image size for a canvas, from the time that earlier pictures took.

    Args:
        widest: pixels of width of a still picture at most. budget_s: seconds for a moving one.
    """

    def __init__(self, widest: int = 1280, budget_s: float = BUDGET_S) -> None:
        self.widest, self.budget_s = widest, budget_s
        self._width = 320.0

    def size(self, canvas: Size, moving: bool) -> Size:
        """Width and height in pixels with the aspect of the canvas."""
        full = min(canvas[0], self.widest)
        width = min(full, max(SMALLEST, round(self._width / STEP) * STEP)) if moving else full
        return max(1, width), max(1, round(width * canvas[1] / canvas[0]))

    def took(self, seconds: float) -> None:
        """Learn from one moving picture; times within a seventh of the budget change nothing."""
        share = self.budget_s / max(seconds, 1e-4)
        if not 0.87 < share < 1.15:
            self._width *= min(max(share**0.5, 0.7), 1.3)
        self._width = min(max(self._width, SMALLEST), self.widest)

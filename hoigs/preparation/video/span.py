"""Which part of a video is used: places as they are written, and the span between two of them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from hoigs.core.errors import SpecError

Pick = Literal["sharpest", "first"]  # which frame of each n
SLACK = 1e-3  # seconds: containers round times to their ticks
_FRAME = re.compile(r"(\d+)f")
_CLOCK = re.compile(r"(?:(?:(\d+):)?(\d{1,2}):)?(\d+(?:\.\d*)?|\.\d+)s?")
HOW = (
    '"2.5" is in seconds from the first frame, "1:02.5" in minutes and seconds, "75f" is frame '
    "75, counted from 0"
)


@dataclass(frozen=True)
class Place:
    """A place in a video.

    Attributes:
        value: seconds since the first frame, or a frame's number. in_frames: which of both.
    """

    value: float
    in_frames: bool = False

    def reached(self, number: int, seconds: float) -> bool:
        """Whether a frame, shown at `seconds`, is at this place or behind it."""
        return number >= self.value if self.in_frames else seconds >= self.value - SLACK

    def __str__(self) -> str:
        return f"frame {self.value:g}" if self.in_frames else f"{self.value:g} s"


def parse_place(text: str | float, what: str) -> Place:
    """A place as it is written: 2.5, "2.5", "1:02.5" or "75f".

    Raises:
        SpecError: it is none of these; `what` names it.
    """
    text = str(text).strip()
    if found := _FRAME.fullmatch(text):
        return Place(int(found[1]), in_frames=True)
    if found := _CLOCK.fullmatch(text):
        hours, minutes, seconds = (float(part or 0) for part in found.groups())
        return Place(3600 * hours + 60 * minutes + seconds)
    raise SpecError(f"{what} {text!r} is no place in a video; {HOW}")


@dataclass(frozen=True)
class Span:
    """From `start` on, until before `end`; None: the video's own."""

    start: Place | None = None
    end: Place | None = None

    @staticmethod
    def of(start: str | float | None, end: str | float | None) -> Span:
        """A span as options and flags give it.

        Raises:
            SpecError: a place cannot be read, or the end does not come after the start.
        """
        span = Span(
            None if start is None else parse_place(start, "--start"),
            None if end is None else parse_place(end, "--end"),
        )
        first, last = span.start or Place(0.0), span.end
        same = last is not None and (span.start is None or first.in_frames == last.in_frames)
        if last is not None and same and last.value <= first.value:
            raise SpecError(f"--end {last} does not come after --start {first}: no frame is left")
        return span

    def begun(self, number: int, seconds: float) -> bool:
        return self.start is None or self.start.reached(number, seconds)

    def over(self, number: int, seconds: float) -> bool:
        return self.end is not None and self.end.reached(number, seconds)

    def __str__(self) -> str:
        start = "" if self.start is None else f"--start {self.start}"
        end = "" if self.end is None else f"--end {self.end}"
        return f"{start} {end}".strip()

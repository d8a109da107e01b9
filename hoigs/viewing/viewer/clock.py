"""Clock: which frame is shown at a wall-clock time; play, pause, speed, loop and steps."""

from __future__ import annotations

import math


class Clock:
    """The time slider of a viewer. It may stand between frames.

    Args:
        frames: of the clip, numbered from 0. fps: frames a second at speed 1.

    Attributes:
        playing: whether time passes. speed: in parts of real time. loop: begin again at the end;
            otherwise playback stops at the last frame.
    """

    def __init__(self, frames: int, fps: float) -> None:
        self.last, self.fps = max(frames - 1, 0), fps
        self.playing, self.speed, self.loop = False, 1.0, True
        self._frame, self._since = 0.0, 0.0

    def frame(self, now: float) -> float:
        """The frame number at `now`, seconds of any steady clock; between frames a fraction."""
        if self.playing:
            passed = self._frame + (now - self._since) * self.fps * self.speed
            self._since = now
            if passed > self.last and not self.loop:
                self._frame, self.playing = float(self.last), False
            elif self.last == 0:
                self._frame = 0.0
            else:  # the last frame is shown as long as any other
                self._frame = min(passed % (self.last + 1), float(self.last) + 0.999)
        return min(self._frame, float(self.last))

    def play(self, now: float) -> None:
        """Start; from the first frame if the last one is shown and `loop` is off."""
        if not self.loop and self._frame >= self.last:
            self._frame = 0.0
        self.playing, self._since = True, now

    def pause(self, now: float) -> None:
        self._frame = self.frame(now)
        self.playing = False

    def seek(self, frame: float, now: float) -> None:
        """Go to a frame number, which is clamped to the clip; playing goes on from there."""
        self._frame, self._since = min(max(frame, 0.0), float(self.last)), now

    def step(self, by: int, now: float) -> None:
        """Pause at the next whole frame forwards (1) or backwards (-1)."""
        here = self.frame(now)
        self.playing = False
        goal = math.floor(here) + 1 if by > 0 else math.ceil(here) - 1
        self.seek(goal % (self.last + 1) if self.loop else goal, now)

"""Where each frame of a video file is, by the container's packets, without decoding any."""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PacketIndex:
    """Times of a video's frames in the order in which they are shown.

    Attributes:
        times: in ticks of the stream. keyframes: numbers of frames that decode by themselves.
        tick: seconds.
    """

    times: list[int]
    keyframes: list[int]
    tick: float

    def __len__(self) -> int:
        return len(self.times)

    def keyframe(self, number: int) -> int:
        """The nearest keyframe at or before a frame."""
        return self.keyframes[max(0, bisect.bisect_right(self.keyframes, number) - 1)]

    def number(self, time: int | None) -> int | None:
        """Of the frame that is shown at a time; None: there is none."""
        at = -1 if time is None else bisect.bisect_left(self.times, time)
        return at if 0 <= at < len(self.times) and self.times[at] == time else None

    def seconds(self, number: int) -> float:
        """Since the first frame."""
        return (self.times[number] - self.times[0]) * self.tick


def packet_index(container: Any, stream: Any) -> PacketIndex | None:
    """The index of an open video; None where packets have no times, or share them, so that frames
    are found by counting alone."""
    shown = [p for p in container.demux(stream) if p.size and not getattr(p, "is_discard", False)]
    packets = sorted((p.pts, p.is_keyframe) for p in shown if p.pts is not None)
    times = [time for time, _ in packets]
    if not packets or len(set(times)) < len(shown) or not packets[0][1]:
        return None
    keyframes = [i for i, (_, key) in enumerate(packets) if key]
    return PacketIndex(times, keyframes, float(stream.time_base or 0))

"""How much of each object is proven to be seen, how well it is placed, and which click helps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby

SEEN = "seen"  # `EntityMasks.states` of a frame whose mask is verified
DOUBTFUL = "doubtful"  # of one whose mask may be of something else
OUT = "out of the picture"  # of one that it left, or had not come into, as it moved
UNKNOWN = ("lost", DOUBTFUL)  # of a frame in which a click may help
UNSURE = 0.5  # agreement of a verified frame's cues below which a click there helps
EXPLAINED = 0.6  # overlap with one thing that moves, from which a proposal counts as seen


@dataclass(frozen=True)
class ObjectSeen:
    """What is known of one object's masks and track.

    Attributes:
        states: state to the frames of the clip that are in it, "seen" among them; empty: the
            estimator of its masks did not say.
        click: the frame of the video in which a click would help most, and why; None: none would.
        place_m: metres by which its place is off from frame to frame, typically.
        turn_degrees: by which its rotation is off, typically; None: its turn cannot be seen.
        overlap: intersection over union of its outline and its masks, mean; None: not seen.
        proposed: whether nothing was clicked.
    """

    states: dict[str, list[int]] = field(default_factory=dict)
    click: tuple[int, str] | None = None
    place_m: float | None = None
    turn_degrees: float | None = None
    overlap: float | None = None
    proposed: bool = False

    @property
    def share(self) -> float | None:
        """The part of the frames in which it is seen."""
        count = sum(map(len, self.states.values()))
        return len(self.states.get(SEEN, [])) / count if count else None

    @property
    def missed(self) -> float:
        """The part of the frames in which it is not seen, of those that it is not out of; 1 of one
        that is seen nowhere."""
        in_view = sum(len(frames) for state, frames in self.states.items() if state != OUT)
        return 1 - len(self.states.get(SEEN, [])) / max(in_view, 1)

    @property
    def unexplained(self) -> bool:
        """Whether nobody clicked it, and nothing that moves as one has its masks: a limb, clothes
        or a part of the scene rather than a thing."""
        return self.proposed and self.overlap is not None and self.overlap < EXPLAINED

    def doubt(self, name: str) -> str:
        """What to say of one that is unexplained."""
        return (
            f"{name}: nothing was clicked, and nothing that moves as one explains what was taken "
            f"(IoU of its outline {self.overlap:.2f}): it may be a limb, clothes or a part of the "
            "scene, and no mask of it counts as seen; click on the object"
        )

    @property
    def unseen(self) -> str:
        """The other frames, by state."""
        others = [f"{s} in {len(f)}" for s, f in self.states.items() if s != SEEN]
        return ", ".join(others) or "in all frames"

    @property
    def place(self) -> str:
        """Its place and turn, with their errors."""
        place = "unknown" if self.place_m is None else f"± {1000 * self.place_m:.0f} mm"
        turn = self.turn_degrees
        return f"{place}, " + ("its turn cannot be seen" if turn is None else f"turn ± {turn:.0f}°")

    @property
    def advice(self) -> str:
        """The click that would help most, or "" where none would."""
        return "" if self.click is None else f"click it in frame {self.click[0]}: {self.click[1]}"


def by_state(states: Sequence[str]) -> dict[str, list[int]]:
    """The frames that are in each state."""
    found: dict[str, list[int]] = {}
    for i, state in enumerate(states):
        found.setdefault(state, []).append(i)
    return found


def best_click(
    states: Sequence[str], confidence: Sequence[float], numbers: Sequence[int]
) -> tuple[int, str] | None:
    """The middle of the longest run of frames in which the object is lost, or its mask may be a
    part of a person; if there is none, the verified frame of most doubt."""
    runs = [
        (state, [i for i, _ in group])
        for state, group in groupby(enumerate(states), key=lambda pair: pair[1])
        if state in UNKNOWN
    ]
    if runs:
        state, longest = max(runs, key=lambda run: len(run[1]))
        middle = longest[len(longest) // 2]
        count = f"{len(longest)} frames" if len(longest) > 1 else "a frame"
        return numbers[middle], f"the middle of {count} in which it is {state}, if it is in view"
    seen = [(confidence[i], i) for i, state in enumerate(states) if state == SEEN]
    if seen and min(seen)[0] < UNSURE:
        return numbers[min(seen)[1]], "it is seen there with most doubt"
    return None


def named(seen: ObjectSeen) -> Iterator[tuple[str, str, str]]:
    """Rows of what, value and note, without the object's name."""
    if seen.share is not None:
        yield "seen, verified", f"{100 * seen.share:.0f} % of the frames", seen.unseen
    yield "place", seen.place, "from frame to frame; all of it scales with its supposed distance"
    if seen.overlap is not None:
        yield "outline", f"IoU {seen.overlap:.2f}", "with its masks, mean of the frames"
    if seen.advice:
        yield "best click", f"frame {seen.click[0] if seen.click else ''}", seen.advice

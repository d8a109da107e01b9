"""What is said of clicks on nothing, and of tracks that are not done, or not well."""

from __future__ import annotations

from collections.abc import Sequence

from hoigs.core.interfaces.estimator import EntityRequest, FramePrompt
from hoigs.plugins.estimators.object_tracker.pixels.footage import Footage
from hoigs.plugins.estimators.object_tracker.propagation import Track

WEAK = 0.6  # confidence below which a frame is named in a note


def nothing_there(entity: EntityRequest, prompt: FramePrompt, footage: Footage, i: int) -> str:
    """What lies under a prompt from which no mask grows."""
    point = next((p for p in prompt.points if p.inside), None)
    where = f"{point.x:g},{point.y:g}" if point else f"the box {prompt.box}"
    there = "a surface without an outline"
    if point is not None:
        h, w = footage.shape
        x, y = int(point.x * footage.scale), int(point.y * footage.scale)
        if not (0 <= x < w and 0 <= y < h):
            there = "nothing: that is outside the picture"
        elif footage.blank[i, y, x]:
            there = "a black border of the video"
        elif footage.person[i, y, x]:
            there = "the person"
    return (
        f"estimator:object-tracker: no {entity.name} was found at {where} in frame {prompt.frame}: "
        f"there is {there}; click on the middle of the object in a frame that shows it well"
    )


def doubts(tracks: dict[str, Track | None], footage: Footage) -> list[str]:
    """A sentence for each object on the frames that were not done, or not well."""
    notes = []
    for name, track in tracks.items():
        if track is None:
            continue
        seen = [bool((soft > 127).any()) for soft in track.soft]
        lost = [n for n, s in zip(footage.numbers, seen) if not s]
        weak = [n for n, s, c in zip(footage.numbers, seen, track.confidence) if s and c < WEAK]
        if lost:
            notes.append(f"{name}: not seen in {_ranges(lost)}")
        if weak:
            notes.append(
                f"{name}: its mask is doubtful in {_ranges(weak)}; a click there corrects it"
            )
    return notes


def _ranges(numbers: Sequence[int]) -> str:
    """Numbers of frames as "3 frames (10-12)", the first few ranges."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n - runs[-1][1] <= 2:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    texts = [f"{a}" if a == b else f"{a}-{b}" for a, b in runs[:6]]
    more = ", …" if len(runs) > 6 else ""
    return f"{len(numbers)} frame{'s' if len(numbers) > 1 else ''} ({', '.join(texts)}{more})"

"""Long and thin things that are held, such as a club or a broom, followed as lines from a hand.

The shaft of a club is two pixels wide: its colours are those of what is around it as much as its
own, and a mask that grows from a click ends where it is narrow. But it is straight, it begins at a
hand, and along it every pixel differs from those to both sides of it. So all lines from a hand are
tried in each frame, and the one with most of such pixels is the thing, if no other comes near it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import remainder, tau

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage, usual_torso
from hoigs.plugins.estimators.object_tracker.lines import BLURRED, LEAST, STEP, Fan, Line, Look
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.scene import Scene

HANDS = ((15, 17, 19), (16, 18, 20))  # wrist and fingers, among MediaPipe's landmarks
BESIDE = (2.5, 4.0, 6.0, 9.0)  # pixels from the middle of a line to both of its sides
FINGERS = 0.12  # torsos from the middle of a hand, which covers what is there
GRIP = 0.2  # torsos that a line may pass beside the middle of a hand
BEYOND = 1.5  # torsos that a thing may be longer than from the hand to the click
BETTER = 1.05  # times the evidence that a wider look must find
FEWEST, OFTEN = 4, 0.25  # frames, and share of them, that show what nobody clicked
GLANCE = 3  # every third frame is searched first, and no other if none of them shows one
MIDDLE = 0.6  # of a line's length: where it is clicked then
SHORTEST, SLENDER = 0.6, 0.08  # torsos of its length; of that, half of its breadth
SUPPORTED = 0.75  # share of the clicked line's pixels that differ from both sides, before no body
CRISP = 0.3  # and evidence for each, on average
WEAKER = 0.35  # of the clicked line's evidence for each pixel
FORESHORTENED, LONGER = 0.25, 1.3  # of the clicked line's length
CLEAR = 1.6  # times the evidence of any line that is no neighbour
ASIDE = 0.2  # radians between neighbours
FASTEST = 1.2  # radians from frame to frame
BENDS = 15  # degrees that the part of a thing beyond the hand may be off the line
SHORTER = 0.3  # lengths of the clicked part that it has at least


@dataclass(frozen=True)
class Rod:
    """A long and thin thing, as the clicked frame shows it.

    Attributes:
        person, hand: whose, and which of HANDS holds it. line: where it is there, on the side of
            the hand that was clicked. other: on the other side; None where it ends at the hand.
        beside: pixels to its sides with which it is compared. half: of its breadth, pixels.
        differs: from the scene, units of noise. torso: pixels.
    """

    person: int
    hand: int
    frame: int
    line: Line
    beside: float
    torso: float
    other: Line | None = None
    half: float = 0.0
    differs: float = 0.0

    @property
    def lines(self) -> tuple[Line, ...]:
        """On the clicked side of the hand, and perhaps on the other."""
        return (self.line,) if self.other is None else (self.line, self.other)

    @property
    def click(self) -> Float[np.ndarray, "2"]:
        """A point x, y on it, away from the hand."""
        return self.line.point(MIDDLE)


def rod_of(
    footage: Footage,
    scene: Scene,
    people: Sequence[Float[np.ndarray, "F 33 4"]],
    frame: int,
    click: Float[np.ndarray, "2"],
) -> Rod | None:
    """The thing as a line from a hand through what was clicked; None where it is none.

    Args:
        click: x, y in pixels of the footage.
    """
    torso = usual_torso(people)
    if not np.isfinite(torso):
        return None
    best: Rod | None = None
    look = Look.at(footage, scene, frame)
    for person, landmarks in enumerate(people):
        for hand in range(len(HANDS)):
            middle = _hand(landmarks[frame], hand)
            reach = float(np.hypot(*(click - middle))) + BEYOND * torso
            for beside in BESIDE if np.isfinite(reach) else ():
                line = _through(replace(look, beside=beside, reach=reach), middle, click, torso)
                if line and not (best and line.evidence <= BETTER * best.line.evidence):
                    best = Rod(person, hand, frame, line, beside, torso)
    if (
        best is None
        or best.line.length < SHORTEST * torso
        or best.line.support < SUPPORTED
        or best.line.evidence < CRISP * best.line.length
    ):
        return None
    line = best.line
    look = replace(look, beside=best.beside, reach=LONGER * line.length, color=line.color)
    half = _half_breadth(look, line)
    if half > SLENDER * line.length:
        return None
    y, x = look.cells(line.points())
    away = np.nan_to_num(scene.difference(frame)[y, x][~look.body[y, x]])
    other = _across(_hand(people[best.person][frame], best.hand), line, 0.0, torso).best(look)
    long = other.length > SHORTER * line.length
    goes_on = long and other.evidence > WEAKER * line.evidence / line.length * other.length
    return replace(
        best, half=half, differs=float(np.median(away)), other=other if goes_on else None
    )


def _hand(landmarks: Float[np.ndarray, "33 4"], hand: int) -> Float[np.ndarray, "2"]:
    """The middle x, y of a hand."""
    return landmarks[list(HANDS[hand]), :2].mean(0)


def rods_held(
    footage: Footage,
    scene: Scene,
    people: Sequence[Float[np.ndarray, "F 33 4"]],
    frames: Sequence[int],
) -> list[Rod]:
    """A thing that nobody clicked, where one hand holds one in many of some frames: as these show
    it, the clearest first."""
    torso = usual_torso(people)
    if not np.isfinite(torso):
        return []
    found: dict[tuple[int, int], list[Rod]] = {}
    first = frames[::GLANCE]
    for number, i in enumerate([*first, *(i for i in frames if i not in first)]):
        if number == len(first) and not found:
            return []  # what is in a quarter of the frames is in some of these
        look = Look.at(footage, scene, i)
        look = replace(look, beside=BESIDE[-1], reach=(1 + BEYOND) * torso, on_body=False)
        for person, landmarks in enumerate(people):
            for hand in range(len(HANDS)):
                click = _clearest(look, _hand(landmarks[i], hand), torso)
                rod = None if click is None else rod_of(footage, scene, people, i, click)
                if rod is not None and (rod.person, rod.hand) == (person, hand):
                    found.setdefault((person, hand), []).append(rod)
    most = max(found.values(), key=len, default=[])
    if len(most) < max(FEWEST, OFTEN * len(frames)):
        return []
    usual = float(np.median([rod.line.length for rod in most]))
    alike = [rod for rod in most if usual / LONGER < rod.line.length < usual * LONGER]
    return sorted(alike, key=lambda rod: -rod.line.evidence)


def _clearest(
    look: Look, hand: Float[np.ndarray, "2"], torso: float
) -> Float[np.ndarray, "2"] | None:
    """A point of the line from a hand that has clearly most evidence."""
    if not np.isfinite(hand).all():
        return None
    angles = np.deg2rad(np.arange(0, 360, 2.0))
    fan = Fan.of(hand, angles, np.arange(-GRIP * torso, GRIP * torso + 0.1, 2.0))
    each = fan.sums(look)[0].reshape(len(angles), -1).max(1)
    a = int(each.argmax())
    apart = np.cos(angles - angles[a]) < np.cos(2 * ASIDE)
    opposite = np.cos(angles - angles[a]) < -np.cos(2 * ASIDE)  # may be the rest of it
    if not each[a] > CLEAR * max(float(each[apart & ~opposite].max()), 0.0):
        return None
    return fan.only(fan.angles == angles[a]).best(look).point(MIDDLE)


def _across(hand: Float[np.ndarray, "2"], line: Line, bend: float, torso: float) -> Fan:
    """Lines on the other side of a hand that continue a line, `bend` radians off it."""
    angles = line.angle + np.pi + bend + np.deg2rad(np.arange(-BENDS, BENDS + 0.1, 1.0))
    return Fan.of(hand, angles, np.arange(-GRIP * torso, GRIP * torso + 0.1, 1.0))


def clicked_rod(
    footage: Footage, scene: Scene, people: Sequence[Float[np.ndarray, "F 33 4"]], rod: Rod
) -> PromptedMask:
    """Its mask in the clicked frame."""
    masks = [pixels_of(footage, scene, people, rod.frame, rod, line) for line in rod.lines]
    soft = np.any(masks, axis=0).astype(np.float32)
    return PromptedMask(rod.frame, soft, 1.0, False, footage.blank[rod.frame])


def _through(
    look: Look, hand: Float[np.ndarray, "2"], click: Float[np.ndarray, "2"], torso: float
) -> Line | None:
    """The line from a hand through a click that has most evidence."""
    to = click - hand
    far = float(np.hypot(*to))
    angles = np.arctan2(to[1], to[0]) + np.deg2rad(np.arange(-20, 20.1, 0.5))
    fan = Fan.of(hand, angles, np.arange(-1.5 * GRIP * torso, 1.5 * GRIP * torso + 1))
    near = np.abs(fan.across @ to - fan.offs) < max(3.0, 0.05 * far)
    return fan.only(near).best(look, far - 3) if near.any() else None


def _half_breadth(look: Look, line: Line) -> float:
    """Pixels from the middle of a line to where less than half of what differs there differs."""
    aside = np.arange(-look.beside, look.beside + 0.25, 0.5)
    across = np.array((-np.sin(line.angle), np.cos(line.angle)))
    shown = []
    for off in aside:
        y, x = look.cells(line.points() + off * across)
        free = ~look.body[y, x]
        shown.append(look.changed[y, x][free].mean() if free.any() else 0.0)
    profile = np.array(shown) - np.minimum(shown[0], shown[-1])
    return max(0.75, 0.25 * float((profile > 0.5 * profile.max()).sum()) - 0.5)


# The line of each frame, and its pixels.

PEAKS = 5  # lines of a frame that are compared
ABSENT, TURNS = 0.25, 0.5  # costs of a frame without it, and of turning by FASTEST
DOUBT = 1.0  # cost of a line which others come near to


@dataclass(frozen=True)
class _Found:
    """The thing in one frame, perhaps: its lines, that on the clicked side of the hand first; how
    sure it is, 0 to 1, and whether it is clearly better than any other."""

    lines: tuple[Line, ...]
    sure: float
    clear: bool

    @property
    def angle(self) -> float:
        return self.lines[0].angle


def rod_followed(
    footage: Footage,
    scene: Scene,
    people: Sequence[Float[np.ndarray, "F 33 4"]],
    rods: Sequence[Rod],
    progress: Callable[[float], None] = lambda share: None,
) -> Track:
    """Masks of the frames in which one line from the hand is clearly it; the others' are empty."""
    given = {rod.frame: rod for rod in rods}
    found: list[list[_Found]] = []
    for i in range(len(footage)):
        rod = given[min(given, key=lambda frame: abs(frame - i))]
        if i in given:
            found.append([_Found(rod.lines, 1.0, True)])
        else:
            found.append(_found_in(footage, scene, people, rod, i))
        progress((i + 1) / len(footage))
    soft = np.zeros(footage.lab.shape[:3], np.uint8)
    confidence = np.zeros(len(footage))
    for i, chosen in enumerate(_path(found, set(given))):
        if chosen is not None:
            rod = given[min(given, key=lambda frame: abs(frame - i))]
            masks = [pixels_of(footage, scene, people, i, rod, line) for line in chosen.lines]
            soft[i] = 255 * np.any(masks, axis=0)
            confidence[i] = chosen.sure if soft[i].any() else 0.0
    return Track(soft, confidence)


def _found_in(
    footage: Footage,
    scene: Scene,
    people: Sequence[Float[np.ndarray, "F 33 4"]],
    rod: Rod,
    i: int,
) -> list[_Found]:
    """Lines of a frame that may be the thing."""
    hand, known = _hand(people[rod.person][i], rod.hand), rod.line
    if not np.isfinite(hand).all():
        return []
    look = Look.at(footage, scene, i)
    look = replace(look, beside=rod.beside, reach=LONGER * known.length, color=known.color)
    coarse, grip = np.deg2rad(np.arange(0, 360, 1.0)), GRIP * rod.torso
    fan = Fan.of(hand, coarse, np.arange(-grip, grip + 0.1, 2.0))
    total = fan.sums(look)[0].reshape(len(coarse), -1)
    offs, each = fan.offs.reshape(total.shape), total.max(1)
    peaks: list[Line] = []
    while len(peaks) < PEAKS and each.max() > 0:
        a = int(each.argmax())
        fine = Fan.of(
            hand, coarse[a] + np.deg2rad(np.arange(-1, 1.1, 0.25)),
            offs[a, total[a].argmax()] + np.arange(-1.5, 1.6, 0.5),
        )  # fmt: skip
        peaks.append(fine.best(look))
        each[np.cos(coarse - coarse[a]) > np.cos(ASIDE)] = 0.0
    usual, found = known.evidence / known.length, list[_Found]()
    for line in peaks:
        strength = line.evidence / max(line.length, 1.0) / usual
        if strength < WEAKER or line.length < FORESHORTENED * known.length:
            continue
        lines: tuple[Line, ...] = (line,)
        if rod.other is not None:
            bend = remainder(rod.other.angle - known.angle - np.pi, tau)
            other = _across(hand, line, bend, rod.torso).best(look)
            enough = other.length > FORESHORTENED * rod.other.length
            if enough and other.evidence > WEAKER * usual * other.length:
                lines = (line, other)
        rivals = [
            rival.evidence
            for rival in peaks
            if all(one.away(rival) > max(rod.beside, ASIDE * rival.length / 2) for one in lines)
        ]
        ahead = line.evidence / max(*rivals, 1e-6, 0.0)
        sure = min(1.0, 0.4 + 0.6 * strength) * min(1.0, ahead / (2 * CLEAR) + 0.25)
        found.append(_Found(lines, sure, ahead > CLEAR))
    return found


# What was seen last, how many frames ago, the cost, and the choices up to here.
_State = tuple[_Found | None, int, float, tuple[_Found | None, ...]]


def _path(found: Sequence[Sequence[_Found]], given: set[int]) -> list[_Found | None]:
    """What the thing is in each frame, by the path of least cost; None where it is not seen."""
    states: list[_State] = [(None, 0, 0.0, ())]
    for i, here in enumerate(found):
        after: list[_State] = []
        for one in here:
            ways = []
            for last, gap, cost, way in states:
                turned = 0.0 if last is None else remainder(one.angle - last.angle, tau)
                turned /= FASTEST * (gap + 1)
                ways.append((cost + TURNS * turned**2, way))
            cost, way = min(ways, key=lambda each: each[0])
            after.append((one, 0, cost - one.sure + (not one.clear) * DOUBT, (*way, one)))
        if i not in given:
            gone: list[_State] = [
                (last, gap + 1, cost + ABSENT, (*way, None)) for last, gap, cost, way in states
            ]
            after += sorted(gone, key=lambda state: state[2])[:PEAKS]
        states = after
    return list(min(states, key=lambda state: state[2])[3])


TIP = 0.12  # of the length, around the end of a line: a club's head
CHANGED = 3.0  # units of noise by which a pixel of the thing differs from the scene
SHARE = 0.4  # and share of what the clicked line differs by: a smear of it differs less
GAP = 5  # pixels along a line that are smoothed: shorter gaps in it are closed


def pixels_of(
    footage: Footage,
    scene: Scene,
    people: Sequence[Float[np.ndarray, "F 33 4"]],
    i: int,
    rod: Rod,
    line: Line,
) -> Bool[np.ndarray, "h w"]:
    """The pixels of a line where it is seen and, beside it, of what differs from the scene as much:
    what is broader there, and what is blurred."""
    look = Look.at(footage, scene, i)
    look = replace(look, beside=rod.beside, reach=line.length + STEP, color=rod.line.color)
    found, _ = look.evidence(line.start[None], np.array([line.angle]))
    seen = ndimage.median_filter(found[0], GAP, mode="nearest") > LEAST
    y, x = np.mgrid[: footage.shape[0], : footage.shape[1]] + 0.5
    along, aside = line.off(x, y)
    aside = np.abs(aside)
    row = (along / STEP).astype(int).clip(0, len(seen) - 1)
    on = (along >= 0) & (along <= line.length) & seen[row]
    away = np.nan_to_num(scene.difference(i), nan=0.0)
    core = on & (aside <= rod.half)
    changed = (away > max(CHANGED, SHARE * rod.differs)) & ~look.body
    core &= changed | look.body
    near = on & (aside <= rod.beside + BLURRED * along.clip(0)) & changed
    end = line.point(1.0)
    tip = (np.hypot(x - end[0], y - end[1]) < TIP * rod.line.length) & changed
    labels, _ = ndimage.label(core | near | tip, np.ones((3, 3)))
    kept = np.isin(labels, np.unique(labels[core]))
    hand = _hand(people[rod.person][i], rod.hand)
    fingers = np.hypot(x - hand[0], y - hand[1]) < FINGERS * rod.torso
    return kept & ~(fingers & look.body)

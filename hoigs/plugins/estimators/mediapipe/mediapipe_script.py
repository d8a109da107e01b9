"""Run by the Python of an environment with mediapipe; it imports nothing of hoigs.

Reads RGB frames from standard input and writes one .npz file: of each person image_xyzv and
world_xyzv [P, N, 33, 4], NaN where they are not found, and `fate` [P, N], what became of the frame
(mediapipe_doubts.py); and, if masks are wanted, `person`, the bits of boolean masks
[P, N, H, ceil(W / 8)], their `size`, `several` [N], whether other people are seen, and `alone` [N],
whether the mask is of the segmentation of selfies alone. P is 1, or the number of people who were
clicked on.
"""

from __future__ import annotations

import json
import sys
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

PADDING = 0.5  # of the height, above: a detector of faces finds people whose head is cut off
MARGIN = 1.25  # of the person's box, the second look at the person's mask
OTHER, ELSEWHERE = 0.25, 0.2  # of the largest part's area; of a part, that is the person's own
AROUND = 0.01  # of the longer side, to both sides of the outline of the pose's own mask
EARLIER = 300  # frames at most in which somebody who is found late is looked for
ROWS = ("image_xyzv", "world_xyzv")
SOFT = 1 / 640  # of the longer side: standard deviation by which the person's mask is smoothed


def main() -> None:
    sys.path.append(str(Path(__file__).parent))  # last: -I leaves it out, nothing there may shadow
    try:
        import cv2
        import mediapipe
    except ImportError as error:
        sys.exit(f"this Python has no mediapipe: {error}")
    settings = json.loads(sys.argv[1])
    width, height, count = settings["width"], settings["height"], settings["count"]
    factor = min(1.0, settings["longest"] / max(width, height))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    looks = settings.get("look")
    finder: Any = Lookout(settings) if looks else Finder(
        cv2, mediapipe.solutions, settings, size[0] / width
    )  # fmt: skip
    for i in range(count):
        pixels = sys.stdin.buffer.read(height * width * 3)
        if len(pixels) != height * width * 3:
            sys.exit(f"frame {i} of {count} did not come")
        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        if factor < 1:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        try:
            finder.add(i, np.ascontiguousarray(image))
        except LookupError as error:
            sys.exit(str(error))
    with Path(settings["out"]).open("wb") as out:
        np.savez_compressed(out, size=np.array(size), **finder.arrays(width / size[0]))


class Lookout:
    """Who is in each frame: `people` [N, 5], the frame's place and what `Look.people` gives."""

    def __init__(self, settings) -> None:
        from mediapipe_look import Look

        self.look = Look(settings["pose"]["model_complexity"])
        self.rows: list[tuple[float, ...]] = []

    def add(self, place, image) -> None:
        found = self.look.people(image)
        if not found or place % 2 == 0:
            found = self.look.with_small(image, found)
        if place % 2 == 0:
            found += self.look.faceless(image, found)
        self.rows += [(place, *one) for one in found]

    def arrays(self, scale):
        """What is written; `scale`: pixels of the video a pixel of the images here."""
        rows = np.array(self.rows, np.float32).reshape(-1, 5)
        rows[:, 2:] *= scale
        return {"people": rows}


class Finder:
    """Landmarks and masks, frame by frame."""

    def __init__(self, cv2, solutions, settings, factor) -> None:
        self.cv2, self.masks = cv2, settings["masks"]
        pose = {**settings["pose"], "enable_segmentation": self.masks, "smooth_segmentation": False}
        self.whole, self.padded = solutions.pose.Pose(**pose), solutions.pose.Pose(**pose)
        self.selfie: Any = None
        self.close: Any = None
        if self.masks:
            self.selfie = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
            self.close = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
        self.check: Any = None  # made where they are needed
        self.guided: Any = None
        self.last: Any = None  # where the person was last, and how tall, pixels
        self.complexity = settings["pose"]["model_complexity"]
        self.unseen: Any = deque(maxlen=EARLIER)  # frames since the last that showed the person
        self.following = False  # a person whom `guided` found and the detector does not
        self.people: Any = None
        names, frames = [""], range(settings["count"])
        if settings["people"] is not None:
            from mediapipe_check import Check
            from mediapipe_guided import landmark_graph
            from mediapipe_people import People

            given = settings["people"]
            order, places = given["order"], (given["back"], given["shown"])
            prompts = {
                name: {
                    number: (
                        [(factor * x, factor * y, on) for x, y, on in points],
                        None if box is None else [factor * c for c in box],
                    )
                    for number, points, box in clicks
                }
                for name, clicks in given["prompts"].items()
            }
            graph = landmark_graph(self.complexity)
            self.check = Check(*graph)
            self.people = People(*graph, prompts, order, *places)
            names, frames = list(prompts), range(min(order), max(order) + 1)
        self.first, rows = frames[0], (len(names), len(frames), 33, 4)
        self.names, self.rows = names, {n: np.full(rows, np.nan, np.float32) for n in ROWS}
        self.person: list[list[np.ndarray | None]] = [[None] * len(frames) for _ in names]
        self.fate = np.zeros((len(names), len(frames)), np.uint8)
        self.several = np.zeros(len(frames), bool)  # others are seen beside the person followed
        self.alone = np.zeros(len(frames), bool)  # masks of the segmentation of selfies alone

    def add(self, place, image) -> None:
        """The frame that comes at this place."""
        wide = None if self.selfie is None else self.selfie.process(image).segmentation_mask
        if self.people is not None:
            self.add_people(place, image, wide)
            return
        found = self.landmarks(image, wide)
        self.keep(place, image, wide, found)
        if np.isnan(found[0]).all():
            self.unseen.append((place, self.cv2.imencode(".jpg", image[..., ::-1])[1]))
        elif self.unseen:
            if self.following:
                self.look_back()
            self.unseen.clear()

    def look_back(self):
        """Whoever was found without the detector, late or again, in the frames before."""
        last = self.last
        shown: list[Any] = []

        def frames():
            for place, encoded in reversed(self.unseen):
                image = np.ascontiguousarray(self.cv2.imdecode(encoded, 1)[..., ::-1])
                wide = self.selfie and self.selfie.process(image).segmentation_mask
                shown[:] = place, image, wide
                yield image, wide

        for found in self.guided.earlier(frames()):
            self.alone[shown[0]] = False
            self.keep(shown[0], shown[1], shown[2], found)
        self.last = last

    def keep(self, place, image, wide, found):
        """Landmarks, fate and mask of a frame."""
        image_xyzv, world_xyzv, own, self.fate[0, place] = found
        self.rows["image_xyzv"][0, place] = image_xyzv
        self.rows["world_xyzv"][0, place] = world_xyzv
        seen = image_xyzv[image_xyzv[:, 3] > 0.5, :2]
        if len(seen):
            self.last = (*seen.min(0), *seen.max(0))
        if wide is not None:
            self.person[0][place] = self.bits(image, self.of_anybody(place, image, wide, own))

    def of_anybody(self, place, image, wide, own):
        """The mask of the person whom the detector took; of people, where it took nobody."""
        if own is None:
            self.alone[place] = True
            near = self.near(image, wide > 0.5)
            found = wide if near is None else (wide + near) / 2
            return found if self.last is None else self.within_reach(found)
        if self.following:
            return own  # segmentation of selfies takes tables in where there is no head
        self.several[place] = self.another(wide, own)
        return self.of_one(image, wide, own)

    def within_reach(self, found):
        """A mask without the parts that are farther than a body's height from where the person was
        last: something else that stands there."""
        x0, y0, x1, y1 = self.last
        tall = max(x1 - x0, y1 - y0)
        _, parts, _, _ = self.cv2.connectedComponentsWithStats(np.uint8(found > 0.5))
        x0, y0 = (max(0, round(v - tall)) for v in (x0, y0))
        here = parts[y0 : max(0, round(y1 + tall)), x0 : max(0, round(x1 + tall))]
        return np.where(np.isin(parts, np.setdiff1d(here, 0)), found, 0.0)

    def add_people(self, place, image, wide) -> None:
        """Those who were clicked on; where masks overlap, the model of landmarks decides."""
        found = self.people.process(place, image)
        from mediapipe_doubts import FOUND, GONE

        i = self.people.order[place] - self.first
        seen = {name: f for name, f in found.items() if f is not None}
        for name in found:
            self.fate[self.names.index(name), i] = FOUND if name in seen else GONE
        for name, (image_xyzv, world_xyzv, _) in seen.items():
            k = self.names.index(name)
            _, *both = self.check.seen(image, image_xyzv, world_xyzv)
            self.rows["image_xyzv"][k, i], self.rows["world_xyzv"][k, i] = both
        if wide is None:
            return
        owns = {name: own for name, (_, _, own) in seen.items()}
        for name in found:
            mask = np.zeros_like(wide)
            if name in owns:
                mask = self.of_one(image, wide, owns[name])
                others = [own for n, own in owns.items() if n != name]
                mask = np.where(np.all([owns[name] >= o for o in others], axis=0), mask, 0.0)
            self.person[self.names.index(name)][i] = self.bits(image, mask)

    def bits(self, image, person):
        """A mask as bits."""
        # cells of the models are several pixels wide: without this, edges are stairs
        person = self.cv2.GaussianBlur(person, (0, 0), max(1.0, SOFT * max(image.shape)))
        return np.packbits(person > 0.5, axis=1)

    def another(self, wide, own) -> bool:
        """Whether the mask of people has a large part that is not of the person followed."""
        count, parts, stats, _ = self.cv2.connectedComponentsWithStats(np.uint8(wide > 0.5))
        areas = stats[:, self.cv2.CC_STAT_AREA]
        large = [i for i in range(1, count) if areas[i] >= OTHER * areas[1:].max()]
        return any((own[parts == i] > 0.5).mean() < ELSEWHERE for i in large)

    def of_one(self, image, wide, own):
        """The mask of one person: the pose's own, whose outline is coarse, and which knows them
        apart from others and from what they hold. Along its outline, and there alone, the
        segmentations of all that is a person have a say; they take away only beside what they
        have of the person, so not from a thin arm, nor from a chest that they lack."""
        near = self.near(image, own > 0.5)
        mean = (own + wide + (wide if near is None else near)) / 3
        side = 2 * max(1, round(AROUND * max(own.shape))) + 1
        kernel = self.cv2.getStructuringElement(self.cv2.MORPH_ELLIPSE, (side, side))
        sure = np.uint8(own > 0.5)
        core = self.cv2.erode(sure, kernel)
        band = (self.cv2.dilate(sure, kernel) > 0) & (core == 0)
        beside = self.cv2.dilate(core * np.uint8(mean > 0.5), kernel) > 0
        return np.where(band, np.where(beside, mean, np.maximum(own, mean)), own)

    def landmarks(self, image, wide):
        """In the image and in space, the mask of their person, and what became of the frame; looked
        for a second time with a border above the image where they are not found, as with a head
        out of view, and then without the detector (mediapipe_guided.py)."""
        from mediapipe_doubts import BORDER, FOUND, NOBODY, UNLIKE, doubt

        if self.check is None:
            from mediapipe_check import Check
            from mediapipe_guided import GuidedPose, landmark_graph

            graph = landmark_graph(self.complexity)
            self.check, self.guided = Check(*graph), GuidedPose(*graph, Check(*graph))
        if self.following and (found := self.guided.process(image, wide)) is not None:
            return found
        self.following, fate = False, NOBODY
        height, width = image.shape[:2]
        border = round(PADDING * height)
        for pose, above in ((self.whole, 0), (self.padded, border)):
            padded = self.cv2.copyMakeBorder(
                image, above, 0, 0, 0, self.cv2.BORDER_REPLICATE
            )  # fmt: skip
            found = pose.process(padded)
            if found.pose_landmarks is None:
                continue
            # z is in the scale of x
            points = points_of(found.pose_landmarks) * [width, height + above, width, 1.0]
            points[:, 1] -= above
            space = points_of(found.pose_world_landmarks)
            own = found.segmentation_mask[above:] if self.masks else None
            doubted, how = doubt(points, own, wide), BORDER if above else FOUND
            if not doubted:
                off, points, space = self.check.seen(image, points, space)
                doubted = 0 if self.check.believes(off) else UNLIKE
            if doubted:
                pose.reset()
                fate = doubted if fate == NOBODY else fate
                continue
            return points, space, own, how
        self.check.lose()
        if (found := self.guided.process(image, wide)) is not None:
            self.following = True
            return found
        nothing = np.full((33, 4), np.nan)
        return nothing, nothing, None, fate

    def near(self, image, inside):
        """The mask of a picture of the person alone, which shows more detail."""
        box = box_of(inside, MARGIN)
        if box is None:
            return None
        x0, y0, x1, y1 = box
        part = np.zeros(inside.shape, np.float32)
        cut = np.ascontiguousarray(image[y0:y1, x0:x1])
        part[y0:y1, x0:x1] = self.close.process(cut).segmentation_mask
        return part

    def arrays(self, scale):
        """What is written; `scale`: pixels of the video a pixel of the images here."""
        rows: dict[str, np.ndarray] = dict(self.rows)
        rows["image_xyzv"][..., :3] *= scale
        rows["fate"] = self.fate
        if self.masks:
            rows["person"] = np.array(self.person)
            rows["several"], rows["alone"] = self.several, self.alone
        return rows


def box_of(mask, margin):
    """x0, y0, x1, y1 of a square about a mask, within the image; None if it is empty."""
    if not mask.any():
        return None
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    half = margin * max(np.ptp(ys), np.ptp(xs), 8) / 2
    x, y = (xs[0] + xs[-1]) / 2, (ys[0] + ys[-1]) / 2
    height, width = mask.shape
    return (
        int(max(0, x - half)), int(max(0, y - half)),
        int(min(width, x + half + 1)), int(min(height, y + half + 1)),
    )  # fmt: skip


def points_of(found):
    return np.array([[p.x, p.y, p.z, p.visibility] for p in found.landmark])


if __name__ == "__main__":
    main()

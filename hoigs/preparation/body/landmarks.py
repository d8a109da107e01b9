"""MediaPipe's 33 landmarks and the points of a body that they should fall on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.values.camera import pinhole_rays
from hoigs.core.values.lens import Undistortion

# landmark -> SMPL-X body joint
JOINTS = {11: 16, 12: 17, 13: 18, 14: 19, 15: 20, 16: 21, 23: 1, 24: 2, 25: 4, 26: 5, 27: 7, 28: 8}
# landmark -> joint within the hands' 30: knuckles of index and little finger
KNUCKLES = {19: 0, 17: 6, 20: 15, 18: 21}
TORSO = (11, 12, 23, 24)
FEET = (29, 30, 31, 32)
USED = tuple(sorted((*JOINTS, *KNUCKLES, 0, 7, 8, *FEET)))  # landmarks that `points_of` places
SOLID = (11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)  # in space: torso and limbs start on them
ALONE = 3  # frames: shorter runs of landmarks between gaps of as many are not believed,
FEW = 0.2  # unless they are more than this share of those with landmarks
SHOULDERS, HIPS = [11, 12], [23, 24]
NEAR_GAP, AROUND, LEAST = 6, 15, 8  # frames: from a gap, to compare with, and how many of them
JUMP = 0.34  # of the shoulders' distance from the way of those around: not this person
ENOUGH = 8  # landmarks of USED in the image, with which a frame counts
IN_SPACE = 0.1  # metres by which MediaPipe's are off in space (benchmarks/landmark_errors.py)


@dataclass(frozen=True)
class FrameFates:
    """Frames whose landmarks were lost or repaired, by the reason, in words that end a sentence."""

    lost: dict[str, list[int]] = field(default_factory=dict)
    repaired: dict[str, list[int]] = field(default_factory=dict)

    @staticmethod
    def at(
        lost: Mapping[str, Iterable[int]],
        repaired: Mapping[str, Iterable[int]],
        numbers: Sequence[int],
    ) -> FrameFates:
        """Of chosen frames alone, by their position in `numbers`, those of the frames as given."""
        place = {number: i for i, number in enumerate(numbers)}

        def chosen(reasons: Mapping[str, Iterable[int]]) -> dict[str, list[int]]:
            rows = {
                text: [place[i] for i in found if i in place] for text, found in reasons.items()
            }
            return {text: sorted(found) for text, found in rows.items() if found}

        return FrameFates(chosen(lost), chosen(repaired))

    def complete(self, given: Landmarks, dropped: Mapping[str, Bool[Tensor, " F"]]) -> FrameFates:
        """With a reason for every frame that the fit goes without.

        Args:
            given: as the estimator gave them; frames that it has are not among its lost ones.
            dropped: frames of `given` that were not believed, by the reason.
        """
        found = given.found
        lost = {text: [i for i in rows if not found[i]] for text, rows in self.lost.items()}
        unsaid = ~found
        unsaid[[i for rows in lost.values() for i in rows]] = False
        some = given.known.any(1)
        every = {
            f"fewer than {ENOUGH} of the body's landmarks were found": unsaid & some,
            "the source has no landmarks": unsaid & ~some,
            **dropped,
        }
        lost |= {text: rows.nonzero()[:, 0].tolist() for text, rows in every.items()}
        gone = {i for rows in lost.values() for i in rows}
        kept = {text: [i for i in rows if i not in gone] for text, rows in self.repaired.items()}
        return FrameFates(
            {text: rows for text, rows in lost.items() if rows},
            {text: rows for text, rows in kept.items() if rows},
        )

    def lost_frames(self) -> list[int]:
        return sorted(i for rows in self.lost.values() for i in rows)

    def repaired_frames(self) -> list[int]:
        return sorted({i for rows in self.repaired.values() for i in rows})


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of one person over a clip; NaN where they were not found.

    Attributes:
        image: x, y in pixels of the frames, and visibility in [0, 1].
        world: metres about the hips' middle, along the camera's axes (x right, y down, z away);
            NaN where the estimator sees the image only.
        source: for the report.
        fates: of the frames, by their position.
        to_hips: the axes in space are of a camera that looks at the hips' middle (`in_cameras`).
        spread: by how much a component of `world` is off, standard deviation, metres.
    """

    image: Float[Tensor, "F 33 3"]
    world: Float[Tensor, "F 33 3"]
    source: str = "MediaPipe"
    fates: FrameFates = field(default_factory=FrameFates)
    to_hips: bool = False
    spread: float = IN_SPACE

    @staticmethod
    def from_mediapipe(
        image_xyzv: Float[np.ndarray, "F 33 4"], world_xyzv: Float[np.ndarray, "F 33 4"]
    ) -> Landmarks:
        """From the arrays of `pose_mediapipe.npz`."""
        image = torch.as_tensor(image_xyzv, dtype=torch.float32)[..., [0, 1, 3]]
        world = torch.as_tensor(world_xyzv, dtype=torch.float32)[..., :3]
        return Landmarks(image, world, to_hips=True)

    def in_cameras(self, K: Float[Tensor, "F 3 3"]) -> Landmarks:
        """The same along the axes of cameras of these intrinsics.

        A network that sees a square about the person, and not the lens, gives what a camera would
        see that looks at its middle. MediaPipe's squares lie about the hips.
        """
        if not self.to_hips:
            return self
        world = self.world @ towards(K, self.image[:, HIPS, :2].mean(1)).mT.to(self.world)
        return replace(self, world=world, to_hips=False)

    def rows(self, frames: slice | Int[Tensor, " T"]) -> Landmarks:
        """Of some frames alone."""
        return replace(self, image=self.image[frames], world=self.world[frames])

    def undistorted(self, undistort: Undistortion, positions: Sequence[int]) -> Landmarks:
        """On the cameras' undistorted images; `positions` are those of frames with a camera."""
        rows = list(positions)
        image = self.image[rows].numpy().copy()
        image[..., :2] = undistort.pixels(image[..., :2])
        return replace(
            self,
            image=torch.from_numpy(image).float(),
            world=self.world[rows].float(),
            fates=FrameFates.at(self.fates.lost, self.fates.repaired, rows),
        )

    @property
    def known(self) -> Bool[Tensor, "F 33"]:
        """Landmarks that were found in the image."""
        return torch.isfinite(self.image).all(-1)

    @property
    def found(self) -> Bool[Tensor, " F"]:
        """Frames in which enough landmarks of the body were found in the image."""
        return self.known[:, list(USED)].sum(1) >= ENOUGH

    def strays(self) -> Bool[Tensor, " F"]:
        """Frames of `found` that stand alone, or by two, between longer gaps: what a detector takes
        for a person for a moment only is more often a shadow or a thing."""
        found = self.found
        edges = torch.diff(found.int(), prepend=torch.zeros(1), append=torch.zeros(1))
        starts, ends = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0]
        before = starts - torch.cat((starts.new_tensor([0]), ends[:-1]))
        after = torch.cat((starts[1:], starts.new_tensor([len(found)]))) - ends
        stray = torch.zeros_like(found)
        for row in ((ends - starts < ALONE) & (before >= ALONE) & (after >= ALONE)).nonzero():
            stray[starts[row] : ends[row]] = True
        return stray if stray.sum() < FEW * found.sum() else torch.zeros_like(found)

    def jumps(self) -> Bool[Tensor, " F"]:
        """Frames of `found` near gaps whose shoulders are far from the way on which those of most
        frames around lie: as a detector loses a person, or finds them again, it puts them anywhere.
        The way is a line through each coordinate by the median of slopes (Theil 1950, Sen 1968).
        """
        from scipy import stats  # on use: it takes a while to import

        found, places = self.found.numpy(), self.image[:, SHOULDERS, :2].double().numpy()
        known = found & np.isfinite(places).all((1, 2))
        jump = np.zeros_like(found)
        if known.all() or known.sum() < 2 * LEAST:
            return torch.from_numpy(jump)
        broad = float(np.median(np.linalg.norm(places[known, 0] - places[known, 1], axis=-1)))
        near = ndimage.binary_dilation(~known, iterations=NEAR_GAP) & known
        middle, frames = places.mean(1), np.arange(len(found))
        for i in np.flatnonzero(near).tolist():
            around = known & (np.abs(frames - i) <= AROUND) & (frames != i)
            if around.sum() < LEAST:
                continue
            rows = np.flatnonzero(around)
            slopes = [stats.theilslopes(middle[rows, axis], rows) for axis in (0, 1)]
            way = np.array([s.intercept + s.slope * i for s in slopes])
            jump[i] = np.linalg.norm(middle[i] - way) > JUMP * broad
        return torch.from_numpy(jump)

    def without(self, frames: Bool[Tensor, " F"]) -> Landmarks:
        """The same with these frames not found."""
        image, world = self.image.clone(), self.world.clone()
        image[frames], world[frames] = torch.nan, torch.nan
        return replace(self, image=image, world=world)

    @property
    def solid(self) -> Bool[Tensor, " F"]:
        """Frames of `found` whose torso and limbs are known in space, too."""
        return self.found & torch.isfinite(self.world[:, list(SOLID)]).all(-1).all(-1)


def towards(K: Float[Tensor, "F 3 3"], pixels: Float[Tensor, "F 2"]) -> Float[Tensor, "F 3 3"]:
    """Rotations to a camera's axes from those of one that is turned to look at a pixel, about its
    own y axis and then its x axis; none where the pixel is NaN."""
    known = torch.isfinite(pixels).all(-1, keepdim=True)
    x, y = pinhole_rays(K, torch.where(known, pixels.to(K), K[:, :2, 2])).unbind(-1)
    one, none = torch.ones_like(x), torch.zeros_like(x)
    ahead = torch.nn.functional.normalize(torch.stack((x, y, one), -1), dim=-1)
    right = torch.nn.functional.normalize(torch.stack((one, none, -x), -1), dim=-1)
    return torch.stack((right, torch.linalg.cross(ahead, right), ahead), -1)


@dataclass(frozen=True)
class LandmarkPoints:
    """Which joints and vertices of a body stand for which landmarks.

    Attributes:
        landmarks: numbers of the landmarks that have a counterpart, in the order of `locate`.
        joints: joint of each of the first landmarks. vertices: vertex of each of the others.
        pairs: number of each landmark's left-right pair. mirror: factors of x, y, z that take the
            pair's offset to this side.
    """

    landmarks: tuple[int, ...]
    joints: Int[Tensor, " A"]
    vertices: Int[Tensor, " B"]
    pairs: Int[Tensor, " L"]
    mirror: Float[Tensor, "L 3"]

    def index(self, landmark: int) -> int:
        return self.landmarks.index(landmark)


def points_of(body: BodyModel) -> LandmarkPoints:
    """Joints where a landmark is a joint; extreme vertices for nose, ears, heels and toes."""
    template, joints = body.shaped(torch.zeros(body.num_betas))
    first_hand = len(body.parents) - 30
    by_joint = {**JOINTS, **{mark: first_hand + k for mark, k in KNUCKLES.items()}}
    head = (body.vertex_parts == 3).nonzero().squeeze(1)
    head = head[template[head, 1] > joints[15, 1]]  # above the head joint: no collar, no neck
    nose = head[template[head, 2].argmax()]
    level = head[(template[head, 1] - template[nose, 1]).abs() < 0.03]
    by_vertex = {
        0: nose,
        7: level[template[level, 0].argmax()],
        8: level[template[level, 0].argmin()],
    }
    for part, heel, toe in ((14, 29, 31), (15, 30, 32)):
        foot = (body.vertex_parts == part).nonzero().squeeze(1)
        floor = foot[template[foot, 1] < template[foot, 1].min() + 0.04]
        by_vertex[heel] = floor[template[floor, 2].argmin()]
        by_vertex[toe] = floor[template[floor, 2].argmax()]
    landmarks = (*by_joint, *by_vertex)
    pairs, mirror = _left_right(landmarks)
    return LandmarkPoints(
        landmarks,
        torch.tensor(list(by_joint.values())),
        torch.stack(list(by_vertex.values())),
        pairs,
        mirror,
    )


def _left_right(landmarks: tuple[int, ...]) -> tuple[Int[Tensor, " L"], Float[Tensor, "L 3"]]:
    """Pair of each landmark, and the mirror's signs: odd numbers are left, the next is right.

    The nose is its own pair and may not move aside.
    """
    left = [mark if mark % 2 or mark == 0 else mark - 1 for mark in landmarks]
    numbers = sorted(set(left))
    signs = [(0.0 if m == 0 else 1.0 if m % 2 else -1.0, 1.0, 1.0) for m in landmarks]
    return torch.tensor([numbers.index(n) for n in left]), torch.tensor(signs)

"""Cameras of a video whose camera turns on its spot: rotations, and the focal length if they
determine it.

Every pair of frames that show the same background gives a rotation (`turning`); all rotations and
the focal length are then solved together, as in panoramas (Brown and Lowe 2007), by Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation, Slerp

from hoigs.core.reporting import ranges
from hoigs.core.values.lens import Lens
from hoigs.preparation.cameras.camera_track import CameraTrack, pinhole, static_cameras
from hoigs.preparation.cameras.focal import StaticFocal
from hoigs.preparation.estimates.reader import GivenMasks
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.pictures import shrink, shrink_mask
from hoigs.preparation.video.source import SourceError

# COLMAP without lines of its log in the terminal.


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs nothing in this block: an attempt that fails is followed by others, and if all do
    there is an error of ours."""
    from hoigs.core.system.colmap import pycolmap

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


FRAMES = 6  # compared with another one; SIFT takes about half a second each
SIDE = 640  # the longer one of the images that are compared: a phone held upright shows no more
PIXELS = f"at {SIDE} along the longer side"
FEATURES, ENOUGH = 1500, 25  # of an image; matches that make a pair count
STILL = 1.0  # pixels at SIDE: codecs and rolling light move features by a few tenths
INNER = 4  # compared frames between the first and the last, from which on those two may differ
FEW = 8  # matches that may show a moved camera
COHERENT = 0.3  # of a camera's shift: half of the matches that show it are so near to it
MARGIN = 0.01  # of the width: masks are grown by it
Features = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 128"]]


@dataclass(frozen=True)
class BackgroundMotion:
    """Displacement of features outside the masks since one frame: the first, or one in between
    if those between the first and the last agree and these two do not.

    Attributes:
        displacement: pixels at SIDE, the median over features, of each compared frame;
            NaN where too few features were found again.
        matches: features found again, of each compared frame.
        features: in that one frame.
        still: places of the first and the last frame between which the camera stands still; None
            if it does so in all frames or does not stand still.
        turns: degrees that the camera turns by at most between two compared frames. parallax:
            pixels by which the best turns miss four of five features at most, in the worst pair of
            frames: what only a camera that changes its place explains. NaN: not known.
    """

    displacement: Float[np.ndarray, " C"]
    matches: list[int]
    features: int
    still: tuple[int, int] | None = None
    turns: float = np.nan
    parallax: float = np.nan

    @property
    def known(self) -> bool:
        """Whether enough features lie in the background to decide."""
        return self.features >= ENOUGH

    @property
    def static(self) -> bool:
        """Whether the camera stands still: what is found again has not moved, and most is found."""
        seen = np.isfinite(self.displacement)
        if not self.known or seen.mean() < 0.5:
            return not self.known
        return bool(np.quantile(self.displacement[seen], 0.75) < STILL)

    @property
    def turned(self) -> float | None:
        """Degrees that a camera turns by which hardly changes its place; None if it does."""
        return self.turns if self.parallax < FAINT else None

    @property
    def largest(self) -> float:
        """Largest median displacement, pixels at SIDE; 0 if nothing was found again."""
        seen = np.isfinite(self.displacement)
        return float(self.displacement[seen].max()) if seen.any() else 0.0


def background_motion(video: Frames, masks: GivenMasks) -> BackgroundMotion:
    """Compares frames spread over the video with the first one, or with one in between."""
    chosen = sorted(set(np.linspace(0, len(video) - 1, FRAMES + 1).round().astype(int).tolist()))
    found = list(background_features(video, masks, chosen))
    motion, reference = _since(found, 0), found[0]
    inner = found[1:-1]
    if not motion.static and len(inner) >= INNER:
        # a hand that starts and stops the recording moves the first and the last frames alone
        every = [_since(inner, i) for i in range(len(inner))]
        still = [i for i, m in enumerate(every) if m.known and m.static and m.largest < STILL]
        if still:
            best = min(still, key=lambda i: every[i].largest)
            motion, reference = every[best], inner[best]
    if motion.static:
        compared = list(zip(chosen, found, strict=True))
        return replace(motion, still=_still_part(video, masks, compared, reference))
    size = _at_side(video.width, video.height)
    near = [paired(one, other) for one, other in pairwise(found)]
    far = [paired(found[0], other) for other in found[2:]]
    if min(len(one) for one, _ in near) < ENOUGH:
        return motion
    parallax, turns = turn_misses([p for p in (*near, *far) if len(p[0]) >= ENOUGH], size)
    return replace(motion, turns=turns, parallax=parallax)


def _since(found: Sequence[Features], reference: int) -> BackgroundMotion:
    """The motion of all frames but one since that one; `reference` is its place in `found`."""
    pairs = [paired(found[reference], f) for i, f in enumerate(found) if i != reference]
    shifts = [_shift(pair) if len(pair[0]) >= ENOUGH else np.nan for pair in pairs]
    matches = [len(one) for one, _ in pairs]
    return BackgroundMotion(np.array(shifts), matches, len(found[reference][0]))


def _shift(pair: Pair) -> float:
    """The median displacement, pixels."""
    return float(np.median(np.linalg.norm(pair[0] - pair[1], axis=-1)))


def _still_part(
    video: Frames, masks: GivenMasks, compared: Sequence[tuple[int, Features]], reference: Features
) -> tuple[int, int] | None:
    """Places of the frames between which the camera does not move, if it moves at an end.

    Args:
        compared: places of frames, the first and the last among them, and their features.
        reference: those of a frame in which the camera stands still.
    """
    first = _still_towards(video, masks, compared[::-1], reference)
    last = _still_towards(video, masks, compared, reference)
    whole = compared[0][0], compared[-1][0]
    return None if (first, last) == whole else (first, last)


def _still_towards(
    video: Frames, masks: GivenMasks, compared: Sequence[tuple[int, Features]], reference: Features
) -> int:
    """The place of the frame towards the last compared one up to which the camera stands still.

    A last frame whose background is hidden counts as one: nothing says that the camera moved. If
    it did, the frame is searched for by halves, as features of a frame cost half a second.
    """
    places = [place for place, _ in compared]
    still = [k for k, (_, features) in enumerate(compared) if _stays(reference, features)]
    end = len(compared) - 1
    if not still or still[-1] == end or not _moved(paired(reference, compared[end][1])):
        return places[end]
    inside, outside = places[still[-1]], places[still[-1] + 1]
    while abs(outside - inside) > 1:
        middle = (inside + outside) // 2
        (features,) = background_features(video, masks, [middle])
        if _stays(reference, features):
            inside = middle
        else:
            outside = middle
    return inside


def _stays(reference: Features, features: Features) -> bool:
    """Whether the background is seen where it is in the frame of the reference."""
    pair = paired(reference, features)
    return len(pair[0]) >= ENOUGH and _shift(pair) < STILL


def _moved(pair: Pair) -> bool:
    """Whether the background was seen to move as one, which wrong matches do not."""
    if len(pair[0]) < FEW:
        return False
    steps = pair[1] - pair[0]
    shift = np.median(steps, axis=0)
    length = float(np.linalg.norm(shift))
    spread = float(np.median(np.linalg.norm(steps - shift, axis=-1)))
    return length >= STILL and spread < STILL + COHERENT * length


def background_features(
    video: Frames, masks: GivenMasks, chosen: Sequence[int]
) -> Iterator[Features]:
    """SIFT's of the chosen frames, outside the masks: positions, pixels at SIDE, and unit
    descriptors."""
    from hoigs.core.system.colmap import pycolmap

    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features = FEATURES
    with quiet_colmap():
        sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    for i, image in zip(chosen, video.subset(chosen), strict=True):
        yield _features(sift, image, masks.moving(i))


def paired(one: Features, two: Features) -> Pair:
    """Positions of the features that are found in both images."""
    rows = _matched(one[1], two[1])
    return one[0][rows[:, 0]], two[0][rows[:, 1]]


def _features(sift, image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"]) -> Features:
    """Positions, pixels at SIDE, and unit descriptors of features outside the mask."""
    height, width = moving.shape
    size = (width, height) if max(width, height) <= SIDE else _at_side(width, height)
    small = shrink(image, *size)
    grey = np.ascontiguousarray(np.array(Image.fromarray(small).convert("L")))
    hidden = shrink_mask(grown(moving), *size)
    keypoints, found = sift.extract_from_uint8_array(grey)
    xy = np.array([(k.x, k.y) for k in keypoints], np.float64).reshape(-1, 2)
    column, row = np.clip(xy.astype(int), 0, np.array(size) - 1).T
    seen = ~hidden[row, column]
    descriptors = np.asarray(found.data, np.float32)[seen]
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True).clip(1e-6)
    return xy[seen] * (SIDE / max(size)), descriptors


def _at_side(width: int, height: int) -> tuple[int, int]:
    """Width and height with a longer side of SIDE."""
    scale = SIDE / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _matched(
    one: Float[np.ndarray, "N 128"], two: Float[np.ndarray, "M 128"], ratio: float = 0.8
) -> np.ndarray:
    """Pairs of mutual nearest neighbours that pass Lowe's ratio test, int [P, 2]."""
    if min(len(one), len(two)) < 2:
        return np.zeros((0, 2), int)
    similar = one @ two.T
    best = similar.argmax(1)
    top = np.sort(similar, axis=1)[:, -2:]
    distance = np.sqrt((2 - 2 * top).clip(0))
    clear = distance[:, 1] < ratio * distance[:, 0]
    mutual = similar.argmax(0)[best] == np.arange(len(one))
    rows = np.flatnonzero(clear & mutual)
    return np.stack((rows, best[rows]), 1)


def grown(mask: Bool[np.ndarray, "H W"], margin: float = MARGIN) -> Bool[np.ndarray, "H W"]:
    """The mask, larger by a part of its width: outlines move with what they bound."""
    pixels = max(1, round(margin * mask.shape[1]))
    return ndimage.binary_dilation(mask, iterations=pixels)


FOCALS = np.geomspace(0.5, 2.5, 12)  # tried, in longer sides of the image
NEAR = 1.5  # pixels from where a rotation would put a feature
SHARE = 0.8  # of the features, in how far most are off
FAINT = 6.0  # pixels at SIDE: with less parallax, about 0.7 degrees, structure from motion fails
REWEIGHTINGS = 6

Pair = tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]


def turn_misses(pairs: Sequence[Pair], size: tuple[int, int]) -> tuple[float, float]:
    """How far turns are from explaining pairs of images, and the largest of these turns.

    Args:
        pairs: positions of the same features in two images, pixels. size: of the images.

    Returns:
        the largest, over pairs, of the pixels within which four of five features lie of where the
        best turn puts them, for the focal length with which that is least; and degrees.
    """
    best = (np.inf, 0.0)
    for focal in FOCALS * max(size):
        found = [best_turn(pair, float(focal), size) for pair in pairs]
        miss = max(miss for miss, _ in found)
        if miss < best[0]:
            best = miss, max(degrees(R) for _, R in found)
    return best


def best_turn(
    pair: Pair, focal: float, size: tuple[int, int]
) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """The pixels within which the best rotation explains four of five features, and it."""
    one, two = (_rays(xy, focal, size) for xy in pair)
    weights = np.ones(len(one))
    for _ in range(REWEIGHTINGS):
        R = nearest_rotation((two * weights[:, None]).T @ one)
        moved = one @ R.T
        seen = moved[:, :2] / moved[:, 2:] * focal + np.array(size) / 2
        off = np.linalg.norm(seen - pair[1], axis=-1)
        weights = 1 / (1 + (off / NEAR) ** 2)
    return float(np.quantile(off, SHARE)), R


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation with the least sum of squared differences (Kabsch 1976)."""
    u, _, v = np.linalg.svd(matrix)
    turn: np.ndarray = u @ np.diag((1, 1, np.sign(np.linalg.det(u @ v)))) @ v
    return turn


def degrees(R: Float[np.ndarray, "3 3"]) -> float:
    """The angle of a rotation."""
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _rays(
    xy: Float[np.ndarray, "N 2"], focal: float, size: tuple[int, int]
) -> Float[np.ndarray, "N 3"]:
    rays = np.concatenate(((xy - np.array(size) / 2) / focal, np.ones((len(xy), 1))), -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


STEPS = (1, 2, 4, 8, 16, 32)  # frames between those that are compared
MATCHES = 80  # of a pair; more change nothing
ROUNDS = 12  # of Gauss-Newton
SURE = 0.05  # of the focal length: with a larger error it is not determined
FEWEST = 8  # frames of a half of the video, for which the focal length is found again
PLAUSIBLE = (0.4, 2.5)  # longer sides
MOST_LOST = 0.3  # of the frames may be without matches


@dataclass(frozen=True)
class Match:
    """The same features in frames `one` and `two`, pixels."""

    one: int
    two: int
    first: Float[np.ndarray, "N 2"]
    second: Float[np.ndarray, "N 2"]


@dataclass(frozen=True)
class Turns:
    """Rotations from the world to each frame's camera, the focal length and how sure it is.

    Attributes:
        focal: pixels. spread: how far it may be off, as a part of it; 0 if it was given.
        off: pixels between features and where the rotations put them, median.
        lost: frames without matches; their rotations are interpolated.
    """

    rotations: Float[np.ndarray, "F 3 3"]
    focal: float
    spread: float
    off: float
    lost: tuple[int, ...] = ()


def turning_cameras(
    video: Frames,
    masks: GivenMasks,
    lens: tuple[Lens, str] | None,
    focal: StaticFocal,
    progress: Callable[[float], None],
) -> tuple[CameraTrack, Turns]:
    """One place, and a rotation for each frame; the world is the frame's that looks into the
    middle, y down, z forward.

    Args:
        lens: at the video's own size, and where it comes from; None: a pinhole's, whose focal
            length is found, or that of `focal` where the turns do not determine it.

    Returns:
        the cameras, and what was found: with a `spread`, the turns determined the focal length.

    Raises:
        SourceError: most frames' background is not found again in their neighbours.
    """
    size = _at_side(video.width, video.height)
    start = lens[0] if lens else pinhole(video, focal.pixels)
    K = start.resized(*size).K.numpy()
    straight = start.undistortion(size).pixels
    found = []
    for i, (xy, descriptors) in enumerate(background_features(video, masks, range(len(video)))):
        found.append((straight(xy) if len(xy) else xy, descriptors))
        progress(0.8 * (i + 1) / len(video))
    matches = _matches(found)
    known = lens is not None or focal.known
    start_from = _chained(matches, len(video), K)
    turns = solved(matches, *start_from, K, fixed=True)
    if not known:
        free = solved(matches, *start_from, K, fixed=False)
        free = replace(free, spread=_spread(free, matches, start_from, K, size))
        if free.spread < SURE and PLAUSIBLE[0] < free.focal / max(size) < PLAUSIBLE[1]:
            turns = free
    progress(1.0)
    how = lens[1] if lens else focal.how
    return _track(video, start, how, turns, turns.focal / K[0, 0]), turns


def _spread(
    free: Turns, matches: Sequence[Match], start_from: tuple[np.ndarray, tuple[int, ...]],
    K: np.ndarray, size: tuple[int, int],
) -> float:  # fmt: skip
    """How far a focal length found by turns may be off, as a part of it: the largest of its
    standard deviation, of how the halves of the video differ, and of what the distance between
    features and their places could do to it if it were all alike.

    A turn by an angle moves the sides of a picture by angle x (width / 2)^2 / focal more than its
    middle, which is all that shows the focal length; a camera that also changes its place moves
    near and far features apart, which may look the same.
    """
    count = len(free.rotations)
    one, other = np.triu_indices(count, 1)
    traces = np.einsum("fij,gij->fg", free.rotations, free.rotations)[one, other]
    angle = float(np.arccos(np.clip((traces - 1) / 2, -1, 1)).max())
    spreads = [free.spread, free.off / max(angle * (max(size) / 2) ** 2 / free.focal, 1e-9)]
    middle = count // 2
    halves = []
    for rows in (range(middle), range(middle, count)):
        own = [m for m in matches if m.one in rows and m.two in rows]
        if len(rows) >= FEWEST and own:
            halves.append(solved(own, *start_from, K, fixed=False).focal)
    if len(halves) == 2:
        spreads.append(abs(float(np.log(halves[0] / halves[1]))) / 2)
    return max(spreads)


def _track(video: Frames, lens: Lens, how: str, turns: Turns, zoom: float) -> CameraTrack:
    figures = {}
    if turns.spread:
        pixels = zoom * float(lens.K[0, 0])
        lens = pinhole(video, pixels)
        low, high = (pixels * (1 + sign * turns.spread) for sign in (-1, 1))
        how = f"by the camera's turns, {low:.0f} to {high:.0f} px"
        figures = {"focal_low_px": round(low, 1), "focal_high_px": round(high, 1)}
    still = static_cameras(video, lens, how)
    poses = torch.eye(4).repeat(len(video), 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turns.rotations).float()
    angles = [degrees(R) for R in turns.rotations]
    provenance = still.provenance.replace("static camera", "camera that turns", 1)
    return replace(
        still,
        cameras=[
            replace(camera, world_to_camera=pose)
            for camera, pose in zip(still.cameras, poses, strict=True)
        ],
        provenance=f"{provenance}, up to {max(angles):.1f} degrees from the middle; features "
        f"outside the masks lie {turns.off:.2f} px (median, {PIXELS}) off",
        figures=still.figures | figures | {"turn_degrees": round(max(angles), 2)},
    )


def _matches(found: Sequence[Features]) -> list[Match]:
    """Of frames a few steps apart, features spread over what there is."""
    matches = []
    for step in STEPS:
        for i in range(len(found) - step):
            one, two = paired(found[i], found[i + step])
            if len(one) >= ENOUGH:
                chosen = np.linspace(0, len(one) - 1, min(MATCHES, len(one))).astype(int)
                matches.append(Match(i, i + step, one[chosen], two[chosen]))
    return matches


def solved(
    matches: Sequence[Match],
    rotations: Float[np.ndarray, "F 3 3"],
    lost: tuple[int, ...],
    K: Float[np.ndarray, "3 3"],
    *,
    fixed: bool,
) -> Turns:
    """The rotations, and unless it is `fixed` the focal length, that explain all matches best.

    Args:
        rotations: to start from. lost: frames without matches. K: of the images that were matched.
    """
    focal, center = float(K[0, 0]), K[:2, 2]
    size = 3 * len(rotations) + 1
    normal, off = np.eye(size), np.zeros(1)
    for _ in range(ROUNDS):
        normal, gradient, off = _equations(matches, rotations, focal, center)
        if fixed:
            normal[-1], normal[:, -1], gradient[-1] = 0, 0, 0
            normal[-1, -1] = 1
        largest = normal.diagonal().max()
        normal += 1e-9 * largest * np.eye(size)  # of frames without matches, too
        normal[:3, :3] += largest * np.eye(3)  # one frame stays
        change = np.linalg.solve(normal, gradient)
        rotations = Rotation.from_rotvec(change[:-1].reshape(-1, 3)).as_matrix() @ rotations
        focal *= float(np.exp(np.clip(change[-1], -0.2, 0.2)))
        if np.abs(change).max() < 1e-6:
            break
    spread = 0.0
    if not fixed:  # of residuals within reach of the weights
        noise = float((off[off < 3 * NEAR] ** 2).mean() / 2)
        spread = float(np.sqrt(noise * np.linalg.inv(normal)[-1, -1]))
    rotations = _interpolated(rotations, lost)
    mean = nearest_rotation(rotations.sum(0))
    middle = int(np.argmax(np.einsum("fij,ij->f", rotations, mean)))
    return Turns(rotations @ rotations[middle].T, focal, spread, float(np.median(off)), lost)


def _equations(
    matches: Sequence[Match], rotations: np.ndarray, focal: float, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal equations for small turns of each camera and the logarithm of the focal length, and
    the distances in pixels. A match's prediction is the first feature's ray, turned."""
    size = 3 * len(rotations) + 1
    normal, gradient, distances = np.zeros((size, size)), np.zeros(size), []
    for m in matches:
        A = rotations[m.two] @ rotations[m.one].T
        ray = np.concatenate(((m.first - center) / focal, np.ones((len(m.first), 1))), -1)
        d = ray @ A.T
        flat = d[:, :2] / d[:, 2:]
        off = m.second - (focal * flat + center)
        # derivatives of the prediction by the turned ray, then by turns and focal length
        slope = np.zeros((len(d), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = 1
        slope[:, :, 2] = -flat
        slope *= (focal / d[:, 2])[:, None, None]
        turned = -slope @ _cross(d)
        shrunk = -ray * (1, 1, 0)
        by_focal = focal * flat + np.einsum("nij,nj->ni", slope, shrunk @ A.T)
        J = np.concatenate((turned, -turned @ A, by_focal[..., None]), -1)
        length = np.linalg.norm(off, axis=-1)
        weight = 1 / (1 + (length / NEAR) ** 2) ** 2
        rows = np.r_[3 * m.two : 3 * m.two + 3, 3 * m.one : 3 * m.one + 3, size - 1]
        normal[np.ix_(rows, rows)] += np.einsum("nai,naj,n->ij", J, J, weight)
        gradient[rows] += np.einsum("nai,na,n->i", J, off, weight)
        distances.append(length)
    return normal, gradient, np.concatenate(distances)


def _chained(
    matches: Sequence[Match], count: int, K: np.ndarray
) -> tuple[np.ndarray, tuple[int, ...]]:
    """Rotations from one frame on, each by the nearest frame that is reached already, and the
    frames that no chain reaches.

    Raises:
        SourceError: these are most of them.
    """
    # `best_turn` has the axis in the middle of images of this size, where K has it
    size = (2 * K[0, 2], 2 * K[1, 2])
    rotations = np.tile(np.eye(3), (count, 1, 1))
    waiting = sorted(matches, key=lambda m: m.two - m.one)
    reached = {waiting[0].one} if waiting else set()
    while True:
        m = next((m for m in waiting if (m.one in reached) != (m.two in reached)), None)
        if m is None:
            break
        _, A = best_turn((m.first, m.second), float(K[0, 0]), size)
        if m.one in reached:
            rotations[m.two] = A @ rotations[m.one]
        else:
            rotations[m.one] = A.T @ rotations[m.two]
        reached |= {m.one, m.two}
    lost = tuple(sorted(set(range(count)) - reached))
    if len(lost) > MOST_LOST * count:
        raise SourceError(
            f"the camera turns, and the background of {len(lost)} of {count} frames "
            f"({ranges(lost)}) is not found again in their neighbours: it may lack texture, be "
            "blurred or be hidden by the masks; choose a part without them (--start, --end)"
        )
    return rotations, lost


def _interpolated(rotations: np.ndarray, lost: Sequence[int]) -> np.ndarray:
    """With the rotations of lost frames between those of their neighbours."""
    if not lost:
        return rotations
    kept = np.setdiff1d(np.arange(len(rotations)), lost)
    frames = np.clip(np.arange(len(rotations)), kept[0], kept[-1])
    between: np.ndarray = Slerp(kept, Rotation.from_matrix(rotations[kept]))(frames).as_matrix()
    return between


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices of the cross products with vectors [N, 3]."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack((o, -z, y, z, o, -x, -y, x, o), -1).reshape(-1, 3, 3)

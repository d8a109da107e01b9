"""Other knots for a motion that has knots, and how far they move it on the screen."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.interfaces.deformation import HasKnots
from hoigs.core.maths.splines import uniform_times
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians

PROBES = 64  # Gaussians whose paths stand for all
NEAR = 0.05  # metres; points nearer to the camera, or behind it, are not measured
REACH = 3  # knots: a tangent by finite differences depends on the next knot, an interval on two
REFITTED = 3  # how many of the best candidates for removal are tried with a refit


def probe_rows(count: int) -> Tensor:
    """Rows of at most PROBES of `count` Gaussians, spread evenly."""
    return torch.linspace(0, count - 1, min(count, PROBES)).round().long()


class KnotTrial:
    """Other knots for a motion, undone on leaving the context unless `keep` was called."""

    def __init__(self, curve: HasKnots) -> None:
        self.curve, self.kept = curve, False
        self.times = curve.knots.tolist()
        self.values = {name: curve.get_parameter(name).data for name in curve.knot_axes}

    def __enter__(self) -> KnotTrial:
        return self

    def place(self, times: Sequence[float], fit: Sequence[float]) -> None:
        """Knots at `times`, with the parameters of `HasKnots.resampled(times, fit)`."""
        values = self.curve.resampled(times, fit)
        self.curve.knots.place(times)
        self._set(values)

    def leave_out(self, k: int) -> None:
        """One knot fewer; the values at the others stay."""
        self.curve.knots.place(self.times[:k] + self.times[k + 1 :])
        values = {}
        for name, value in self.values.items():
            axis = self.curve.knot_axes[name]
            after = value.narrow(axis, k + 1, value.shape[axis] - k - 1)
            values[name] = torch.cat((value.narrow(axis, 0, k), after), axis)
        self._set(values)

    def keep(self) -> None:
        self.kept = True

    def restore(self) -> None:
        """The knots and values as they were when this trial was made."""
        self.curve.knots.place(self.times)
        self._set(self.values)

    def __exit__(self, *error: object) -> None:
        if not self.kept:
            self.restore()

    def _set(self, values: Mapping[str, Tensor]) -> None:
        for name, value in values.items():
            parameter = self.curve.get_parameter(name)
            parameter.grad = None
            parameter.data = value.contiguous()


@contextmanager
def as_movable(curve: HasKnots) -> Iterator[None]:
    """Uniform knots become movable at the times where they are, for a KnotTrial.

    Movable knots are left as they are, because tangents are per interval of the knots that the
    motion began with.
    """
    own = curve.knots
    if not own.movable:
        curve.knots = own.placed(own.tolist())
    try:
        yield
    finally:
        curve.knots = own


class ScreenMotion(nn.Module):
    """Where a motion moves some Gaussians on the screen, frame by frame.

    Args:
        cameras: one a frame of the clip, at the size that pixels are counted in.

    Raises:
        ValueError: no cameras.
    """

    intrinsics: Tensor
    world_to_camera: Tensor

    def __init__(self, cameras: Sequence[Camera]) -> None:
        super().__init__()
        if not cameras:
            raise ValueError(
                "knots are measured in pixels, which needs the clip's cameras, one for each "
                "frame: got none"
            )
        frames = len(cameras)
        self.frame_times = [f / max(frames - 1, 1) for f in range(frames)]
        for name, tensors in {
            "intrinsics": [c.K for c in cameras],
            "world_to_camera": [c.world_to_camera for c in cameras],
        }.items():
            self.register_buffer(name, torch.stack(tensors).float(), persistent=False)

    def sample_times(self) -> list[float]:
        """Every frame and every half frame."""
        return uniform_times(max(2 * len(self.frame_times) - 1, 2))

    def paths(
        self, curve: HasKnots, canonical: Gaussians, frames: slice = slice(None)
    ) -> Float[Tensor, "F P 2"]:
        """Pixels of the Gaussians of `curve.traced` in every frame, or in some `frames`; NaN where
        they are not in front."""
        return self.on_screen(curve.traced(canonical, self.frame_times[frames]), frames)

    def on_screen(
        self, points: Float[Tensor, "F P 3"], frames: slice = slice(None)
    ) -> Float[Tensor, "F P 2"]:
        """Pixels of world points, one row per frame; NaN where they are not in front."""
        points, view = points.float(), self.world_to_camera[frames]
        camera = points @ view[:, :3, :3].mT + view[:, :3, 3][:, None]
        pixels = camera @ self.intrinsics[frames].mT
        return torch.where(camera[..., 2:] > NEAR, pixels[..., :2] / pixels[..., 2:], torch.nan)

    @staticmethod
    def distances(a: Float[Tensor, "F P 2"], b: Float[Tensor, "F P 2"]) -> Float[Tensor, " F"]:
        """Mean distance over the Gaussians in each frame, pixels."""
        return (a - b).norm(dim=-1).nanmean(1).nan_to_num(0.0)

    @classmethod
    def deviation(cls, a: Float[Tensor, "F P 2"], b: Float[Tensor, "F P 2"]) -> float:
        """Mean distance over the Gaussians in the worst frame, pixels."""
        return float(cls.distances(a, b).max())


def cameras_of_frames(clip: Clip) -> list[Camera]:
    """A camera for every frame of the clip: its own, or that of the last one before it."""
    by_index = dict(zip((m.index for m in clip.moments), clip.cameras, strict=True))
    last, cameras = min(by_index), []
    for index in range(clip.num_frames):
        last = index if index in by_index else last
        cameras.append(by_index[last])
    return cameras


def remove_knots(
    curve: HasKnots,
    canonical: Gaussians,
    screen: ScreenMotion,
    *,
    pixels: float,
    minimum: int,
    before: Float[Tensor, "F P 2"] | None = None,
) -> None:
    """Take out movable knots, the least needed first, down to `minimum`, as long as the refitted
    motion stays within `pixels` of the motion before the first removal.

    This is the criterion of SplineGS (Park et al. 2025), measured in the worst frame instead of
    the mean over all frames, so that a long quiet clip does not hide one jerk.

    Args:
        before: `screen.paths` of the motion to stay near; that of `curve` as it is if None.
    """
    before = screen.paths(curve, canonical) if before is None else before
    fit = screen.sample_times()
    while len(curve.knots) > minimum:
        times = curve.knots.tolist()
        without = deviations_without(curve, canonical, screen, before)
        trials = sorted(zip(without, range(1, len(times) - 1), strict=True))
        for _, k in trials[:REFITTED]:  # each refit costs far more than leaving out
            with KnotTrial(curve) as trial:
                trial.place(times[:k] + times[k + 1 :], fit)
                if screen.deviation(before, screen.paths(curve, canonical)) <= pixels:
                    trial.keep()
                    break
        else:
            return


def deviations_without(
    curve: HasKnots, canonical: Gaussians, screen: ScreenMotion, before: Float[Tensor, "F P 2"]
) -> list[float]:
    """`ScreenMotion.deviation` from `before` without each inner knot, the values at others kept.

    Only the frames up to REACH knots away are traced anew, as a knot moves no others: all frames
    for every knot would be most of the time of a pruning of a long clip.
    """
    times, frames = curve.knots.tolist(), screen.frame_times
    off = screen.distances(before, screen.paths(curve, canonical))
    found = []
    for k in range(1, len(times) - 1):
        start = bisect_left(frames, times[max(k - REACH, 0)])
        near = slice(start, bisect_right(frames, times[min(k + REACH, len(times) - 1)]))
        with KnotTrial(curve) as trial:
            trial.leave_out(k)
            here = screen.distances(before[near], screen.paths(curve, canonical, near))
        found.append(float(torch.cat((off[:start], here, off[near.stop :])).max()))
    return found


def screen_of(clip: Clip) -> ScreenMotion:
    """The cameras of a clip, one a frame, in whose pixels motions are compared on the CPU."""
    return ScreenMotion(cameras_of_frames(clip))

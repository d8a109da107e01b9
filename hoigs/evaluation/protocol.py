"""Protocol: under which conditions a score was measured. Every score is stored with one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from hoigs.core.spec.train_schema import TestCamera, TestPose

Pixels = Literal["float", "8-bit"]


@dataclass(frozen=True)
class NotComputed:
    """The reason why there is no number, in its place."""

    reason: str

    def __str__(self) -> str:
        return f"not computed: {self.reason}"


Value = float | NotComputed


def mean_of(values: Sequence[Value]) -> tuple[Value, int]:
    """The mean of those that are numbers, and how many there are; the reasons without any."""
    numbers = [v for v in values if not isinstance(v, NotComputed)]
    if numbers:
        return sum(numbers) / len(numbers), len(numbers)
    reasons = sorted({v.reason for v in values if isinstance(v, NotComputed)})
    return NotComputed("; ".join(reasons) or "no frames"), 0


def to_json(value: Value) -> float | dict[str, str]:
    """A value as JSON files have it."""
    return {"not_computed": value.reason} if isinstance(value, NotComputed) else value


def from_json(stored: float | Mapping[str, str]) -> Value:
    """The value of `to_json`."""
    return float(stored) if isinstance(stored, int | float) else NotComputed(stored["not_computed"])


@dataclass(frozen=True)
class Protocol:
    """The conditions of a score.

    Attributes:
        views: "training cameras" (test times on the training path) or "held-out cameras".
        split: name of the clip's split whose frames were scored. frames: their number.
        unseen_times: number of these frames at times without a training frame.
        region: one of regions.REGIONS. band: width of the interaction band, pixels.
        test_pose: source of the body poses: "given" by the clip, with the corrections of
            neighbouring training frames; "interpolated" from these frames; "blended" from both; or
            "fitted" to the test images themselves (`posing.posed_clip`).
        object_poses: source of the objects' tracks, which stay as they are at test frames: "given"
            by the clip; "" where no object has one, and in scores of 0.1.
        own_share: of "blended" poses: 0 is "interpolated", 1 nearly "given"; None of others.
        pixels: "float" renders, or rounded to "8-bit"; clamped to [0, 1] either way.
        background: colour behind all Gaussians.
        width, height: of the scored images, pixels.
        lpips_net: "alex", "vgg", or None if LPIPS was not computed. lpips_range: of its input.
        lpips_weights: where the network's weights came from; "" in scores of 0.1.
        device, rasterizer: that drew the images.
        test_camera: source of the cameras, as `test_pose`; those of held-out views are given.
        fit_steps: optimizer steps per fitted frame; 0 if nothing was fitted.
        cameras_refined: training corrected its cameras, so given ones are corrected too.
        ignored: share of the pixels that show no scene (`Frame.ignored`); they are not scored.
    """

    views: str
    split: str
    frames: int
    unseen_times: int
    region: str
    band: int
    test_pose: TestPose
    pixels: Pixels
    width: int
    height: int
    lpips_net: str | None
    device: str
    rasterizer: str
    test_camera: TestCamera = "given"
    object_poses: str = ""
    own_share: float | None = None
    fit_steps: int = 0
    cameras_refined: bool = False
    ignored: float = 0.0
    background: str = "black"
    lpips_weights: str = ""
    lpips_range: str = "[-1, 1]"
    averages: str = "mean over frames of the metric of each frame"
    ssim: str = "11x11 Gaussian, sigma 1.5, zero padding; of regions: mean of the map over them"
    lpips_regions: str = "mean over the region of the spatial map, layers upsampled bilinearly"
    depth: str = "mean |rendered - true| along z where truth is known and alpha > 0.5, metres"

    def of(self, region: str) -> Protocol:
        """The same protocol for another region."""
        return replace(self, region=region)

    def given(self) -> str:
        """The inputs that a model gets for the scored frames, as "cameras, body and object poses
        given"; "" where it gets none."""
        sources = {"body": self.test_pose, "object": self.object_poses}
        poses = " and ".join(what for what, how in sources.items() if how == "given")
        inputs = ["cameras"] if self.test_camera == "given" else []
        inputs += [f"{poses} poses"] if poses else []
        return f"{', '.join(inputs)} given" if inputs else ""

    def _cameras(self) -> str:
        moved = ", moved by the corrections that training learned" if self.cameras_refined else ""
        return f"cameras: {self.test_camera}{moved if self.test_camera != 'interpolated' else ''}"

    def _poses(self) -> str:
        if self.own_share is None:
            return self.test_pose
        return (
            f"{self.test_pose}, {100 * self.own_share:.0f} % of the way from those between "
            "neighbouring training frames to the frame's own, as draws training frames best"
        )

    def _warnings(self) -> list[str]:
        """The first note of a score whose poses or cameras were fitted to its images."""
        fitted = [
            what
            for what, how in (("body poses", self.test_pose), ("cameras", self.test_camera))
            if how == "fitted"
        ]
        if not fitted:
            return []
        seen = (
            "the very images that are scored here"
            if self.views != "held-out cameras"
            else "the training camera's images of the same moments"
        )
        return [
            f"FITTED TO TEST IMAGES: {' and '.join(fitted)} were optimised for {self.fit_steps} "
            f"steps a frame on {seen}. Not to be compared with scores under given or interpolated "
            "ones: elsewhere such a fit was worth 5 dB."
        ]

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def footnotes(self) -> list[str]:
        """The protocol in sentences, for the foot of a table."""
        weights = f" (weights: {self.lpips_weights})" if self.lpips_weights else ""
        lpips = (
            f"LPIPS v0.1 {self.lpips_net}{weights} on {self.lpips_range}, of regions: "
            f"{self.lpips_regions}"
            if self.lpips_net
            else "LPIPS not computed"
        )
        left_out = (
            f"; {100 * self.ignored:.2f} % of the pixels show no scene and are left out"
            if self.ignored
            else ""
        )
        objects = f"object poses: {self.object_poses}; " if self.object_poses else ""
        return [
            f"{self.frames} frames of split {self.split!r} from {self.views}, "
            f"{self.unseen_times or 'none'} of them at times that were not trained on; "
            f"body poses: {self._poses()}; {objects}{self._cameras()}.",
            *self._warnings(),
            f"{self.width}x{self.height}, {self.pixels} pixels clamped to [0, 1] over "
            f"{self.background}; {self.averages}; drawn by {self.rasterizer} on {self.device}"
            f"{left_out}.",
            f"SSIM: {self.ssim}. {lpips}. Interaction: within {self.band} px of human and object.",
        ]

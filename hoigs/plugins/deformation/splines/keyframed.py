"""What the motions over keyframes of the clip have in common: their settings, knots and start."""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import DeformationModel, StepStatistics
from hoigs.core.maths import splines
from hoigs.core.maths.knots import Knots
from hoigs.core.model.knot_refit import cameras_of_frames
from hoigs.core.resizing import Resizing
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import AxisChange
from hoigs.plugins.deformation.irradiance import Irradiance, outward_normals, turned_normals
from hoigs.plugins.deformation.splines.knot_schedule import AdaptiveKnotsConfig, KnotSchedule
from hoigs.plugins.deformation.splines.rigid_track import RigidTrack

LARGE_STEP = math.radians(120)
REFIT_SMOOTHNESS = 1e-8  # so faint that it decides only what the samples leave open


class KeyframedConfig(ComponentConfig):
    """Keyframes of a motion."""

    keyframes: Annotated[int, Field(ge=2)] | Literal["adaptive"] | None = None
    """Number of knots; None derives it from `keyframe_step` and the clip's length; "adaptive"
    starts from that, with at least `adaptive.minimum`, and lets training insert and remove
    knots."""
    keyframe_step: int = Field(default=4, ge=1)
    """Frames between knots (the paper's 4)."""
    tangents: Literal["learned", "finite-difference"] = "learned"
    """"learned" velocities at the knots (the paper), or "finite-difference" of its neighbours."""
    track: bool = True
    """Start from the object's rigid track, where it has one, else at rest."""
    light: bool = False
    """Learn the light by the direction in which the surface faces (`Irradiance`), so that colours
    change as the object turns; False is the paper."""
    adaptive: AdaptiveKnotsConfig = Field(default_factory=AdaptiveKnotsConfig)
    """When and how knots change, if `keyframes` is "adaptive"."""


class Keyframed(Resizing, DeformationModel):
    """Base of motions over K knots (`HasKnots`).

    With `light`, `normals` [N, 3] are a parameter: of the canonical Gaussians' surface.

    Args:
        config: with `keyframes` None or "adaptive", K follows from the number of frames.
        num_frames: frames of the clip; by default those of the track.
        track: the canonical Gaussians are then those of the object about its centre, and the
            motion starts from the track.
        cameras: of every frame, if `keyframes` is "adaptive".

    Raises:
        ValueError: neither `keyframes` nor frames to derive them; adaptive without cameras.
    """

    Config: ClassVar = KeyframedConfig
    provides = frozenset({"velocity"})

    knot_axes: Mapping[str, int]
    normals: nn.Parameter

    def __init__(
        self,
        config: KeyframedConfig | None = None,
        *,
        num_frames: int | None = None,
        track: ObjectTrack | None = None,
        cameras: Sequence[Camera] = (),
    ) -> None:
        super().__init__()
        self.config = config = config or self.Config()
        if num_frames is None and track is not None:
            num_frames = len(track.rotations)
        adaptive, keyframes = config.keyframes == "adaptive", config.keyframes
        if not isinstance(keyframes, int):
            if num_frames is None:
                raise ValueError(
                    f"{type(self).__name__} needs `keyframes`, or `num_frames` or a `track` to "
                    "derive them"
                )
            keyframes = splines.keyframe_count(num_frames, config.keyframe_step)
        if adaptive:
            keyframes = max(keyframes, config.adaptive.minimum)
        self.knots = Knots(keyframes, movable=adaptive)
        self.schedule = KnotSchedule(cameras, config.adaptive) if adaptive else None
        self.keyframes = keyframes  # at the start: features take the size of their own from it
        self.learned = config.tangents == "learned"
        self.num_frames = num_frames
        self.input_space = "canonical" if track is not None else "world"
        self._track = track
        self.irradiance: Irradiance | None = None
        if config.light:
            self.irradiance = Irradiance()
            self.per_gaussian = (*self.per_gaussian, "normals")

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(config, **cls.given(config, context))

    @staticmethod
    def given(config: KeyframedConfig, context: BuildContext) -> dict[str, Any]:
        """The constructor's arguments that come from the context."""
        clip = context.clip
        return {
            "num_frames": None if clip is None else clip.num_frames,
            "track": context.object_track if config.track else None,
            "cameras": cameras_of_frames(clip) if clip and config.keyframes == "adaptive" else (),
        }

    def starting_track(self, like: Tensor) -> RigidTrack | None:
        """The track that the motion starts from; warns of turns too large for the keyframes."""
        if self._track is None:
            return None
        track = RigidTrack(self._track).to(like)
        step = track.largest_step(self.keyframes)
        if step > LARGE_STEP:
            warnings.warn(
                f"the object turns {math.degrees(step):.0f} degrees between two keyframes: slerp "
                "may turn it the wrong way, and splines of points cut such corners; use more "
                "keyframes (a smaller keyframe_step)",
                stacklevel=4,
            )
        return track

    def bind_light(self, canonical: Gaussians) -> None:
        """To be called by `bind`."""
        if self.irradiance is not None:
            self.irradiance.to(canonical.means)
            self.normals = nn.Parameter(outward_normals(canonical.detach()))

    def lit(self, moved: Gaussians, canonical: Gaussians) -> Gaussians:
        """Gaussians that were turned from their canonical rotations, in the light there."""
        if self.irradiance is None:
            return moved
        normals = self.normals / self.normals.norm(dim=-1, keepdim=True)  # they start with length 1
        lit: Gaussians = self.irradiance(
            moved, turned_normals(normals, canonical.quats, moved.quats)
        )
        return lit

    def refitted(
        self, samples: Float[Tensor, "S D"], fit: Sequence[float], times: Sequence[float]
    ) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
        """Values and tangents at knots at `times`, fitted to samples of the motion at `fit`."""
        knots = self.knots.placed(times)
        return knots.fit(samples, fit, free_tangents=self.learned, smoothness=REFIT_SMOOTHNESS)

    def knot_penalties(
        self, values: Float[Tensor, "N K 3"], tangents: Float[Tensor, "N K 3"] | None
    ) -> dict[str, Tensor]:
        """Squared, mean per curve and knot, in metres per interval. "acceleration": second
        differences of uniform knots. "tangent": learned tangents against finite differences, which
        an interval's few frames cannot determine alone."""
        penalties: dict[str, Tensor] = {}
        if len(self.knots) > 2 and not self.knots.movable:
            penalties["acceleration"] = splines.accelerations(values).square().sum(-1).mean()
        if tangents is not None:
            apart = tangents - self.knots.differences(values)
            penalties["tangent"] = apart.square().sum(-1).mean()
        return penalties

    @abstractmethod
    def resampled(self, times: Sequence[float], fit: Sequence[float]) -> dict[str, Tensor]:
        """As `HasKnots`."""

    @abstractmethod
    def traced(self, canonical: Gaussians, times: Sequence[float]) -> Float[Tensor, "T P 3"]:
        """As `HasKnots`."""

    def evolve(self, canonical: Gaussians, statistics: StepStatistics) -> Mapping[str, AxisChange]:
        return {} if self.schedule is None else self.schedule.step(self, canonical, statistics)

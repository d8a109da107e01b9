"""SceneConfig: every parameter of a synthetic clip."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from hoigs.core.config import ComponentConfig

CameraPathName = Literal["orbit", "pan", "static"]
ObjectMotionName = Literal[
    "held",
    "thrown",
    "pushed",
    "bending",
    "static",
    "carried",
    "gliding",
    "figure-eight",
    "squeezed",
]
MOST_FRAMES = 100_000  # names of frames have five digits
MOST_PIXELS = 8192  # a side
MOST_POINTS = 10_000_000
OF_ONE_MOTION: dict[str, ObjectMotionName] = {
    "cycles": "figure-eight", "throw_turns": "thrown", "throw_height": "thrown",
    "hidden_share": "carried", "regrips": "pushed", "jolt_metres": "pushed",
    "bend_degrees": "bending", "bend_share": "bending", "squeeze_share": "squeezed",
    "alone": "gliding",
}  # fmt: skip


class CameraConfig(ComponentConfig):
    """The camera that films the clip.

    orbit: an arc about the person with a change of height; pan: a sideways dolly with a fixed
    viewing direction; static: one place.
    """

    path: CameraPathName = "orbit"
    azimuth_degrees: float = Field(
        default=8.0, description="middle of the path; 0 faces the person"
    )
    arc_degrees: float = Field(default=44.0, ge=0, le=180, description="whole arc of an orbit")
    pan_metres: float = Field(default=1.2, ge=0, description="whole way of a pan")
    distance: float = Field(
        default=3.5, gt=0.5, description="to the target, metres, along the floor"
    )
    height: float = Field(default=1.45, gt=0, description="of the camera's centre, metres")
    height_change: float = Field(
        default=0.5, ge=0, description="between the ends of the path, metres"
    )
    target: tuple[float, float, float] = (0.0, 0.88, 0.15)
    fov_y_degrees: float = Field(default=40.0, gt=5, lt=120)
    principal_point_shift: tuple[float, float] = Field(
        default=(0.0, 0.0),
        description="of (cx, cy) from the middle, as fractions of width and height",
    )
    shutter_frames: int = Field(
        default=1,
        ge=1,
        le=999,
        description="odd; each image is the mean of this many frames around its own",
    )

    @field_validator("shutter_frames")
    @classmethod
    def _is_odd(cls, frames: int) -> int:
        if frames % 2 == 0:
            raise ValueError(f"shutter_frames is {frames}: expected an odd number, as 1, 3 or 5")
        return frames


class ObjectConfig(ComponentConfig):
    """The object that is handled, and how it moves."""

    motion: ObjectMotionName = "held"
    size: tuple[float, float, float] = Field(
        default=(0.34, 0.25, 0.26), description="between the hands, height, depth; metres"
    )
    textured: bool = Field(default=True, description="False paints it in one colour")
    contrast: float = Field(
        default=1.0, ge=0, le=1, description="of its patterns; 0 leaves mean colours"
    )
    cycles: float = Field(default=1.0, gt=0, description="of a figure-eight in the clip")
    throw_turns: float = Field(
        default=1.0, ge=0, description="of a thrown object about x in its flight"
    )
    hidden_share: float | None = Field(
        default=None,
        ge=0,
        le=0.6,
        description="of the clip with the back turned; None keeps the default walk",
    )
    regrips: int = Field(
        default=0, ge=0, le=MOST_FRAMES, description="times that the hands leave a pushed object"
    )
    appears: float = Field(
        default=0.0, ge=0, lt=1, description="share of the clip before it appears"
    )
    swing_degrees: float = Field(
        default=52.0, ge=0, le=60, description="yaw of the swing to either side"
    )
    tilt_degrees: float = Field(
        default=20.0, ge=0, le=45, description="roll and pitch while it swings"
    )
    lift_height: float = Field(
        default=1.22, gt=0, description="of the centre at the top of the swing"
    )
    stand_height: float = Field(default=0.56, gt=0.1, description="of what it stands on, metres")
    throw_height: float = Field(default=0.45, gt=0, description="rise of a throw, metres")
    jolt_metres: float = Field(
        default=0.0,
        ge=0,
        description="std of jolts, frame by frame, of a pushed object and the hands",
    )
    bend_degrees: float = Field(
        default=70.0, ge=0, le=150, description="of a bending bar, end to end"
    )
    bend_share: float = Field(
        default=1.0, gt=0, le=1, description="of a bar's length that bends; 0.02 is a hinge"
    )
    squeeze_share: float = Field(
        default=0.3, ge=0, lt=0.7, description="of the width that hands squeeze away"
    )
    alone: bool = Field(
        default=False, description="a gliding object moves by itself, and the person stands still"
    )
    round: bool = Field(default=False, description="a ball as wide as `size` instead of a box")
    mirror: float = Field(
        default=0.0, ge=0, le=1, description="share of its light that it reflects as a mirror does"
    )

    @model_validator(mode="after")
    def _moves_as_set(self) -> Self:
        """A setting of another motion would change nothing, without a word."""
        for name, motion in OF_ONE_MOTION.items():
            changed = getattr(self, name) != type(self).model_fields[name].default
            if changed and self.motion != motion:
                raise ValueError(
                    f'{name} is of motion "{motion}" alone, and this object\'s is "{self.motion}"'
                )
        return self


class LightConfig(ComponentConfig):
    """Sun and sky; both fixed in the world, so that every view agrees."""

    sun: float = Field(default=1.15, ge=0)
    ambient: float = Field(default=0.78, ge=0)
    sun_direction: tuple[float, float, float] = Field(
        default=(0.45, 1.0, 0.65), description="towards the sun"
    )
    sun_radius_degrees: float = Field(
        default=7.0, ge=0, description="half-angle; wide gives soft shadows"
    )
    shadows: float = Field(default=0.75, ge=0, le=1, description="0 casts none")
    occlusion: float = Field(default=0.8, ge=0, le=1, description="ambient occlusion; 0 is none")
    exposure_ramp: float = Field(
        default=0.0, gt=-1, lt=1, description="relative gain, first to last frame"
    )


class NoiseConfig(ComponentConfig):
    """Errors added to the written data, as of a real pipeline; the ground truth stays exact.

    Clips with absent files or NaN depth need `--allow-faults`.
    """

    mask_boundary: float = Field(
        default=0.0, ge=0, le=1, description="share of boundary pixels flipped"
    )
    mask_edge_pixels: int = Field(
        default=0,
        ge=0,
        description="each mask is dilated or eroded by up to this many pixels, frame by frame",
    )
    mask_missing: float = Field(
        default=0.0, ge=0, le=1, description="share of masks that are all zero"
    )
    mask_absent: float = Field(default=0.0, ge=0, le=1, description="share of masks without a file")
    depth_relative: float = Field(default=0.0, ge=0, description="std as a share of the depth")
    depth_scale: float = Field(default=1.0, gt=0)
    depth_holes: float = Field(
        default=0.0, ge=0, le=1, description="share of pixels without a depth"
    )
    depth_nan: float = Field(
        default=0.0, ge=0, le=1, description="share of pixels whose depth is NaN"
    )
    frames_dropped: float = Field(
        default=0.0,
        ge=0,
        lt=0.5,
        description="share of frames lost from the video: the clip is shorter",
    )
    frames_absent: float = Field(
        default=0.0, ge=0, lt=1, description="share of images without a file"
    )
    pose_degrees: float = Field(default=0.0, ge=0, description="std of each joint's rotation")
    pose_metres: float = Field(default=0.0, ge=0, description="std of the body's position")
    betas: float = Field(default=0.0, ge=0, description="std of the body's shape coefficients")
    object_degrees: float = Field(default=0.0, ge=0, description="std of the object's rotation")
    object_metres: float = Field(default=0.0, ge=0, description="std of the object's position")
    camera_degrees: float = Field(default=0.0, ge=0, description="std of each camera's rotation")
    camera_metres: float = Field(default=0.0, ge=0, description="std of each camera's position")
    points_metres: float = Field(default=0.004, ge=0, description="std of the initial points")

    def moves_poses(self) -> bool:
        """Whether the clip's body poses or shapes differ from the truth."""
        return self.pose_degrees > 0 or self.pose_metres > 0 or self.betas > 0


class SceneConfig(ComponentConfig):
    """A synthetic clip: one person, one object, one room, one moving camera, known truth."""

    frames: int = Field(default=64, ge=2, le=MOST_FRAMES)
    """Of the whole clip."""
    width: int = Field(default=256, ge=16, le=MOST_PIXELS)
    """Pixels."""
    height: int = Field(default=256, ge=16, le=MOST_PIXELS)
    """Pixels."""
    fps: float = Field(default=16.0, gt=0)
    """So that frames / fps is its length in seconds."""
    seed: int = 0
    """Of textures, points and noise."""
    samples: int = Field(default=4, ge=1, le=64)
    """Rays a pixel, and rays where those disagree (edges, soft shadows); for colour only: masks and
    depth are those of the pixel's centre."""
    edge_samples: int = Field(default=8, ge=1, le=64)
    """Rays a pixel, and rays where those disagree (edges, soft shadows); for colour only: masks and
    depth are those of the pixel's centre."""
    held_out_views: int = Field(default=8, ge=0, le=MOST_FRAMES)
    """Frames from cameras that are never trained on."""
    held_out_degrees: tuple[float, ...] = ()
    """How far these cameras are turned about the scene, by turns to the left and to the right of
    the training camera of their moment; empty: they stay near the path."""
    test_frames: int = Field(default=16, ge=1)
    """Uniformly chosen (HOSNeRF's rule: 16)."""
    scene_points: int = Field(default=10_000, ge=100, le=MOST_POINTS)
    """Initial points written to the clip."""
    object_points: int = Field(default=1_500, ge=50, le=MOST_POINTS)
    """Initial points written to the clip."""
    betas: tuple[float, ...] = ()
    """Shape of the body, padded with zeros to the body's number of coefficients."""
    cloth_thickness: float = Field(default=0.010, ge=0, le=0.05)
    """Distance of clothes from the skin, metres."""
    camera: CameraConfig = CameraConfig()
    object: ObjectConfig = ObjectConfig()
    light: LightConfig = LightConfig()
    noise: NoiseConfig = NoiseConfig()

    @model_validator(mode="after")
    def _edges_take_more(self) -> SceneConfig:
        if self.edge_samples < self.samples:
            raise ValueError(
                f"edge_samples ({self.edge_samples}) is below samples ({self.samples}): edges "
                "use the samples of a pixel and more; set at least as many"
            )
        return self

    @staticmethod
    def tiny(**changes: object) -> SceneConfig:
        """A clip for tests: 12 frames at 64x64, a few held-out views, about a second."""
        small: dict[str, object] = {
            "frames": 12, "width": 64, "height": 64, "fps": 3.0, "edge_samples": 4,
            "held_out_views": 3, "test_frames": 3, "scene_points": 2_000, "object_points": 300,
        }  # fmt: skip
        return SceneConfig.model_validate({**small, **changes})

    def digest(self, *more: str) -> str:
        """A hash of every setting and of `more` (generator version, body), 16 hex digits."""
        unset = set() if self.held_out_degrees else {"held_out_degrees"}  # as before there was one
        text = "\n".join((self.model_dump_json(exclude=unset), *more))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


# the built-in clips by name: what each sets; the rest is a default of SceneConfig
CLIPS: Mapping[str, Mapping[str, Any]] = {
    "lift-and-swing": {},
    "carry": {
        "frames": 80,
        "object": {"motion": "carried", "size": (0.36, 0.30, 0.26)},
        "camera": {
            "azimuth_degrees": 0.0,
            "arc_degrees": 30.0,
            "distance": 3.7,
            "target": (0.0, 0.88, -0.1),
        },
    },
    "throw-and-catch": {"object": {"motion": "thrown"}},
    "still-box": {"object": {"motion": "static"}},
    "glide": {"object": {"motion": "gliding"}},
    "figure-eight": {"object": {"motion": "figure-eight"}},
    "bending-bar": {"object": {"motion": "bending", "size": (0.70, 0.12, 0.12)}},
    "hinged-bar": {
        "object": {
            "motion": "bending",
            "size": (0.60, 0.12, 0.12),
            "bend_share": 0.02,
            "bend_degrees": 60.0,
        }
    },
    "soft-ball": {"object": {"motion": "squeezed", "size": (0.30, 0.30, 0.30), "round": True}},
    "mirror-box": {"object": {"motion": "figure-eight", "mirror": 0.6}},
    "moving-alone": {"object": {"motion": "gliding", "alone": True}},
    "jolted-push": {"object": {"motion": "pushed", "jolt_metres": 0.03}},
}


def name_of(config: SceneConfig) -> str:
    """The name of the built-in clip whose object moves as in `config`; else that motion's."""
    motions = {
        str(settings.get("object", {}).get("motion", SceneConfig().object.motion)): name
        for name, settings in CLIPS.items()
    }
    return motions.get(config.object.motion, config.object.motion)

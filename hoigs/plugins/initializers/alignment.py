"""From the axes, unit and place of a generator to an object of the clip.

HOIGS, Sec. "Object Initialization"; the formulas are those of `hoigs.core.model.object_placement`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.initializer import training_frames
from hoigs.core.maths.nearest import nearest
from hoigs.core.model.object_placement import (
    Frames,
    Placement,
    Reading,
    Reduce,
    ScaleFit,
    fit_scale,
    locate,
    placed_track,
)
from hoigs.core.values.clip import Clip, ObjectTrack

Space = Literal["object", "camera", "world"]
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
NAMED_AXES = {"opencv": "x y z", "opengl": "x -y -z", "blender": "x -z y"}
FIT_POINTS = 20_000  # boxes around more points than this are the same
FIT_FRAMES = 64


class PlacingConfig(ComponentConfig):
    """Settings of every initializer that scales and places a shape of its own."""

    reference: int | None = Field(
        default=None, ge=0, description="frame number; default: the training frame that sees most"
    )
    center: Literal["box", "mean", "origin"] = Field(
        default="box",
        description="what of the shape stands at the track's centre: the middle of its box, the "
        "mean of its points, or its own origin; with a unit and `space` camera or world, origin "
        "leaves it where the file has it",
    )
    place: Literal["track", "depth"] = Field(
        default="track",
        description="v_t: the clip's track, or the mask's centroid at the masked depth",
    )
    rotation: Literal["track", "none"] = Field(
        default="track",
        description="R_obj of each frame: the clip's track, or none: one orientation to the camera "
        "throughout, as in the paper",
    )
    front: bool = Field(
        default=True,
        description="with place: depth, move v_t from the front to the centre; the paper: false",
    )
    smooth: bool = Field(
        default=True,
        description="with place: depth, smooth v_t over 7 frames; false for few frames a second",
    )
    scale_reduce: Reduce = Field(
        default="median", description="how the frames' ratios become one scale; the paper: mean"
    )
    scale_frames: Frames = Field(
        default="whole", description="which frames count for the scale; the paper: all"
    )
    scale_iterations: int = Field(
        default=3, ge=1, description="evaluations of the scale; the paper: 1"
    )
    scale_quantile: float = Field(
        default=0.001, ge=0, lt=0.5, description="share of outermost points left out at each side"
    )


class AlignmentConfig(PlacingConfig):
    """Settings that `initializer:points` and `initializer:mesh` share: theirs is a file of any
    origin."""

    space: Space = Field(
        default="object",
        description="whose axes the shape is in: of the clip's track of the object, of the camera "
        "of frame `reference` (generators that see one image), or of the clip's world then",
    )
    axes: str = Field(
        default="opencv",
        description="how these axes are written: right, down and forward as axes of the file, "
        'such as "x -y -z"; or a name: opencv (x y z), opengl (x -y -z), blender (x -z y)',
    )
    unit: Literal["fit", "m", "cm", "mm"] = Field(
        default="fit", description="unit of the shape; fit: make it as large as the masks (scale S)"
    )

    @field_validator("axes")
    @classmethod
    def _axes_turn(cls, text: str) -> str:
        axes_matrix(text)
        return text

    @model_validator(mode="after")
    def _fit_together(self) -> AlignmentConfig:
        if self.place == "depth" and self.unit != "fit":
            raise ValueError('place: depth finds scale and place together; it needs unit: "fit"')
        if self.unit == "fit" and self.center == "origin" and self.space == "world":
            raise ValueError(
                "space: world with center: origin declares where the shape is in metres; unit: "
                '"fit" would move it: give its unit, or another center'
            )
        return self


def axes_matrix(text: str) -> Float[Tensor, "3 3"]:
    """Axes of a file to OpenCV's (x right, y down, z forward): x_cv = C x_file.

    Args:
        text: a name of NAMED_AXES, or three signed axes of the file: "x -y -z".

    Raises:
        ValueError: no such axes, or they mirror.
    """
    words = NAMED_AXES.get(text, text).replace(",", " ").split()
    rows = []
    for word in words:
        sign, letter = (-1.0, word[1:]) if word.startswith("-") else (1.0, word.lstrip("+"))
        if letter in ("x", "y", "z"):
            rows.append([sign * float(letter == axis) for axis in "xyz"])
    if len(rows) != 3 or len(words) != 3:
        raise ValueError(
            f'axes "{text}": expected {", ".join(NAMED_AXES)}, or right, down and forward as three '
            'axes of the file, such as "x -y -z"'
        )
    matrix = torch.tensor(rows)
    determinant = round(float(torch.linalg.det(matrix)))
    if determinant != 1:
        why = "they mirror the shape; turn one sign" if determinant else "one axis stands twice"
        raise ValueError(f'axes "{text}": {why}')
    return matrix


def align(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    clip: Clip,
    entity: str,
    settings: AlignmentConfig | None = None,
    *,
    provenance: str,
) -> ObjectTrack:
    """The object that `points` are, in the axes of the clip's own track, and its poses.

    Args:
        points: in the generator's axes and unit. colors: RGB in [0, 1].

    Raises:
        ValueError: the clip has no track of the object, whose poses are needed, or no frame
            determines its scale or place.
    """
    settings = settings or AlignmentConfig()
    track = clip.objects.get(entity)
    if track is None:
        raise ValueError(f"the clip has no track of {entity}, whose rotations are needed")
    at = reference_frame(settings, clip, entity)
    metres = METRES.get(settings.unit, 1.0)
    canonical = centred(metres * points @ axes_matrix(settings.axes).mT, settings.center)
    canonical = _in_object(canonical, settings, clip, track, at)
    turns = torch.stack([c.world_to_camera[:3, :3] for c in clip.cameras]) @ track.rotations
    if settings.rotation == "none":
        turns = turns[at].expand_as(turns)
    placement = _placed(canonical, turns, settings, clip, entity, track)
    fit = placement.fit
    if settings.unit == "fit":
        counted = int(fit.counted.sum())
        provenance += f"; scale {fit.scale:.4g}, spread {fit.spread:.2g} over {counted} frames"
    made = placed_track(canonical, colors, placement, clip.cameras, turns, provenance=provenance)
    return replace(made, moving=moving_part(track, made.points))


def centred(
    points: Float[Tensor, "P 3"], center: Literal["box", "mean", "origin"]
) -> Float[Tensor, "P 3"]:
    """Points about their middle; a thousandth of strays at each side does not count for a box."""
    if center == "origin":
        return points
    if center == "mean":
        return points - points.mean(0)
    ordered, cut = points.sort(0).values, len(points) // 1000
    return points - (ordered[cut] + ordered[len(points) - 1 - cut]) / 2


def moving_part(track: ObjectTrack, points: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"] | None:
    """Which points belong to the moving part of an object in two parts: as the track's nearest."""
    if track.moving is None:
        return None
    return track.moving[nearest(points, 1, track.points)[0][:, 0]]


def most_seen(clip: Clip, entity: str) -> int:
    """The training frame with the largest mask; a mask cut by the image's border counts a quarter.

    Raises:
        ValueError: the object is seen in none.
    """
    best, size = -1, 0.0
    for i in training_frames(clip):
        mask = clip.store.mask(entity, i)
        cut = bool(mask[0].any() | mask[-1].any() | mask[:, 0].any() | mask[:, -1].any())
        area = float(mask.sum()) * (0.25 if cut else 1.0)
        if area > size:
            best, size = i, area
    if best < 0:
        raise ValueError(f"the mask of {entity} is empty in every training frame")
    return best


def reference_frame(settings: PlacingConfig, clip: Clip, entity: str) -> int:
    """The frame of `reference`.

    Raises:
        ValueError: the clip has no such frame, or the object is seen in none.
    """
    if settings.reference is None:
        return most_seen(clip, entity)
    if settings.reference >= len(clip):
        raise ValueError(f"reference {settings.reference}: the clip has {len(clip)} frames")
    return settings.reference


def _in_object(
    points: Float[Tensor, "P 3"],
    settings: AlignmentConfig,
    clip: Clip,
    track: ObjectTrack,
    at: int,
) -> Float[Tensor, "P 3"]:
    """Points of `space` in the axes of the object; where they are is kept only where it is known,
    by a unit and an origin."""
    fixed = settings.center == "origin" and settings.unit != "fit"
    if settings.space == "camera":
        view = clip.cameras[at].world_to_camera
        points = (points - view[:3, 3] if fixed else points) @ view[:3, :3]
    if settings.space != "object":
        points = (points - track.translations[at] if fixed else points) @ track.rotations[at]
    return points


def _placed(
    canonical: Float[Tensor, "P 3"],
    turns: Float[Tensor, "F 3 3"],
    settings: AlignmentConfig,
    clip: Clip,
    entity: str,
    track: ObjectTrack,
) -> Placement:
    places = zip(clip.cameras, track.translations, strict=True)
    shifts = torch.stack([camera.to_camera(place) for camera, place in places])
    if settings.unit != "fit":
        none = torch.zeros(len(clip), dtype=torch.bool)
        fit = ScaleFit(1.0, 0.0, torch.full((len(clip),), torch.nan), none)
        return Placement(fit, shifts, track.observed)
    few = canonical[:: -(-len(canonical) // FIT_POINTS)]
    reading = Reading(
        settings.scale_reduce, settings.scale_frames, settings.scale_iterations,
        settings.scale_quantile, settings.front, settings.smooth,
    )  # fmt: skip
    allowed = training_frames(clip)
    if settings.place == "depth":
        require_metric_depth(clip)
        unseen = [torch.zeros(c.height, c.width, dtype=torch.bool) for c in clip.cameras]
        masks = [clip.store.mask(entity, i) if i in allowed else m for i, m in enumerate(unseen)]
        depths = [clip.store.depth(i) if i in allowed else None for i in range(len(clip))]
        return locate(few, masks, depths, clip.cameras, turns, reading)
    chosen = allowed[:: -(-len(allowed) // FIT_FRAMES)]
    masks = [clip.store.mask(entity, i) for i in chosen]
    cameras = [clip.cameras[i] for i in chosen]
    fit = fit_scale(few, masks, cameras, shifts[chosen], turns[chosen], reading)
    return Placement(fit, shifts, track.observed)


def require_metric_depth(clip: Clip) -> None:
    """Raise ValueError when the clip's depth is not in metres."""
    if clip.depth_kind != "metric":
        raise ValueError(
            f'the clip\'s depth is "{clip.depth_kind}", and metres are needed; write metric depth '
            "into the clip, or use an initializer that does without: initializer:points, "
            "initializer:mesh, initializer:sfm"
        )


# Points that no surface passes through.


def inliers(
    points: Float[Tensor, "P 3"], neighbours: int = 16, ratio: float = 2.5
) -> Bool[Tensor, " P"]:
    """Points about as close to their nearest neighbours as those are to theirs.

    A simple form of the local outlier factor (Breunig et al. 2000). The usual rule, so many
    standard deviations over all points (Rusu et al. 2008), takes away whole sides of an object
    that few frames saw, because they are sparser; here each side is judged by its own density.
    Too few points to judge all stay.

    Args:
        ratio: largest mean distance to the neighbours, over the median of theirs.
    """
    if len(points) <= neighbours:
        return torch.ones(len(points), dtype=torch.bool)
    indices, distances = (x.numpy() for x in nearest(points, neighbours))
    spacing = distances.mean(1)
    usual = np.median(spacing[indices], axis=1)
    return torch.from_numpy(spacing <= ratio * np.maximum(usual, 1e-12))

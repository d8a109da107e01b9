"""Results of the stages as plain values and arrays, and back, to the last bit."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import ObjectTrack
from hoigs.core.lens import Lens
from hoigs.core.moment import BodyPose
from hoigs.core.undistortion import Undistortion
from hoigs.preparation.ball import BallTrack
from hoigs.preparation.camera_choice import ChosenCameras
from hoigs.preparation.cameras import CameraTrack, pinhole
from hoigs.preparation.depth import DepthFit
from hoigs.preparation.evidence import RawEvidence
from hoigs.preparation.frames import FrameList
from hoigs.preparation.landmarks import LandmarkTrack
from hoigs.preparation.masks import MaskStack
from hoigs.preparation.person import FittedBody, RawLandmarks
from hoigs.preparation.scene import ScenePoints
from hoigs.preparation.split_masks import GivenMasks
from hoigs.preparation.store import Result

Arrays = Mapping[str, np.ndarray]


def _numpy(**tensors: Tensor) -> dict[str, np.ndarray]:
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def _torch(arrays: Arrays, *names: str) -> dict[str, Tensor]:
    return {name: torch.from_numpy(arrays[name]) for name in names}


def _stack(name: str, masks: MaskStack) -> dict[str, np.ndarray]:
    return {f"{name}_bits": masks.bits, f"{name}_width": np.array(masks.width)}


def _unstack(name: str, arrays: Arrays) -> MaskStack:
    return MaskStack.from_bits(arrays[f"{name}_bits"], int(arrays[f"{name}_width"]))


def save_frames(found: FrameList) -> Result:
    return Result(asdict(found))


def load_frames(result: Result) -> FrameList:
    return FrameList(**result.values)


def save_evidence(found: RawEvidence) -> Result:
    arrays = {"image": found.landmarks.image, "world": found.landmarks.world}
    for name, stack in found.masks.named().items():
        arrays.update(_stack(name, stack))
    return Result({"masks": list(found.masks.named()), "landmarks": found.landmarks.source}, arrays)


def load_evidence(result: Result) -> RawEvidence:
    given = GivenMasks(**{n: _unstack(n, result.arrays) for n in result.values["masks"]})
    arrays = result.arrays
    return RawEvidence(
        RawLandmarks(arrays["image"], arrays["world"], result.values["landmarks"]), given
    )


MODEL = "colmap"  # a model that the cameras' stage made itself lies beside its result, by this name


def save_cameras(track: CameraTrack, *, own_model: bool = False) -> Result:
    """The track; `own_model`: with a copy of its COLMAP model, which lies in a temporary folder."""
    cameras = track.cameras
    values = {
        "provenance": track.provenance,
        "metric": track.metric,
        "size": [cameras[0].width, cameras[0].height],
        "lens": asdict(track.lens) if track.lens else None,
        "model": str(track.model) if track.model and not own_model else None,
        "own_model": own_model,
        "positions": list(track.positions),
        "figures": track.figures,
    }
    arrays = _numpy(
        K=torch.stack([c.K for c in cameras]),
        world_to_camera=torch.stack([c.world_to_camera for c in cameras]),
        points=track.points,
        colors=track.colors,
    )

    def copy_model(folder: Path) -> None:
        assert track.model is not None
        shutil.copytree(track.model, folder / MODEL)

    return Result(values, arrays, copy_model if own_model else None)


def load_cameras(result: Result) -> CameraTrack:
    values, arrays = result.values, _torch(result.arrays, "K", "world_to_camera")
    width, height = values["size"]
    model = Path(values["model"]) if values["model"] else None
    if values["own_model"]:
        assert result.folder is not None
        model = result.folder / MODEL
    lens, undistort = None, Undistortion()
    if values["lens"]:
        found = {**values["lens"], "params": tuple(values["lens"]["params"])}
        lens = Lens(**found)
        undistort = pinhole(lens, width, height)[1]
    return CameraTrack(
        [Camera(K, w, width, height) for K, w in zip(*arrays.values(), strict=True)],
        undistort,
        **_torch(result.arrays, "points", "colors"),
        provenance=values["provenance"],
        metric=values["metric"],
        lens=lens,
        model=model,
        positions=tuple(values["positions"]),
        figures=values["figures"],
    )


def save_chosen(chosen: ChosenCameras) -> Result:
    return save_cameras(chosen.track, own_model=chosen.own_model)


def load_chosen(result: Result) -> ChosenCameras:
    return ChosenCameras(load_cameras(result), result.values["own_model"])


@dataclass(frozen=True)
class Inputs:
    """The evidence on undistorted images."""

    landmarks: LandmarkTrack
    given: GivenMasks
    ball: BallTrack | None


def save_inputs(inputs: Inputs) -> Result:
    arrays = _numpy(image=inputs.landmarks.image, world=inputs.landmarks.world)
    for name, stack in inputs.given.named().items():
        arrays.update(_stack(name, stack))
    ball = inputs.ball
    if ball is not None:
        arrays.update(centers=ball.centers, radii=ball.radii, observed=ball.observed)
    jitter = ball.jitter if ball is not None else None
    return Result({"masks": list(inputs.given.named()), "ball_jitter": jitter}, arrays)


def load_inputs(result: Result) -> Inputs:
    arrays, jitter = result.arrays, result.values["ball_jitter"]
    ball = None
    if jitter is not None:
        ball = BallTrack(arrays["centers"], arrays["radii"], arrays["observed"], jitter)
    given = GivenMasks(**{n: _unstack(n, arrays) for n in result.values["masks"]})
    return Inputs(LandmarkTrack(**_torch(arrays, "image", "world")), given, ball)


_POSE = tuple(f.name for f in fields(BodyPose) if f.name != "hand_pose_convention")
_PERSON = ("scene_scale", "residual_px", "ground", "provenance", "report", "warnings")


def save_body(person: FittedBody) -> Result:
    values: dict[str, Any] = {name: getattr(person, name) for name in _PERSON}
    values["hand_pose_convention"] = person.poses.hand_pose_convention
    arrays = _numpy(
        joints=person.joints,
        residuals=person.residuals,
        **{name: getattr(person.poses, name) for name in _POSE},
    )
    return Result(values, {**arrays, "found": person.found})


def load_body(result: Result) -> FittedBody:
    values = dict(result.values)
    convention = values.pop("hand_pose_convention")
    poses = BodyPose(**_torch(result.arrays, *_POSE), hand_pose_convention=convention)
    tensors: dict[str, Any] = _torch(result.arrays, "joints", "residuals")
    return FittedBody(poses=poses, found=result.arrays["found"], **tensors, **values)


@dataclass(frozen=True)
class EntityStacks:
    """The final masks: of the person, of the object, and of pixels that show no scene."""

    human: MaskStack
    thing: MaskStack
    blank: MaskStack


def save_masks(masks: EntityStacks) -> Result:
    arrays: dict[str, np.ndarray] = {}
    for f in fields(masks):
        arrays.update(_stack(f.name, getattr(masks, f.name)))
    return Result({}, arrays)


def load_masks(result: Result) -> EntityStacks:
    return EntityStacks(**{f.name: _unstack(f.name, result.arrays) for f in fields(EntityStacks)})


_TRACK = ("points", "colors", "rotations", "translations", "observed")


def save_object(placed: tuple[ObjectTrack, float]) -> Result:
    track, spread = placed
    arrays = _numpy(**{name: getattr(track, name) for name in _TRACK})
    return Result({"provenance": track.provenance, "spread": spread}, arrays)


def load_object(result: Result) -> tuple[ObjectTrack, float]:
    tensors = _torch(result.arrays, *_TRACK)
    track = ObjectTrack(**tensors, provenance=result.values["provenance"])
    return track, result.values["spread"]


def save_scene(scene: ScenePoints) -> Result:
    arrays = _numpy(points=scene.points, colors=scene.colors)
    return Result({"provenance": scene.provenance}, arrays)


def load_scene(result: Result) -> ScenePoints:
    return ScenePoints(
        **_torch(result.arrays, "points", "colors"), provenance=result.values["provenance"]
    )


_FIT_ARRAYS, _FIT_VALUES = ("scale", "shift", "residual"), ("kind", "against", "provenance")


def save_depth(fit: DepthFit | None) -> Result:
    if fit is None:
        return Result({"fit": None})
    values = {name: getattr(fit, name) for name in _FIT_VALUES}
    return Result({"fit": values}, {name: getattr(fit, name) for name in _FIT_ARRAYS})


def load_depth(result: Result) -> DepthFit | None:
    if result.values["fit"] is None:
        return None
    arrays: dict[str, Any] = {name: result.arrays[name] for name in _FIT_ARRAYS}
    return DepthFit(**result.values["fit"], **arrays)

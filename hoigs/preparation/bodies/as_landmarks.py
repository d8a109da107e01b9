"""Landmarks of a body that another program has fitted, on hoigs' own body in the same pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from hoigs.core.interfaces.body import PELVIS, BodyModel
from hoigs.core.interfaces.estimator import Estimates, Estimator, Landmarks, VideoRequest
from hoigs.core.maths.skinning import skin
from hoigs.core.progress import Progress, no_progress
from hoigs.core.values.moment import BodyPose
from hoigs.preparation.bodies.body_file import read_bodies
from hoigs.preparation.bodies.file_body import FileBody
from hoigs.preparation.body.landmarks import points_of
from hoigs.preparation.video.source import SourceError

HIPS = (23, 24)  # landmarks
OUTSIDE = 0.2  # visibility beyond the picture, where the program has guessed


class BodyFileEstimator(Estimator):
    """The points of the posed body that stand for MediaPipe's landmarks.

    Args:
        path: of the file. body: in its mean shape.
    """

    provides = frozenset({"landmarks"})

    def __init__(self, path: Path, body: BodyModel) -> None:
        self.path, self.body = path, body

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        found = read_bodies(self.path)
        if found.frames[-1] >= video.frames:
            raise SourceError(
                f"{self.path} has frame {found.frames[-1]}, the video {video.frames} frames: run "
                f"{found.program} on this video"
            )
        marks = list(points_of(self.body).landmarks)
        places = _places(self.body, found)
        K = found.K(video.width, video.height)
        seen = np.einsum("nij,nlj->nli", K, places)
        pixels = seen[..., :2] / seen[..., 2:].clip(1e-3)
        inside = ((pixels >= 0) & (pixels < (video.width, video.height))).all(-1)
        visible = np.where(inside, 1.0, OUTSIDE)[..., None]
        middle = places[:, [marks.index(hip) for hip in HIPS]].mean(1, keepdims=True)
        depth = (places - middle)[..., 2:] * (K[:, :1, :1] / middle[..., 2:])
        image = np.full((video.frames, 33, 4), np.nan, np.float32)
        world = image.copy()
        rows = np.ix_(found.frames, np.array(marks))
        image[rows] = np.concatenate((pixels, depth, visible), -1)
        world[rows] = np.concatenate((places - middle, visible), -1)
        (name,) = video.named("human") or ("human",)
        progress(1.0, "bodies")
        return Estimates(landmarks={name: Landmarks(image, world, found.program)})


def _places(body: BodyModel, found: FileBody) -> Float[np.ndarray, "N L 3"]:
    """Of landmarks on the posed body, along the camera's axes, metres."""
    points = points_of(body)
    vertices, joints = body.shaped(torch.zeros(body.num_betas))
    turns = torch.from_numpy(found.turns).float()
    pose = BodyPose.zeros(len(turns), betas=body.num_betas).replace(
        global_orient=turns[:, 0],
        body=turns[:, 1:],
        transl=torch.from_numpy(found.pelvis).float() - joints[PELVIS],
    )
    bound = torch.cat(
        (torch.eye(len(joints))[points.joints], body.skinning_weights[points.vertices])
    )
    rest = torch.cat((joints[points.joints], vertices[points.vertices]))
    return skin(rest, body.skinning_transforms(pose), bound).double().numpy()

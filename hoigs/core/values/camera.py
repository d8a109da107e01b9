"""Camera with OpenCV axes: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.errors import CameraError
from hoigs.core.maths.optics import Optics, world_points_on_image
from hoigs.core.maths.rotations import exp_se3, quats_to_matrices

ROTATION_TOLERANCE = 1e-3  # of R R^T - I: generous to float16 and to files of few digits
ROW_TOLERANCE = 1e-5  # of the last rows of K and pose
SKEW_TOLERANCE = 0.01  # pixels: what a clip's file may have, at ten times its size


def pinhole_pixels(
    K: Float[Tensor, "*#batch 3 3"], points: Float[Tensor, "*#batch 3"], near: float | None = None
) -> Float[Tensor, "*batch 2"]:
    """Pixels (x, y) of points in camera coordinates; differentiable.

    Args:
        K: intrinsics, of one camera or of one for each point. points: metres, or any one unit.
        near: a depth in front of the camera; nearer points are divided by it in place of their
            own depth. None divides by every depth, also behind the camera, but not by zero.
    """
    depth = points[..., 2:]
    if near is None:
        depth = torch.where(depth.abs() < 1e-8, torch.full_like(depth, 1e-8), depth)
    else:
        depth = depth.clamp_min(near)
    focal = torch.stack((K[..., 0, 0], K[..., 1, 1]), -1)
    return points[..., :2] / depth * focal + K[..., :2, 2]


def pinhole_rays(
    K: Float[Tensor, "*#batch 3 3"], pixels: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*batch 2"]:
    """x and y of the points in camera coordinates that pixels show at depth z = 1."""
    focal = torch.stack((K[..., 0, 0], K[..., 1, 1]), -1)
    return (pixels - K[..., :2, 2]) / focal


@dataclass(frozen=True)
class Camera:
    """One view: of a pinhole with a global shutter, unless it has `optics`.

    Attributes:
        K: intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels; the centre of the top-left
            pixel is at (0.5, 0.5).
        world_to_camera: rigid transform x_cam = R x_world + t, metres ("viewmat").
        width, height: image size, pixels.
        optics: fisheye, orthographic, distorted, or with a rolling shutter; None for a pinhole.
            Rasterizers declare what they draw of them (`Capabilities.optics`), and `project`
            obeys them; all that goes from pixels to the world is for pinholes.

    Raises:
        CameraError: broken values, see `check`. Those of tensors on a GPU, which would have to be
            waited for, and of tensors that require a gradient are not looked at: call `check`.
    """

    K: Float[Tensor, "3 3"]
    world_to_camera: Float[Tensor, "4 4"]
    width: int
    height: int
    optics: Optics | None = None

    def __post_init__(self) -> None:
        self._check(wait=False)

    def check(self) -> None:
        """Check the values on every device.

        Raises:
            CameraError: K or world_to_camera is of another shape or not finite, K has skew, a focal
                length of 0 or less or another last row, or world_to_camera is not rigid.
        """
        self._check(wait=True)

    def _check(self, wait: bool) -> None:
        checked = [
            ("K", self.K, 3, _intrinsics_problem),
            ("world_to_camera", self.world_to_camera, 4, _pose_problem),
        ]
        if self.optics is not None and self.optics.last_world_to_camera is not None:
            last = self.optics.last_world_to_camera
            checked.append(("optics.last_world_to_camera", last, 4, _pose_problem))
        for name, value, size, problem in checked:
            if not isinstance(value, Tensor) or value.shape != (size, size):
                shape = list(getattr(value, "shape", ()))
                raise CameraError(
                    f"Camera.{name} is a {type(value).__name__} of shape {shape}, expected a torch "
                    f"tensor of shape [{size}, {size}]"
                )
            if wait or (value.device.type == "cpu" and not value.requires_grad):
                found = _not_finite(value.tolist()) or problem(value.tolist())
                if found is not None:
                    raise CameraError(f"Camera.{name}{found}")

    @property
    def center(self) -> Float[Tensor, " 3"]:
        """Camera centre in the world, metres; see `middle` for a rolling shutter."""
        rotation, shift = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.mT @ shift

    @property
    def middle(self) -> Camera:
        """The camera in the middle of its exposure; itself, with a global shutter."""
        if self.optics is None or self.optics.last_world_to_camera is None:
            return self
        pose, _ = self.optics.middle(self.world_to_camera)
        still = replace(self.optics, shutter="global", last_world_to_camera=None)
        return replace(self, world_to_camera=pose, optics=still)

    @property
    def focal(self) -> Float[Tensor, " 2"]:
        """Focal lengths fx and fy, pixels."""
        return torch.stack((self.K[0, 0], self.K[1, 1]))

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        return replace(
            self,
            K=self.K.to(*args, **kwargs),
            world_to_camera=self.world_to_camera.to(*args, **kwargs),
            optics=self._mapped_optics(lambda pose: pose.to(*args, **kwargs)),
        )

    def _mapped_optics(self, change: Callable[[Tensor], Tensor]) -> Optics | None:
        return None if self.optics is None else self.optics.map_pose(change)

    def need_pinhole(self, what: str) -> None:
        """For code that knows K and the pose only.

        Raises:
            CameraError: the camera has optics; says that `what` is for pinholes.
        """
        if self.optics is not None:
            raise CameraError(
                f"{what} is for pinholes, and this camera has {self.optics}; undistort its images, "
                "or leave `optics` out"
            )

    def to_camera(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World points in camera coordinates, metres."""
        return points @ self.world_to_camera[:3, :3].mT + self.world_to_camera[:3, 3]

    def to_world(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points in camera coordinates in the world, metres."""
        return (points - self.world_to_camera[:3, 3]) @ self.world_to_camera[:3, :3]

    def project(
        self, points: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Pixels (x, y) and depth in metres of world points; depth may be negative (behind).

        With optics, pixels are NaN where a point has no place, see `hoigs.core.maths.optics`.
        """
        if self.optics is not None:
            pose, motion = self.optics.middle(self.world_to_camera)
            size = (self.width, self.height)
            places, seen, _ = world_points_on_image(points, pose, motion, self.K, size, self.optics)
            depth = points @ pose[2, :3] + pose[2, 3]
            return torch.where(seen[..., None], places, torch.nan), depth
        cam = self.to_camera(points)
        return pinhole_pixels(self.K, cam), cam[..., 2]

    def shows(
        self, pixels: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"], near: float = 0.0
    ) -> Bool[Tensor, "*batch"]:
        """Which projected points lie within the image and farther than `near`, metres."""
        size = pixels.new_tensor((self.width, self.height))
        return (depth > near) & (pixels >= 0).all(-1) & (pixels < size).all(-1)

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """World points at pixels (x, y) and depths along z, metres."""
        self.need_pinhole("Camera.unproject")
        xy = pinhole_rays(self.K, pixels) * depth[..., None]
        return self.to_world(torch.cat((xy, depth[..., None]), -1))

    def pixel_grid(self) -> Float[Tensor, "H W 2"]:
        """Centres (x, y) of all pixels."""
        y = torch.arange(self.height, device=self.K.device, dtype=self.K.dtype) + 0.5
        x = torch.arange(self.width, device=self.K.device, dtype=self.K.dtype) + 0.5
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)

    def rays(self) -> Float[Tensor, "H W 3"]:
        """Unit directions in the world of what all pixels show, from `center`."""
        self.need_pinhole("Camera.rays")
        xy = pinhole_rays(self.K, self.pixel_grid())
        directions = (
            torch.cat((xy, torch.ones_like(xy[..., :1])), -1) @ self.world_to_camera[:3, :3]
        )
        return directions / directions.norm(dim=-1, keepdim=True)

    def moved(self, turn: Float[Tensor, " 3"], shift: Float[Tensor, " 3"]) -> Camera:
        """The camera after a rigid motion in its own space: x_cam = Exp(turn, shift) (R x + t).

        A turn alone is about the camera's centre. Differentiable, and smooth at zero.

        Args:
            turn: axis-angle, radians. shift: metres.
        """
        quat, moved = exp_se3(turn, shift)
        R: Float[Tensor, "3 3"] = quats_to_matrices(quat)

        def after(given: Tensor) -> Tensor:
            top = torch.cat((R @ given[:3, :3], (R @ given[:3, 3] + moved)[:, None]), 1)
            return torch.cat((top, given[3:]), 0)

        pose = after(self.world_to_camera)
        return replace(self, world_to_camera=pose, optics=self._mapped_optics(after))

    def scaled(self, scale: float) -> Camera:
        """The same view of a world made `scale` times larger."""
        K = self.K
        if self.optics is not None and self.optics.model == "ortho":  # pixels per metre
            K = K / K.new_tensor([[scale, scale, 1.0], [scale, scale, 1.0], [1.0, 1.0, 1.0]])

        def after(given: Tensor) -> Tensor:
            pose = given.clone()
            pose[:3, 3] *= scale
            return pose

        pose = after(self.world_to_camera)
        return replace(self, K=K, world_to_camera=pose, optics=self._mapped_optics(after))

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size."""
        scale = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return replace(self, K=self.K * scale, width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The part of the image that starts at pixel (left, top).

        Raises:
            CameraError: it has a rolling shutter, whose rows are those of the whole image.
        """
        if self.optics is not None and self.optics.shutter != "global":
            raise CameraError("Camera.cropped: a rolling shutter's rows are the whole image's")
        shift = self.K.new_tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
        return replace(self, K=self.K - shift, width=width, height=height)

    @staticmethod
    def look_at(
        eye: Float[Tensor, " 3"],
        target: Float[Tensor, " 3"],
        *,
        width: int,
        height: int,
        fov_y: float,
        up: tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> Camera:
        """A camera at `eye` that looks at `target`; `fov_y` is the vertical angle in radians.

        Raises:
            ValueError: it would look along `up`, or at its own place, so that no upright is left.
        """
        forward = torch.nn.functional.normalize(target - eye, dim=0)
        down = -torch.tensor(up, dtype=eye.dtype, device=eye.device)
        right = torch.linalg.cross(down, forward)
        if not right.norm() > 1e-6 * down.norm():
            raise ValueError(
                f"a camera at {eye.tolist()} that looks at {target.tolist()} has no upright: "
                f"the view is along up = {up}; give another `up`"
            )
        right = torch.nn.functional.normalize(right, dim=0)
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
        viewmat = torch.eye(4, dtype=eye.dtype, device=eye.device)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ eye
        focal = 0.5 * height / float(torch.tan(torch.tensor(fov_y / 2)))
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(K.to(viewmat), viewmat, width, height)


# What is wrong with 3x3 intrinsics or a 4x4 pose, after its name, or None. In plain Python: a tenth
# of the time that torch takes for so few numbers.


def _not_finite(rows: list[list[float]]) -> str | None:
    for i, row in enumerate(rows):
        for j, x in enumerate(row):
            if not math.isfinite(x):
                return f"[{i}, {j}] is {x}, expected a finite number"
    return None


def _intrinsics_problem(K: list[list[float]]) -> str | None:
    (fx, skew, _), (shear, fy, _), last = K
    if not (fx > 0 and fy > 0):
        return f" has focal lengths of {fx:g} and {fy:g} pixels, expected more than 0"
    if abs(skew) > SKEW_TOLERANCE or abs(shear) > SKEW_TOLERANCE:
        i, j = (0, 1) if abs(skew) > SKEW_TOLERANCE else (1, 0)
        return (
            f"[{i}, {j}] is {K[i][j]:g}, expected 0: pixels are not skewed here; rectify the images"
        )
    if any(abs(x - y) > ROW_TOLERANCE for x, y in zip(last, (0, 0, 1))):
        return f"[2] is {last}, expected [0, 0, 1]; divide K by K[2, 2]"
    return None


def _pose_problem(pose: list[list[float]]) -> str | None:
    a, b, c = R = [row[:3] for row in pose[:3]]
    off = max(
        abs(sum(x * y for x, y in zip(R[i], R[j])) - (i == j))
        for i in range(3)
        for j in range(i, 3)
    )
    mirrored = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        - a[1] * (b[0] * c[2] - b[2] * c[0])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    ) < 0
    if off > ROTATION_TOLERANCE:
        return (
            "[:3, :3] is no rotation, but scaled or sheared: the largest |R R^T - I| is "
            f"{off:.3g}, at most {ROTATION_TOLERANCE:g} is rounding; see Camera.scaled for a scale"
        )
    if mirrored:
        return "[:3, :3] mirrors: its determinant is -1, expected +1"
    if any(abs(x - y) > ROW_TOLERANCE for x, y in zip(pose[3], (0, 0, 0, 1))):
        return f"[3] is {pose[3]}, expected [0, 0, 0, 1]"
    return None

"""objective:tracks, the loss on 2D point tracks of Shape of Motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import grid_sample

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.objective import Objective, TrainingMoment
from hoigs.core.system.npz import load_arrays
from hoigs.core.values.camera import pinhole_pixels
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment

OPAQUE = 0.5  # alpha below which a pixel shows no place


class TracksConfig(ComponentConfig):
    path: Path
    """An .npz file: `xy` [F, P, 2], pixels (x, y) of P points in all F frames of the video,
    (0, 0) the corner of the picture;
    `visible` bool [F, P]; `size` [2], width and height of the images in which they were tracked."""
    span: int = Field(default=16, ge=1)
    """Frames by which the two frames that are compared are apart, at most."""


class Tracks(Objective):
    """Points that are seen at one time in one pixel are seen at another time in another.

    The 3D places of the Gaussians at time t' are drawn into the picture of time t, where the pixel
    of a track then has the place w_t'(p) that its point has at t'; projected by the camera of t',
    it is compared with the track there (Wang et al. 2024, arXiv:2407.13764, eq. 6 and 8):

        L = mean_p |project_t'(w_t'(p)) - xy_t'(p)|_1 / max(W, H)

    Raises:
        ClipError: the file cannot be read, or is of another video.
    """

    Config = TracksConfig

    def __init__(self, config: TracksConfig, clip: Clip) -> None:
        self.config, self.cameras = config, clip.cameras
        self.moments = clip.moments
        xy, visible, size = _read(config.path)
        frames = max(moment.index for moment in clip.moments) + 1
        if len(xy) < frames:
            raise ClipError(f"{config.path}: tracks of {len(xy)} frames, the clip has {frames}")
        self.xy, self.visible, self.size = xy, visible, size
        self.positions = [
            p for p in clip.split["train"] if bool(visible[clip.moments[p].index].any())
        ]

    @classmethod
    def from_config(cls, config: TracksConfig, context: BuildContext) -> Tracks:
        if context.clip is None:
            raise HoigsError("objective:tracks needs a clip")
        return cls(config, context.clip)

    def channels(self, at: TrainingMoment) -> Float[Tensor, "N 3"] | None:
        here = at.frame.moment.index
        near = [
            p for p in self.positions
            if p != at.frame.position and abs(self.moments[p].index - here) <= self.config.span
        ]  # fmt: skip
        self.other: int | None = None
        if not near:
            return None
        self.other = near[int(torch.randint(len(near), (), generator=at.generator))]
        then: Moment = self.moments[self.other].to(at.camera.K.device)
        return at.model(then).joined().means

    def terms(
        self, at: TrainingMoment, drawn: RenderOutput, channels: Float[Tensor, "H W 3"] | None
    ) -> Mapping[str, Float[Tensor, ""]]:
        if channels is None or self.other is None:
            return {}
        here, then = at.frame.moment.index, self.moments[self.other].index
        camera, other = at.camera, self.cameras[self.other].to(at.camera.K.device)
        scale = torch.tensor([camera.width, camera.height]) / self.size
        start, end = (self.xy[frame] * scale for frame in (here, then))
        size = start.new_tensor([camera.width, camera.height])
        used = self.visible[here] & self.visible[then] & ((start >= 0) & (start < size)).all(-1)
        if not used.any():
            return {}
        start, end = (x[used].to(channels.device) for x in (2 * start / size - 1, end))
        maps = torch.cat((channels, drawn.alpha[..., None]), -1).permute(2, 0, 1)[None]
        # between the centres of pixels, so that a track of half a pixel counts
        seen = grid_sample(maps, start[None, None], padding_mode="border", align_corners=False)
        *place, alpha = seen[0, :, 0]
        place = torch.stack(place, -1) / alpha.clamp_min(OPAQUE)[:, None]
        places = other.to_camera(place)
        counted = (alpha > OPAQUE) & (places[:, 2] > 0)
        if not counted.any():
            return {}
        pixels = pinhole_pixels(other.K, places[counted])
        missed = (pixels - end[counted]).abs().sum(-1) / max(camera.width, camera.height)
        return {"reprojection": missed.mean()}


def _read(path: Path) -> tuple[Float[Tensor, "F P 2"], Bool[Tensor, "F P"], Float[Tensor, " 2"]]:
    try:
        data = load_arrays(path)
        xy, visible, size = (torch.from_numpy(data[key]) for key in ("xy", "visible", "size"))
    except (OSError, KeyError, ValueError) as error:
        raise ClipError(
            f"{path} cannot be read as tracks ({error}): expected xy [F, P, 2], visible [F, P] and "
            "size [2]"
        ) from error
    if xy.dim() != 3 or xy.shape[2] != 2 or visible.shape != xy.shape[:2] or size.numel() != 2:
        raise ClipError(
            f"{path}: xy {list(xy.shape)}, visible {list(visible.shape)} and size "
            f"{list(size.shape)}; expected [F, P, 2], [F, P] and [2]"
        )
    seen = visible.bool() & xy.isfinite().all(-1)
    return xy.nan_to_num().float(), seen, size.float()

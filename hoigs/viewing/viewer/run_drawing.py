"""RunDrawing: a run drawn at any frame number from any camera, in any of the viewer's modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.values.between import moment_between
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.core.values.moment import Moment
from hoigs.evaluation.report.media import (
    depth_picture,
    depth_range,
    error_picture,
    false_color,
    picture,
)
from hoigs.runs.loaded_run import LoadedRun
from hoigs.viewing.playback import Playback
from hoigs.viewing.viewer.panes import covered, source_frame

Mode = Literal["colour", "depth", "alpha", "entity", "velocity", "error to the video"]
MODES: tuple[str, ...] = get_args(Mode)
FAR = 160.0  # metres, where nothing is: viser stores depths up to 167
SPEED_STEP = 0.25  # frames before and after, between which a speed is measured
SCENE = (0.55, 0.57, 0.60)  # colour of the scene in mode "entity", and of the others
PALETTE = (
    (0.96, 0.62, 0.26), (0.26, 0.65, 0.96), (0.52, 0.80, 0.36), (0.83, 0.42, 0.82),
    (0.93, 0.35, 0.38), (0.35, 0.84, 0.80),
)  # fmt: skip


@dataclass(frozen=True)
class Look:
    """What a picture shows.

    Attributes:
        mode: one of MODES. entities: those drawn. interaction: whether the interaction module
            corrects them. background: RGB in [0, 1].
    """

    mode: str = "colour"
    entities: frozenset[str] = frozenset()
    interaction: bool = True
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Picture:
    """A drawn picture. depth: metres along z, FAR where nothing is; None where not requested."""

    image: UInt8[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"] | None = None


class Drawing(Protocol):
    """What the viewer shows: a run, or a clip before training."""

    clip: Clip
    names: list[str]
    title: str
    has_interaction: bool

    @property
    def modes(self) -> tuple[str, ...]: ...

    @property
    def anywhere(self) -> bool: ...

    def draw(self, frame: float, camera: Camera, look: Look, depth: bool = False) -> Picture: ...


class RunDrawing:
    """Draws one run. Only one thread may use it.

    The Gaussians of the last frame number are kept: while only the camera moves, drawing costs the
    rasterizer alone.

    Attributes:
        modes: of `Look`. anywhere: whether it draws from any camera. names: of the entities.
        title: one line of Markdown.
    """

    modes = MODES
    anywhere = True

    def __init__(self, loaded: LoadedRun) -> None:
        self.loaded, self.clip = loaded, loaded.clip
        self.names: list[str] = list(loaded.model.entities)
        self.title = f"**{loaded.spec.name}** on {loaded.clip.name}, step {loaded.step}"
        self.has_interaction = loaded.model.interaction is not None
        self._playbacks: dict[bool, Playback] = {}
        self._kept: tuple[tuple[float, bool], Gaussians] | None = None
        self._span: tuple[float, float] | None = None
        self._top_speed: float | None = None

    @torch.no_grad()
    def draw(self, frame: float, camera: Camera, look: Look, depth: bool = False) -> Picture:
        """One picture.

        Args:
            frame: number, between frames a fraction. depth: whether the depth is returned too.
        """
        output = self._render(frame, camera, look)
        image = self._image(output, look, frame, camera)
        return Picture(image, _far(output) if depth else None)

    @torch.no_grad()
    def gaussians(self, frame: float, interaction: bool = True) -> Gaussians:
        """All entities at a frame number, raw, in the world; the next call may overwrite them."""
        key = (frame, interaction or not self.has_interaction)
        if self._kept is None or self._kept[0] != key:
            self._kept = (key, self._deformed(moment_between(self.clip, frame), key[1]))
        return self._kept[1]

    def rows(self) -> dict[str, slice]:
        """Rows of each entity in `gaussians`."""
        return self.loaded.model.rows()

    def top_speed(self) -> float:
        """The speed that is drawn brightest, metres a second: percentile 99 of what moves."""
        if self._top_speed is None:
            frames = np.linspace(0, self.clip.num_frames - 1, 5).tolist()
            speeds = torch.cat([self._speeds(frame, True) for frame in frames])
            moving = speeds[speeds > 0.02]
            some = moving[:: len(moving) // 100_000 + 1]
            self._top_speed = float(torch.quantile(some, 0.99)) if len(some) else 1.0
        return self._top_speed

    def _render(self, frame: float, camera: Camera, look: Look) -> RenderOutput:
        colors = None
        if look.mode == "velocity":  # before the Gaussians, which it overwrites
            share = self._speeds(frame, look.interaction) / self.top_speed()
            bytes_ = false_color(share[:, None], "turbo")[:, 0]
            colors = torch.as_tensor(bytes_).to(share) / 255.0
        gaussians = self.gaussians(frame, look.interaction)
        if look.mode == "entity":
            colors = self._entity_colors(gaussians)
        if colors is not None:
            gaussians = replace(gaussians, sh=((colors - 0.5) / SH_C0)[:, None])
        shown = [rows for name, rows in self.rows().items() if name in look.entities]
        if len(shown) < len(self.names):
            parts = [gaussians[rows] for rows in shown]
            gaussians = Gaussians.cat(parts) if parts else gaussians[:0]
        plain = look.mode in ("depth", "alpha")
        background = None if plain else gaussians.means.new_tensor(look.background)
        request = RenderRequest(background=background)
        device = self.loaded.model.device
        if colors is not None or plain:
            return self.loaded.model.rasterize(gaussians, camera.to(device), request)
        moment = moment_between(self.clip, frame).to(device)
        return self.loaded.model.draw(gaussians, camera.to(device), request, moment)

    def _image(
        self, output: RenderOutput, look: Look, frame: float, camera: Camera
    ) -> UInt8[np.ndarray, "H W 3"]:
        if look.mode == "alpha":
            return picture(output.alpha[..., None].expand(-1, -1, 3))
        if look.mode == "depth":
            if self._span is None:
                self._span = depth_range(output)
            return depth_picture(output, self._span)
        if look.mode == "error to the video":
            source = torch.from_numpy(source_frame(self.clip, frame, camera)).float() / 255.0
            wrong = error_picture(output.color, source)
            wrong[~covered(self.clip, camera)] = 0  # around the frame there is no error
            return wrong
        return picture(output.color)

    def _deformed(self, moment: Moment, interaction: bool) -> Gaussians:
        playback = self._playback(interaction)
        if playback.mode == "plain":
            model, device = self.loaded.model, self.loaded.model.device
            with model.interacting(interaction):
                return model(moment.to(device)).joined()
        return playback.deform(moment, self.clip.cameras[0])

    def _playback(self, interaction: bool) -> Playback:
        if interaction not in self._playbacks:
            clip, model = self.clip, self.loaded.model
            # small, as Playback draws them once and only its Gaussians are used here
            small = clip.cameras[0].resized(64, 64)
            views = [(clip.moments[0], small), (clip.moments[-1], small)]
            with model.interacting(interaction):
                self._playbacks[interaction] = Playback(model, views)
        return self._playbacks[interaction]

    def _entity_colors(self, like: Gaussians) -> Float[Tensor, "N 3"]:
        colors = like.means.new_zeros(len(like), 3)
        chosen = entity_colors(self.names)
        for name, rows in self.rows().items():
            colors[rows] = colors.new_tensor(chosen[name])
        # a little of each Gaussian's own brightness, so that shapes stay visible
        own = like.colors.clamp(0, 1).mean(-1, keepdim=True)
        return colors * (0.55 + 0.6 * own)

    def _speeds(self, frame: float, interaction: bool) -> Float[Tensor, " N"]:
        """Speed of each Gaussian, metres a second, by central differences."""
        last = self.clip.num_frames - 1
        low, high = max(frame - SPEED_STEP, 0.0), min(frame + SPEED_STEP, last)
        if high <= low:
            return torch.zeros(len(self.gaussians(frame, interaction)))
        before = self._deformed(moment_between(self.clip, low), interaction).means.clone()
        after = self._deformed(moment_between(self.clip, high), interaction).means
        speeds = (after - before).norm(dim=-1) * (self.clip.fps / (high - low))
        self._kept = None  # its tensors were overwritten
        return speeds


def entity_colors(names: Sequence[str]) -> dict[str, tuple[float, float, float]]:
    """A colour for each entity, RGB in [0, 1]; the scene's is grey."""
    moving = [name for name in names if name != "scene"]
    return {n: SCENE if n == "scene" else PALETTE[moving.index(n) % len(PALETTE)] for n in names}


def _far(output: RenderOutput) -> Float[np.ndarray, "H W"]:
    """Depth in metres as viser composites it: FAR where the picture is more than half empty."""
    return torch.where(output.alpha > 0.5, output.expected_depth, FAR).float().cpu().numpy()


# Resolution: how many pixels are drawn while the picture moves, so that each fits its time.

Size = tuple[int, int]
BUDGET_S = 0.07  # drawing and encoding of a moving picture: about 14 a second
SMALLEST = 128  # pixels of width
STEP = 16  # widths are multiples, so that a steady view keeps its size


class Resolution:
    """The image size for a canvas, from the time that earlier pictures took.

    Args:
        widest: pixels of width of a still picture at most. budget_s: seconds for a moving one.
    """

    def __init__(self, widest: int = 1280, budget_s: float = BUDGET_S) -> None:
        self.widest, self.budget_s = widest, budget_s
        self._width = 320.0

    def size(self, canvas: Size, moving: bool) -> Size:
        """Width and height in pixels with the aspect of the canvas."""
        full = min(canvas[0], self.widest)
        width = min(full, max(SMALLEST, round(self._width / STEP) * STEP)) if moving else full
        return max(1, width), max(1, round(width * canvas[1] / canvas[0]))

    def took(self, seconds: float) -> None:
        """Learn from one moving picture; times within a seventh of the budget change nothing."""
        share = self.budget_s / max(seconds, 1e-4)
        if not 0.87 < share < 1.15:
            self._width *= min(max(share**0.5, 0.7), 1.3)
        self._width = min(max(self._width, SMALLEST), self.widest)

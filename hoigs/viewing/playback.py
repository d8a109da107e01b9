"""Playback: a trained model rendered at any moment from any camera, by CUDA graphs."""

from __future__ import annotations

import copy
import warnings
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from hoigs.core.errors import PluginError, RenderError
from hoigs.core.fast.graphs import capturing
from hoigs.core.fast.streams import side_by_side
from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment, MomentLayout

Mode = Literal["auto", "graph", "cached", "plain"]

AHEAD = 6  # frames of a film that are deformed at the same time
TOLERANCE = 1e-4  # of each value of a Gaussian (metres, logits, …), relative to the largest


@dataclass
class _Lane:
    """One frame on its way: its input, its Gaussians, and on CUDA the graphs that make them.

    Attributes:
        packed: time, poses and camera. joined: all Gaussians. graphs: of `_deform` and `_draw`.
        output: of the second. stream: of the first; None in the lane of single frames.
        deformed, drawn: when the graphs are done.
    """

    packed: Tensor
    joined: Gaussians
    graphs: tuple[Any, Any] | None = None
    output: RenderOutput | None = None
    stream: Any = None
    deformed: Any = None
    drawn: Any = None


class Playback:
    """Renders as `SceneModel.render` does, without gradients and with less time in Python.

        play = Playback(model, views=[(clip.moments[p], clip.cameras[p]) for p in (0, 20, 40)])
        for moment, camera in film:
            image = play(moment, camera).color  # valid until the next call

        for output in play.film(film):  # the same; on CUDA several frames are under way at once
            image = output.color

    What depends on neither time nor pose is computed once (`DeformationModel.hold`), and Gaussians
    that never move are joined once. Time, poses and camera are copied into one buffer on the
    device, and CUDA graphs compute the rest, from features to image. The time may be any in [0, 1]:
    components receive it as a 0-d tensor on the device. (A table of deformed Gaussians with a row
    per frame would be simpler, but has no times between frames.)

    The model is copied, so later training has no effect, unless `copied` is False. Body shapes
    (`betas`) and hand conventions are constants of the graphs; a moment with others captures new
    graphs, which takes a while.

    Args:
        model: composed and trained. views: at least one moment and camera, all of the image size to
            be rendered, spread over later calls so that buffers are large enough.
        only: names of entities to draw; all by default.
        request: further rules; its tensors have a row for each Gaussian of `only`.
        mode: "graph" replays CUDA graphs; "cached" does the same work without them; "plain" calls
            `SceneModel.render`. "auto" is "graph" on CUDA and "cached" elsewhere, or "plain", with
            a warning, if that fails (a component that reads the time as a number cannot be
            captured). Both are compared with the plain mode at two times before use.
        copied: False takes the model itself, which nothing else may use then, with less memory.

    Attributes:
        mode: in use. reason: why this mode. captures: how often graphs were captured.

    Raises:
        RenderError: the given mode does not work here, or its Gaussians differ from plain ones.
    """

    def __init__(
        self,
        model: SceneModel,
        views: Sequence[tuple[Moment, Camera]],
        *,
        only: Iterable[str] | None = None,
        request: RenderRequest | None = None,
        mode: Mode = "auto",
        copied: bool = True,
    ) -> None:
        if not views:
            raise RenderError("Playback: views is empty, expected a moment and a camera or more")
        sizes = {(camera.width, camera.height) for _, camera in views}
        if len(sizes) > 1:
            raise RenderError(f"Playback: views of sizes {sorted(sizes)}, expected one size")
        training = model.training
        model.eval()
        self._model = (copy.deepcopy(model) if copied else model).requires_grad_(False)
        if copied:
            model.train(training)
        self._names = [n for n in model.entities if only is None or n in set(only)]
        self._request = request or RenderRequest()
        self._views, self._size = list(views), sizes.pop()
        self._device = model.device
        self._requested: Mode = mode
        self.mode: Mode = "plain"
        self.reason, self.captures = "requested", 0
        if mode != "plain":
            self._prepare(views[0][0])

    @torch.no_grad()
    def __call__(self, moment: Moment, camera: Camera) -> RenderOutput:
        """Render one frame; the next call overwrites the output.

        Moments and cameras should be on the CPU, as reading them from the device waits for it.

        Raises:
            RenderError: a camera of another size, or a moment without a pose that is needed.
        """
        self._require_size(camera)
        if self.mode == "plain":
            return self._plain(moment, camera)
        self.deform(moment, camera)
        return self.draw()

    @torch.no_grad()
    def deform(self, moment: Moment, camera: Camera) -> Gaussians:
        """The first half of a call, for timing: the Gaussians at a moment.

        Raises:
            RenderError: as a call, or the mode is "plain", which has no halves.
        """
        self._has_halves()
        if not self._fits(moment):
            self._set_up(moment)
        lane = self._lane
        # not pinned: CUDA has copied it when this returns, so it may be freed
        lane.packed.copy_(self._pack(moment, camera), non_blocking=True)
        if lane.graphs is not None:
            lane.graphs[0].replay()
        else:
            self._deform(lane)
        return lane.joined

    @torch.no_grad()
    def draw(self) -> RenderOutput:
        """The second half of a call: the image of the last `deform`."""
        self._has_halves()
        return self._drawn(self._lane)

    @torch.no_grad()
    def film(
        self, views: Iterable[tuple[Moment, Camera]], ahead: int = AHEAD
    ) -> Iterator[RenderOutput]:
        """Draw views in their order, with more frames a second than by single calls.

        A frame is many small kernels, each of which waits for the one before. So on CUDA the
        Gaussians of so many frames are computed side by side, each in memory of its own, while
        one is drawn; a frame comes as long after its view was taken. Elsewhere this calls for each
        view. The first film captures graphs for each of them, which takes some seconds and as much
        memory again. One film at a time, and no other call before it ends.

        Args:
            ahead: frames that are under way at once.

        Yields:
            The output of each view, valid until the next one is asked for.

        Raises:
            RenderError: as a call, or `ahead` is less than one.
        """
        if ahead < 1:
            raise RenderError(f"Playback.film: ahead is {ahead}, expected 1 frame or more")
        under_way: deque[_Lane] = deque()
        lanes: list[_Lane] = []
        for place, (moment, camera) in enumerate(views):
            if self.mode != "graph":
                yield self(moment, camera)
                continue
            self._require_size(camera)
            if not self._fits(moment):
                while under_way:
                    yield self._drawn(under_way.popleft())
                self._set_up(moment)
                lanes = []
            lanes = lanes or self._lanes_ahead(ahead)
            if len(under_way) == ahead:
                yield self._drawn(under_way.popleft())
            lane = lanes[place % ahead]
            with torch.cuda.stream(lane.stream):
                lane.stream.wait_event(lane.drawn)  # its last frame has been read
                lane.packed.copy_(self._pack(moment, camera), non_blocking=True)
                assert lane.graphs is not None
                lane.graphs[0].replay()
                lane.deformed.record()
            under_way.append(lane)
        while under_way:
            yield self._drawn(under_way.popleft())

    def _drawn(self, lane: _Lane) -> RenderOutput:
        """The picture of a lane's Gaussians; all lanes are drawn on one stream, as renders share
        memory there."""
        if lane.graphs is None:
            return self._draw(lane)
        if lane.stream is not None:
            torch.cuda.current_stream(self._device).wait_event(lane.deformed)
        lane.graphs[1].replay()
        if lane.stream is not None:
            lane.drawn.record(torch.cuda.current_stream(self._device))
        assert lane.output is not None
        return lane.output

    def _lanes_ahead(self, count: int) -> list[_Lane]:
        """Lanes of a film, captured at its first frame."""
        while len(self._ahead) < count:
            lane = _Lane(self._lane.packed.clone(), self._lane.joined.clone())
            lane.stream = torch.cuda.Stream(self._device)
            lane.deformed, lane.drawn = torch.cuda.Event(), torch.cuda.Event()
            self._capture(lane)
            lane.drawn.record(torch.cuda.current_stream(self._device))
            self._ahead.append(lane)
        return self._ahead[:count]

    def _require_size(self, camera: Camera) -> None:
        if (camera.width, camera.height) != self._size:
            raise RenderError(
                f"Playback: made for {self._size[0]}x{self._size[1]}, but the camera is "
                f"{camera.width}x{camera.height}; make another Playback for it"
            )

    def _has_halves(self) -> None:
        if self.mode == "plain":
            raise RenderError(f"Playback is plain and has no halves to time: {self.reason}")

    def _plain(self, moment: Moment, camera: Camera) -> RenderOutput:
        return self._model.render(
            moment.to(self._device), camera.to(self._device), only=self._names,
            request=self._request,
        )  # fmt: skip

    def _prepare(self, moment: Moment) -> None:
        """Set up the mode and compare it with plain; only "auto" falls back to another mode."""
        with torch.no_grad():
            failed = self._attempt(moment)
        if failed is None:
            return
        if self._requested != "auto":
            raise RenderError(f"Playback: mode {self._requested!r} does not work here: {failed}")
        if self.mode == "plain":
            warnings.warn(f"Playback is {self.mode}: {failed}", stacklevel=4)
        self.reason = failed

    def _attempt(self, moment: Moment) -> str | None:
        """Set up the requested mode; why another one is in use, or None."""
        best: Mode = "graph" if self._requested == "auto" else self._requested
        self.mode, self.reason = best, "agrees with the plain path"
        why = None
        if best == "graph" and self._device.type != "cuda":
            why = f"CUDA graphs need a CUDA device, the model is on {self._device}"
            if self._requested == "graph":
                return why
            self.mode = "cached"
        try:
            references = self._references()
            self._set_up(moment)
            differs = self._difference(references)
        except (RuntimeError, TypeError, ValueError, NotImplementedError, PluginError) as error:
            # for example from a component that reads the time as a number
            differs = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        if differs is not None:
            self.mode = "plain"
            self._model.eval()  # ends what was held
            return differs
        return why

    def _references(self) -> list[tuple[Moment, Camera, Gaussians]]:
        """Plain Gaussians at two times, of which graphs are captured at only one."""
        (first, view), (last, other) = self._views[0], self._views[-1]
        away = replace(last, time=0.75 if last.time == 0.5 else 1 - last.time)
        return [
            (m, c, self._model(m.to(self._device), self._names).joined(self._names))
            for m, c in ((first, view), (away, other))
        ]

    def _difference(self, references: list[tuple[Moment, Camera, Gaussians]]) -> str | None:
        """How the Gaussians differ from the plain ones; None if they agree."""
        for moment, camera, plain in references:
            self(moment, camera)
            for field, theirs in plain.tensors().items():
                ours = self._lane.joined.tensors()[field]
                worst = float((ours - theirs).abs().max()) if len(plain) else 0.0
                if not worst <= TOLERANCE * max(1.0, float(theirs.abs().max())):
                    return f"{field} differ by {worst:.3g} from the plain path's"
        return None

    def _hold(self, moment: Moment) -> None:
        """Compute what never changes: call `hold` of the deformations, join static Gaussians."""
        on_device = moment.to(self._device)
        for name in self._model.entities:
            entity = self._model.entity(name)
            entity.deformation.hold(entity.canonical, on_device)
        self._layout = MomentLayout.of(moment, self._model.entities)
        self._betas = {n: moment.poses[n].betas.detach().cpu().clone() for n in self._layout.people}
        self._given = {n: {"betas": on_device.poses[n].betas.clone()} for n in self._betas}
        state = self._model(on_device, self._names)
        joined = state.joined(self._names).clone()
        self._rows = {
            name: rows
            for name, rows in state.slices(self._names).items()
            if self._model.entity(name).deformation.moves or self._moved_by_others(state, name)
        }
        packed = self._pack(moment, self._views[0][1]).to(self._device)
        self._lane, self._ahead = _Lane(packed, joined), list[_Lane]()

    def _moved_by_others(self, state: SceneState, name: str) -> bool:
        residual = state.residuals.get(name)
        return residual is not None and residual.means is not None

    def _fits(self, moment: Moment) -> bool:
        """Whether body shapes and conventions are those of the set-up.

        Raises:
            RenderError: a body pose is missing.
        """
        for name in self._layout.people:
            if name not in moment.poses:
                raise RenderError(
                    f'Playback: the moment has no body pose for "{name}"; it has '
                    f"{sorted(moment.poses) or 'none'}"
                )
        return self._layout.fits(moment) and all(
            torch.equal(moment.poses[name].betas.cpu(), betas)
            for name, betas in self._betas.items()
        )

    def _set_up(self, moment: Moment) -> None:
        """Compute what stays the same, and capture."""
        self._model.eval()  # ends what was held
        self._hold(moment)
        if self.mode == "graph":
            self._capture(self._lane)

    def _pack(self, moment: Moment, camera: Camera) -> Tensor:
        """View matrix [16], intrinsics [9], time and poses in one tensor, on the CPU."""
        camera.need_pinhole("Playback")
        return self._layout.pack(moment, camera.world_to_camera, camera.K)

    def _moment(self, lane: _Lane) -> Moment:
        """The moment in the buffer."""
        return self._layout.unpack(lane.packed[25:], lane.joined.means.dtype, self._given)

    def _deform(self, lane: _Lane) -> None:
        """Compute the Gaussians that move, from the buffer."""
        state = self._model(self._moment(lane), self._names)
        for name, rows in self._rows.items():
            moved = state.gaussians[name]
            for field, value in moved.tensors().items():
                into = lane.joined.tensors()[field][rows]
                if field == "sh":  # higher bands, of other entities, are zero from the start
                    into = into[:, : value.shape[1]]
                into.copy_(value)

    def _draw(self, lane: _Lane) -> RenderOutput:
        """Render the Gaussians with the camera in the buffer."""
        kind = lane.joined.means.dtype
        camera = Camera(
            lane.packed[16:25].to(kind, copy=True).view(3, 3),
            lane.packed[:16].to(kind, copy=True).view(4, 4),
            *self._size,
        )
        moment = None if self._model.decoder is None else self._moment(lane)
        return self._model.draw(lane.joined, camera, self._request, moment)

    def _capture(self, lane: _Lane) -> None:
        """Capture one graph of `_deform` and one of `_draw`."""
        device = self._device
        graphs = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        # set the stream here too, as a failed capture does not restore the previous one
        with torch.no_grad(), torch.cuda.device(device), torch.cuda.stream(side), side_by_side({}):
            for moment, camera in self._views:  # compiles kernels, fills caches, sizes buffers
                lane.packed.copy_(self._pack(moment, camera))
                self._deform(lane)
                self._draw(lane)
            with capturing(graphs[0], side):
                self._deform(lane)
            with capturing(graphs[1], side):
                lane.output = self._draw(lane)
        torch.cuda.current_stream(device).wait_stream(side)
        lane.graphs = graphs
        self.captures += 1

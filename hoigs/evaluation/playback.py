"""Playback: a trained model drawn at any moment from any camera, on CUDA by one graph a frame."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from typing import Literal

import torch
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.capture import capturing
from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.core.moment_layout import MomentLayout
from hoigs.core.rasterizer import RenderOutput, RenderRequest
from hoigs.core.scene import SceneModel, SceneState

Mode = Literal["auto", "graph", "cached", "plain"]

AGREE = 1e-4  # largest difference of a number of a Gaussian (metres, logits, …) to the plain path


class Playback:
    """Draws as `SceneModel.render` does, without gradients and without what Python costs.

        play = Playback(model, views=[(clip.moments[p], clip.cameras[p]) for p in (0, 20, 40)])
        for moment, camera in film:
            image = play(moment, camera).color  # valid until the next call

    What depends on neither time nor pose is computed once (`DeformationModel.hold`), and Gaussians
    that never move are laid out once for the rasterizer. Time, poses and camera go into one buffer
    of the device, and a CUDA graph does all the rest, from the features to the picture. Any time in
    [0, 1] can be asked for, not only those of frames: components get it as a 0-d tensor on the
    device and pick their knots there. (A table of what depends on it, one row a clip frame, would
    have been less work for them, but nothing between frames, and a new kind of state.)

    The model is copied: later training does not show. Shapes of people (`betas`) and hand
    conventions are taken for good; a moment with others is recorded anew, which takes a while.

    Args:
        model: composed and trained. views: moments and cameras of the size to be drawn, at least
            one, spread over what will be asked for, so that there is room for all their splats.
        only: names of entities to draw; all by default.
        request: further rules; its tensors belong to `only`'s Gaussians.
        mode: "graph" replays a CUDA graph; "cached" does the same work launch by launch; "plain"
            calls `SceneModel.render`. "auto" is the graph on CUDA and cached elsewhere, but plain
            where that cannot be had, with a warning: a component that needs the time as a number
            on the host cannot be recorded. Recordings and caches are first compared with the plain
            path, at two times.

    Attributes:
        mode: what is done. reason: why, in words. recordings: how often a graph was captured.

    Raises:
        RenderError: the mode asked for does not work here, or does not give the plain Gaussians.
    """

    def __init__(
        self,
        model: SceneModel,
        views: Sequence[tuple[Moment, Camera]],
        *,
        only: Iterable[str] | None = None,
        request: RenderRequest | None = None,
        mode: Mode = "auto",
    ) -> None:
        if not views:
            raise RenderError("Playback: views is empty, expected a moment and a camera or more")
        sizes = {(camera.width, camera.height) for _, camera in views}
        if len(sizes) > 1:
            raise RenderError(f"Playback: views of sizes {sorted(sizes)}, expected one size")
        training = model.training
        model.eval()
        self._model = copy.deepcopy(model).requires_grad_(False)
        model.train(training)
        self._names = [n for n in model.entities if only is None or n in set(only)]
        self._request = request or RenderRequest()
        self._views, self._size = list(views), sizes.pop()
        self._device = model.device
        self._asked: Mode = mode
        self.mode: Mode = "plain"
        self.reason, self.recordings = "asked for", 0
        if mode != "plain":
            self._prepare(views[0][0])

    @torch.no_grad()
    def __call__(self, moment: Moment, camera: Camera) -> RenderOutput:
        """Draw one frame; the output is overwritten by the next call.

        Moments and cameras are best left on the CPU: reading them back waits for the device.

        Raises:
            RenderError: a camera of another size, or a moment without a pose that is needed.
        """
        if (camera.width, camera.height) != self._size:
            raise RenderError(
                f"Playback: made for {self._size[0]}x{self._size[1]}, asked for "
                f"{camera.width}x{camera.height}; make another one"
            )
        if self.mode == "plain":
            return self._plain(moment, camera)
        self.deform(moment, camera)
        return self.draw()

    @torch.no_grad()
    def deform(self, moment: Moment, camera: Camera) -> Gaussians:
        """The first half of a frame, for those who time the halves: Gaussians at a moment.

        Raises:
            RenderError: as a call, or the mode is "plain", which has no halves.
        """
        self._has_halves()
        self._check_people(moment)
        # not pinned: CUDA has copied it before this returns, so that it may go at once
        self._packed.copy_(self._pack(moment, camera), non_blocking=True)
        if self.mode == "graph":
            self._graphs[0].replay()
        else:
            self._deform()
        return self._joined

    @torch.no_grad()
    def draw(self) -> RenderOutput:
        """The second half: the picture of what `deform` was asked for."""
        self._has_halves()
        if self.mode == "graph":
            self._graphs[1].replay()
            return self._output
        return self._draw()

    def _has_halves(self) -> None:
        if self.mode == "plain":
            raise RenderError(f"Playback is plain and has no halves to time: {self.reason}")

    def _plain(self, moment: Moment, camera: Camera) -> RenderOutput:
        return self._model.render(
            moment.to(self._device), camera.to(self._device), only=self._names,
            request=self._request,
        )  # fmt: skip

    def _prepare(self, moment: Moment) -> None:
        """Hold, record and compare with the plain path; fall back only where that was left open."""
        with torch.no_grad():
            failed = self._attempt(moment)
        if failed is None:
            return
        if self._asked != "auto":
            raise RenderError(f"Playback: mode {self._asked!r} does not work here: {failed}")
        if self.mode == "plain":
            warnings.warn(f"Playback is {self.mode}: {failed}", stacklevel=4)
        self.reason = failed

    def _attempt(self, moment: Moment) -> str | None:
        """Why the best mode asked for cannot be had, and the next one taken; None if it can."""
        best: Mode = "graph" if self._asked == "auto" else self._asked
        self.mode, self.reason = best, "agrees with the plain path"
        why = None
        if best == "graph" and self._device.type != "cuda":
            why = f"CUDA graphs need a CUDA device, the model is on {self._device}"
            if self._asked == "graph":
                return why
            self.mode = "cached"
        try:
            wanted = self._references()
            self._hold(moment)
            if self.mode == "graph":
                self._record()
            differs = self._difference(wanted)
        except (RuntimeError, TypeError, ValueError, NotImplementedError) as error:
            # a component that reads the time as a number, for example, cannot be recorded
            differs = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        if differs is not None:
            self.mode = "plain"
            self._model.eval()  # ends what was held
            return differs
        return why

    def _references(self) -> list[tuple[Moment, Camera, Gaussians]]:
        """Gaussians of the plain path at two times, of which one is in no recording."""
        (first, view), (last, other) = self._views[0], self._views[-1]
        away = replace(last, time=0.75 if last.time == 0.5 else 1 - last.time)
        return [
            (m, c, self._model(m.to(self._device), self._names).joined(self._names))
            for m, c in ((first, view), (away, other))
        ]

    def _difference(self, wanted: list[tuple[Moment, Camera, Gaussians]]) -> str | None:
        """How the Gaussians differ from the plain path's; None where they agree."""
        for moment, camera, plain in wanted:
            self(moment, camera)
            for f in fields(Gaussians):
                ours, theirs = getattr(self._joined, f.name), getattr(plain, f.name)
                worst = float((ours - theirs).abs().max()) if len(plain) else 0.0
                if not worst <= AGREE * max(1.0, float(theirs.abs().max())):
                    return f"{f.name} differ by {worst:.3g} from the plain path's"
        return None

    def _hold(self, moment: Moment) -> None:
        """Let every component keep what will not change, and lay out what never moves."""
        on_device = moment.to(self._device)
        for name in self._model.entities:
            entity = self._model.entity(name)
            entity.deformation.hold(entity.rest, on_device)
        self._layout = MomentLayout.of(moment, self._model.entities)
        self._betas = {n: moment.poses[n].betas.detach().cpu().clone() for n in self._layout.people}
        self._given = {n: {"betas": on_device.poses[n].betas.clone()} for n in self._betas}
        state = self._model(on_device, self._names)
        self._joined = state.joined(self._names).clone()
        self._rows = {
            name: rows
            for name, rows in state.slices(self._names).items()
            if self._model.entity(name).deformation.moves or self._moved_by_others(state, name)
        }
        self._packed = self._pack(moment, self._views[0][1]).to(self._device)

    def _moved_by_others(self, state: SceneState, name: str) -> bool:
        residual = state.residuals.get(name)
        return residual is not None and residual.means is not None

    def _check_people(self, moment: Moment) -> None:
        for name in self._layout.people:
            if name not in moment.poses:
                raise RenderError(
                    f'Playback: the moment has no body pose for "{name}"; it has '
                    f"{sorted(moment.poses) or 'none'}"
                )
        same = self._layout.fits(moment) and all(
            torch.equal(moment.poses[name].betas.cpu(), betas)
            for name, betas in self._betas.items()
        )
        if not same:
            self._model.eval()
            self._hold(moment)
            if self.mode == "graph":
                self._record()

    def _pack(self, moment: Moment, camera: Camera) -> Tensor:
        """View, intrinsics, time and poses, one after the other, on the host."""
        return self._layout.pack(moment, camera.world_to_camera, camera.K)

    def _moment(self) -> Moment:
        """The moment that stands in the buffer."""
        return self._layout.unpack(self._packed[25:], self._joined.means.dtype, self._given)

    def _deform(self) -> None:
        """From the buffer to the Gaussians that move."""
        state = self._model(self._moment(), self._names)
        for name, rows in self._rows.items():
            moved = state.gaussians[name]
            for f in fields(Gaussians):
                into, value = getattr(self._joined, f.name)[rows], getattr(moved, f.name)
                if f.name == "sh":  # higher bands, of other entities, are zero from the start
                    into = into[:, : value.shape[1]]
                into.copy_(value)

    def _draw(self) -> RenderOutput:
        """From the Gaussians and the buffer's camera to the picture."""
        kind = self._joined.means.dtype
        camera = Camera(
            self._packed[16:25].to(kind, copy=True).view(3, 3),
            self._packed[:16].to(kind, copy=True).view(4, 4),
            *self._size,
        )
        return self._model.rasterizer.render(self._joined, camera, self._request)

    def _record(self) -> None:
        device = self._device
        graphs = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        # the stream outside too: a capture that fails does not restore the one before
        with torch.no_grad(), torch.cuda.device(device), torch.cuda.stream(side):
            for moment, camera in self._views:  # kernels compile, caches fill, splats are counted
                self._packed.copy_(self._pack(moment, camera))
                self._deform()
                self._draw()
            with capturing(graphs[0], side):
                self._deform()
            with capturing(graphs[1], side):
                self._output = self._draw()
        torch.cuda.current_stream(device).wait_stream(side)
        self._graphs = graphs
        self.recordings += 1

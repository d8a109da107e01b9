"""Playback: the same pictures as the plain path, at frames, between them and at both ends."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from whole_scene import away_from_start, person_of, things

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.deformation.tracked_chs import TrackedHermite
from hoigs.plugins.features.body_parts import BodyPartFeatures
from hoigs.plugins.features.spline_motion import SplineMotionFeatures
from hoigs.plugins.interaction.cross_attention import CrossAttention
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.viewing.playback import Playback

FRAMES, SIZE = 9, 24
TIMES = (0.0, 1 / 8, 0.3, 0.5, 0.77, 1.0)


def scene(rasterizer: Rasterizer, **human: object) -> SceneModel:
    """All parts of the hoigs spec, small, with every head and correction away from its start."""
    body, wall, box, track = things(FRAMES)
    person = person_of(body, FRAMES, (0, 1, 3, 6, 7), **human)
    model = SceneModel(
        {
            "scene": Entity(wall, Static(), kind="scene"),
            "human": Entity(body.canonical(80), person, BodyPartFeatures()),
            "object": Entity(
                box,
                TrackedHermite(TrackedHermite.Config(keyframes=4), track=track),
                SplineMotionFeatures(SplineMotionFeatures.Config(hidden=8)),
            ),
        },
        interaction=CrossAttention(CrossAttention.Config(hidden=16, reach=3.0)),
        rasterizer=rasterizer,
    )
    return away_from_start(model).eval()


def view(time: float) -> tuple[Moment, Camera]:
    generator = torch.Generator().manual_seed(round(1000 * time))
    pose = BodyPose.zeros(betas=2)
    pose = pose.replace(
        body=0.3 * torch.randn(21, 3, generator=generator),
        transl=torch.tensor((0.2 * time, 0.0, 0.0)),
        betas=torch.tensor((0.5, -0.3)),
    )
    camera = Camera.look_at(
        torch.tensor((time - 0.5, 0.2, -2.5)), torch.tensor((0.0, 0.0, 0.5)),
        width=SIZE, height=SIZE, fov_y=0.9, up=(0.0, -1.0, 0.0),
    )  # fmt: skip
    return Moment(time, round(time * (FRAMES - 1)), {"human": pose}), camera


def test_equals_the_plain_path_at_and_between_frames() -> None:
    model = scene(TorchRasterizer())
    play = Playback(model, [view(0.4)])
    assert play.mode == "cached" and "CUDA" in play.reason
    pictures = []
    for time in TIMES:
        moment, camera = view(time)
        plain = model.render(moment, camera)
        drawn = play(moment, camera)
        assert (drawn.color - plain.color).abs().max() < 1e-4
        assert (drawn.depth - plain.depth).abs().max() < 1e-3
        pictures.append(drawn.color.clone())
    assert (pictures[0] - pictures[3]).abs().max() > 0.05  # things move


@pytest.mark.parametrize("fusion", ["paired", "product"])
@pytest.mark.parametrize("field_at", ["posed", "canonical"])
def test_gaussians_in_every_reading(fusion: str, field_at: str) -> None:
    model = scene(TorchRasterizer(), fusion=fusion, field_at=field_at)
    play = Playback(model, [view(0.4)])
    for time in TIMES:
        moment, camera = view(time)
        wanted = model(moment).joined()
        play(moment, camera)
        torch.testing.assert_close(play._lane.joined.means, wanted.means, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(play._lane.joined.quats, wanted.quats, atol=1e-5, rtol=1e-4)


def test_scale_about_the_camera() -> None:
    centers = torch.randn(FRAMES, 3, generator=torch.Generator().manual_seed(1))
    model = scene(TorchRasterizer(), scale_about="camera", camera_centers=centers)
    play = Playback(model, [view(0.4)])
    for time in TIMES:
        moment, camera = view(time)
        play(moment, camera)
        torch.testing.assert_close(
            play._lane.joined.means, model(moment).joined().means, atol=1e-5, rtol=1e-5
        )


def test_some_entities_and_another_shape() -> None:
    model = scene(TorchRasterizer())
    play = Playback(model, [view(0.4)], only=["human", "scene"])
    moment, camera = view(0.6)
    taller = moment.poses["human"].replace(betas=torch.tensor((2.0, 1.0)))
    for asked in (moment, moment.with_pose("human", taller), moment):
        plain = model.render(asked, camera, only=["human", "scene"])
        assert (play(asked, camera).color - plain.color).abs().max() < 1e-4


def test_later_training_does_not_show() -> None:
    model = scene(TorchRasterizer())
    moment, camera = view(0.4)
    play = Playback(model, [(moment, camera)])
    before = play(moment, camera).color.clone()
    with torch.no_grad():
        model.entity("human").means += 0.5
    model.train()
    assert torch.equal(play(moment, camera).color, before)


class Counting(DeformationModel):
    """Keeps the first time that it is called with, as a graph would a number."""

    def __init__(self) -> None:
        super().__init__()
        self.first: float | None = None

    def hold(self, canonical: Gaussians, moment: Moment) -> None:
        self.first = float(moment.time)

    def train(self, mode: bool = True) -> Counting:
        self.first = None
        return super().train(mode)

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        time = moment.time if self.first is None else self.first
        return replace(canonical, means=canonical.means + float(time))


def test_what_differs_from_the_plain_path_is_drawn_plainly_and_told() -> None:
    canonical = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
    model = SceneModel({"thing": Entity(canonical, Counting())}, rasterizer=TorchRasterizer())
    with pytest.warns(UserWarning, match="means differ by 0.2"):
        play = Playback(model, [view(0.4)])
    assert play.mode == "plain" and "means differ" in play.reason
    moment, camera = view(0.9)
    assert torch.equal(play(moment, camera).color, model.render(moment, camera).color)
    with pytest.raises(RenderError, match="'cached' does not work here: means differ"):
        Playback(model, [view(0.4)], mode="cached")


def test_errors_speak() -> None:
    model = scene(TorchRasterizer())
    with pytest.raises(RenderError, match="views is empty"):
        Playback(model, [])
    with pytest.raises(RenderError, match="'graph' does not work here: CUDA graphs need"):
        Playback(model, [view(0.4)], mode="graph")
    play = Playback(model, [view(0.4)])
    moment, camera = view(0.5)
    with pytest.raises(RenderError, match="made for 24x24, but the camera is 48x24"):
        play(moment, camera.resized(48, 24))
    with pytest.raises(RenderError, match='no body pose for "human"'):
        play(Moment(0.5), camera)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_graph_equals_the_plain_path() -> None:
    from hoigs.rasterizers.warp import WarpRasterizer

    model = scene(WarpRasterizer()).to("cuda")
    play = Playback(model, [view(0.4), view(0.9)])
    assert (play.mode, play.captures) == ("graph", 1), play.reason
    for time in (*TIMES, *TIMES[::-1]):
        moment, camera = view(time)
        drawn = play(moment, camera).color.clone()
        plain = model.render(moment.to("cuda"), camera.to("cuda")).color
        assert (drawn - plain).abs().mean() < 1e-5
    moment, camera = view(0.6)
    taller = moment.with_pose(
        "human", moment.poses["human"].replace(betas=torch.tensor((2.0, 1.0)))
    )
    drawn = play(taller, camera).color.clone()
    assert play.captures == 2
    plain = model.render(taller.to("cuda"), camera.to("cuda")).color
    assert (drawn - plain).abs().mean() < 1e-5


def test_a_film_is_its_frames_in_order() -> None:
    model = scene(TorchRasterizer())
    play = Playback(model, [view(0.4), view(0.9)])
    with_others = [view(time) for time in (*TIMES, 0.6, *TIMES)]
    frames = [output.color.clone() for output in play.film(with_others, ahead=3)]
    assert len(frames) == len(with_others)
    for (moment, camera), frame in zip(with_others, frames, strict=True):
        assert torch.equal(frame, play(moment, camera).color)
    assert list(play.film([])) == []
    with pytest.raises(RenderError, match="ahead is 0, expected 1"):
        next(play.film(with_others, ahead=0))
    with pytest.raises(RenderError, match="made for 24x24, but the camera is 48x24"):
        next(play.film([(with_others[0][0], with_others[0][1].resized(48, 24))]))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_film_is_its_frames_in_order() -> None:
    from hoigs.rasterizers.warp import WarpRasterizer

    model = scene(WarpRasterizer()).to("cuda")
    play = Playback(model, [view(0.4), view(0.9)])
    moment, camera = view(0.6)
    other = moment.with_pose("human", moment.poses["human"].replace(betas=torch.tensor((2.0, 1.0))))
    shots = [*map(view, TIMES), (other, camera), *map(view, TIMES[::-1])]
    frames = [output.color.clone() for output in play.film(iter(shots), ahead=3)]
    assert (len(frames), play.captures) == (len(shots), 3 * (1 + 3))
    for (moment, camera), frame in zip(shots, frames, strict=True):
        plain = model.render(moment.to("cuda"), camera.to("cuda")).color
        assert (frame - plain).abs().mean() < 1e-5


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_cuda_component_that_needs_a_number_is_drawn_plainly() -> None:
    from hoigs.rasterizers.warp import WarpRasterizer

    canonical = Gaussians.from_points(torch.rand(10, 3), scales=0.1)
    plain = copy.deepcopy(Counting())
    plain.hold = lambda canonical, moment: None  # type: ignore[method-assign]
    model = SceneModel({"thing": Entity(canonical, plain)}, rasterizer=WarpRasterizer()).to("cuda")
    with pytest.warns(UserWarning, match="Playback is plain"):
        play = Playback(model, [view(0.4)])
    moment, camera = view(0.9)
    drawn = play(moment, camera).color
    assert torch.equal(drawn, model.render(moment.to("cuda"), camera.to("cuda")).color)

"""Cameras that are a little wrong are put right while the scene is learned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from small_clip import FRAMES, small_clip, truth
from torch import Tensor

from hoigs.core.errors import CheckpointError, SpecError
from hoigs.core.interfaces.rasterizer import Rasterizer
from hoigs.core.model.camera_refinement import CameraRefinement
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import TrainSpec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import CAMERAS_REFINED, Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.plugins.deformation.static import Static
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.rasterizers.warp import WarpRasterizer
from hoigs.training.trainer import Trainer

WRONG = 2  # the frame whose camera is not where the clip says


pytestmark = pytest.mark.usefixtures("one_thread")


def moved(camera: Camera, degrees: float, metres: float, seed: int = 0) -> Camera:
    """Turned about its centre and shifted, in directions drawn from a seed."""
    generator = torch.Generator().manual_seed(seed)
    turn, shift = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    wrong = CameraRefinement([0.0], [0], 1.0)
    wrong.turns.data[0], wrong.shifts.data[0] = math.radians(degrees) * turn, metres * shift
    with torch.no_grad():
        return wrong(camera, 0)


def apart(a: Camera, b: Camera) -> tuple[float, float]:
    """Degrees and metres between two cameras."""
    turn = a.world_to_camera[:3, :3] @ b.world_to_camera[:3, :3].mT
    cosine = ((turn.trace() - 1) / 2).clamp(-1, 1)
    return math.degrees(float(torch.acos(cosine))), float((a.center - b.center).norm())


def model_of(clip: Clip, rasterizer: Rasterizer | None = None) -> SceneModel:
    points = Gaussians.from_points(clip.points, clip.point_colors, scales=0.1, opacity=0.7)
    return SceneModel(
        {"scene": Entity(points, Static())}, rasterizer=rasterizer or WarpRasterizer()
    )


def spec(steps: int, rate: float = 3e-4) -> TrainSpec:
    made = TrainSpec(steps=steps, preview_every=0)
    made.rates.camera, made.rates.means = rate, 4e-4
    return made


def dense_clip() -> Clip:
    """The small clip with as many points as were drawn, each a little off its place."""
    clip, scene = small_clip(), truth()
    noise = torch.randn(len(scene), 3, generator=torch.Generator().manual_seed(5))
    return replace(clip, points=scene.means + 0.03 * noise, point_colors=scene.colors)


def with_cameras(clip: Clip, cameras: Sequence[Camera]) -> Clip:
    return replace(clip, cameras=list(cameras))


def test_a_correction_is_exactly_the_motion_that_it_says() -> None:
    camera = small_clip().cameras[1]
    turned = moved(camera, 1.0, 0.0)
    assert apart(camera, turned)[0] == pytest.approx(1.0, abs=0.02)
    assert apart(camera, turned)[1] < 1e-5, "a turn is about the camera's own centre"
    assert apart(camera, moved(camera, 0.0, 0.05))[1] == pytest.approx(0.05, abs=1e-4)
    refinement = CameraRefinement([0.0, 0.25, 1.0], [0, 2], extent=2.0)
    torch.testing.assert_close(refinement(camera, 1).world_to_camera, camera.world_to_camera)
    refinement.turns.data[2], refinement.shifts.data[2] = torch.ones(3), torch.ones(3)
    turn, shift = refinement.delta(1)
    torch.testing.assert_close(turn, torch.full((3,), 0.25))
    torch.testing.assert_close(shift, torch.full((3,), 0.5))


def gradients(rasterizer: Rasterizer, dtype: torch.dtype, step: float | None) -> Tensor:
    """Of a loss by one camera's correction [6]; by central differences if there is a `step`."""
    clip, scene = small_clip(), truth()
    drawn = Gaussians(*(x.to(dtype) for x in scene.tensors().values()))
    weights = torch.randn(64, 64, 3, generator=torch.Generator().manual_seed(4)).to(dtype)
    refinement = CameraRefinement.of(clip).to(dtype)
    with torch.no_grad():
        refinement.turns += 0.013
        refinement.shifts -= 0.01

    def loss() -> Tensor:
        camera = refinement(clip.cameras[WRONG].to(dtype), WRONG)
        return (weights * rasterizer.render(drawn, camera).color).sum()

    parameters = (refinement.turns, refinement.shifts)
    if step is None:
        loss().backward()
        found = [p.grad for p in parameters if p.grad is not None]
        assert all((g[WRONG - 1] == 0).all() for g in found), "other frames have no part in it"
        return torch.cat([g[WRONG] for g in found])
    differences = []
    for parameter in parameters:
        for i in range(3):
            values = []
            for sign in (1, -1):
                with torch.no_grad():
                    parameter[WRONG, i] += sign * step
                    values.append(loss())
                    parameter[WRONG, i] -= sign * step
            differences.append((values[0] - values[1]) / (2 * step))
    return torch.stack(differences)


def test_gradients_agree_with_differences_and_backends_with_each_other() -> None:
    exact = gradients(TorchRasterizer(), torch.float64, None)
    # so small a step crosses no cut-off, where a render jumps and has no gradient
    differences = gradients(TorchRasterizer(), torch.float64, 1e-8)
    assert (exact - differences).norm() < 1e-4 * exact.norm()
    for rasterizer in (TorchRasterizer(), WarpRasterizer()):
        found = gradients(rasterizer, torch.float32, None).double()
        assert (found - exact).norm() < 2e-3 * exact.norm(), type(rasterizer).__name__


@pytest.fixture(scope="module")
def trained(one_thread: None) -> Trainer:
    """One camera wrong by one degree and 1 % of its distance, trained for 300 steps."""
    clip = dense_clip()
    distance = float(clip.cameras[WRONG].center.norm())
    cameras = list(clip.cameras)
    cameras[WRONG] = moved(cameras[WRONG], 1.0, 0.01 * distance)
    trainer = Trainer(model_of(clip), with_cameras(clip, cameras), spec(300))
    trainer.train()
    return trainer


def test_a_wrong_camera_is_recovered_more_than_halfway(trained: Trainer) -> None:
    exact, given = small_clip().cameras, trained.clip.cameras
    assert trained.cameras is not None
    refined = trained.cameras.refined(trained.clip)
    before, after = apart(given[WRONG], exact[WRONG]), apart(refined.cameras[WRONG], exact[WRONG])
    assert after[0] < 0.5 * before[0] and after[1] < 0.5 * before[1], (before, after)
    for i in range(FRAMES):
        if i != WRONG:  # right ones stay within a fraction of what the wrong one was off
            turned, shifted = apart(refined.cameras[i], exact[i])
            assert turned < 0.3 * before[0] and shifted < 0.4 * before[1], (i, turned, shifted)
    assert refined.provenance[CAMERAS_REFINED] is True
    assert CAMERAS_REFINED not in trained.clip.provenance


def test_a_resumed_run_goes_on_with_its_cameras() -> None:
    clip = dense_clip()
    saved = []
    whole = Trainer(model_of(clip), clip, spec(12))
    whole.train(lambda report: None)
    broken = Trainer(model_of(clip), clip, spec(12))
    for _ in range(6):
        broken._step()
    saved.append(broken.checkpoint())
    resumed = Trainer(model_of(clip), clip, spec(12))
    resumed.resume(saved[0])
    resumed.train()
    assert resumed.cameras is not None and whole.cameras is not None
    assert whole.cameras.turns.abs().max() > 0
    torch.testing.assert_close(resumed.cameras.turns, whole.cameras.turns, atol=1e-6, rtol=1e-4)
    without = Trainer(model_of(clip), clip, spec(12, rate=0.0))
    assert without.cameras is None
    with pytest.raises(CheckpointError, match=r"train\.rates\.camera"):
        without.resume(saved[0])


def test_they_wait_for_their_warm_up_and_are_off_by_default() -> None:
    clip = dense_clip()
    assert Trainer(model_of(clip), clip, TrainSpec(steps=2)).cameras is None
    late = spec(10)
    late.warmup.cameras = 0.5
    trainer = Trainer(model_of(clip), clip, late)
    assert trainer.cameras is not None
    for step in range(7):
        trainer._step()
        moving = bool(trainer.cameras.turns.abs().max() > 0)
        assert moving == (step >= 5), step


def test_the_penalty_pulls_to_zero() -> None:
    clip = dense_clip()
    held = spec(40)
    held.loss.regularizers = {"camera": 1e4}
    loose = spec(40)
    sizes = []
    for chosen in (held, loose):
        cameras = [moved(c, 1.0, 0.04, seed=i) for i, c in enumerate(clip.cameras)]
        trainer = Trainer(model_of(clip), with_cameras(clip, cameras), chosen)
        trainer.train()
        assert trainer.cameras is not None
        sizes.append(float(trainer.cameras.turns.detach().norm()))
    assert sizes[0] < 0.3 * sizes[1]


def test_a_rasterizer_without_camera_gradients_is_refused() -> None:
    class Blind(TorchRasterizer):
        capabilities = replace(TorchRasterizer.capabilities, camera_gradients=False)

    clip = dense_clip()
    with pytest.raises(SpecError, match="Blind gives no camera gradients"):
        Trainer(model_of(clip, Blind()), clip, spec(2))

"""F43, F44, F52: values that are not finite, broken depth, and dictionaries in another order."""

from __future__ import annotations

import pickle
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from hoigs.core.errors import NotFiniteError
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import LossSpec, TrainSpec
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.studies.stress.case import CheckResult
from hoigs.studies.stress.checks.toy import cameras, component, toy_clip, wall
from hoigs.training.losses import depth_loss
from hoigs.training.trainer import Trainer


class _Breaks(DeformationModel):
    """A static deformation whose means are not finite at some frames."""

    input_space = "world"
    moves = False

    def __init__(self, frames: set[int]) -> None:
        super().__init__()
        self.frames = frames

    def forward(
        self, canonical: Gaussians, moment: Moment, residual: Residual | None = None
    ) -> Gaussians:
        del residual
        if moment.index not in self.frames:
            return canonical
        return canonical.replace(means=canonical.means * torch.nan)


def _trainer(frames: set[int]) -> Trainer:
    clip = toy_clip()
    canonical = Gaussians.from_points(clip.points[:200], scales=0.1)
    entity = Entity(canonical, _Breaks(frames), kind="scene")
    model = SceneModel({"scene": entity}, rasterizer=component("rasterizer:torch"))
    loss = LossSpec(depth=0, ssim="torch")
    return Trainer(model, clip, TrainSpec(steps=20, preview_every=0, loss=loss))


def broken_step_skipped() -> CheckResult:
    """One frame of four is not finite: its steps are skipped. All four: training stops."""
    trainer = _trainer({1})
    trainer.train()
    skipped, names = len(trainer.guard.skipped), {name for _, name in trainer.guard.skipped}
    finite = all(bool(torch.isfinite(p).all()) for p in trainer.model.parameters())
    wanted = {"means of the deformed Gaussians of 'scene'"}
    try:
        _trainer({0, 1, 2, 3}).train()
        ended = ""
    except NotFiniteError as error:
        ended = str(error).partition(";")[0]
    return CheckResult(
        skipped == 5 and finite and names == wanted and bool(ended),
        f"{skipped} of 20 steps skipped for {', '.join(sorted(names))}; parameters finite: "
        f"{finite}; where all frames are: {ended or 'training went on'}",
    )


def broken_depth_masked() -> CheckResult:
    """NaN, 0, infinity and negative values in a depth prior: the loss ignores these pixels."""
    camera, scene = cameras(1, 0.0)[0], wall()
    canonical = scene.map(lambda x: x.clone().requires_grad_())
    drawn = component("rasterizer:torch").render(canonical, camera)
    good = torch.full_like(drawn.depth, 4.2).detach()
    bad = good.clone()
    bad[:4], bad[4:8], bad[8:12], bad[12:16] = torch.nan, 0.0, torch.inf, -1.0
    loss = depth_loss(drawn.depth, drawn.alpha, bad, "metric")
    left = good.clone()
    left[:16] = 0.0
    expected = depth_loss(drawn.depth, drawn.alpha, left, "metric")
    nothing = depth_loss(drawn.depth, drawn.alpha, torch.full_like(good, torch.nan), "metric")
    assert loss is not None and expected is not None
    loss.backward()
    grad = canonical.means.grad
    finite = grad is not None and bool(torch.isfinite(grad).all())
    same = bool(torch.isfinite(loss)) and abs(float(loss.detach() - expected.detach())) < 1e-6
    return CheckResult(
        finite and same and nothing is None,
        f"loss {float(loss.detach()):.4g}, {float(expected.detach()):.4g} of the valid pixels "
        f"alone; gradients finite: {finite}; no term if all are NaN: {nothing is None}",
    )


def matched_by_name() -> CheckResult:
    """A HOSNeRF folder whose dictionary has another order than its images."""
    names, places = [f"{i:06d}" for i in range(5)], [0.3 * i for i in range(5)]
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for room in ("images", "masks"):
            (folder / room).mkdir()
        table = {}
        for name, x in zip(names, places, strict=True):
            Image.new("RGB", (16, 16), (90, 90, 90)).save(folder / "images" / f"{name}.png")
            Image.new("L", (16, 16), 0).save(folder / "masks" / f"{name}.png")
            to_camera = np.eye(4)
            to_camera[0, 3] = -x
            table[name] = {
                "intrinsics": np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]),
                "smpl_to_camera": to_camera,
                "smpl_to_world": np.eye(4),
            }
        shuffled = {name: table[name] for name in (names[i] for i in (3, 0, 4, 2, 1))}
        for file, content in (("cameras.pkl", shuffled), ("mesh_infos.pkl", {})):
            (folder / file).write_bytes(pickle.dumps(content))
        down_right_back = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
        row = np.concatenate((down_right_back, np.zeros((3, 2))), 1).ravel()
        np.save(folder / "poses_bounds.npy", np.tile([*row, 1.0, 5.0], (5, 1)))
        clip = component("reader:hosnerf", points=50).read(folder)
        found = [round(float(camera.center[0]), 4) for camera in clip.cameras]
    off = max(abs(a - b) for a, b in zip(found, places, strict=True))
    return CheckResult(off < 1e-4, f"centres at x = {found}, off by {off:.1g} m")

"""Training in windows: the same model, of which one window's rows are in memory."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hoigs.core.errors import SpecError
from hoigs.core.model.scene import SceneModel
from hoigs.core.parameters import TimeRows
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.runs.loaded_run import LoadedRun
from hoigs.training.optimizer import Schedule
from hoigs.training.session import Session
from hoigs.training.time_windows import _caught_up

CLIP = (
    "builtin:lift-and-swing?frames=24&width=32&fps=8&samples=1&edge_samples=1&held_out_views=0"
    "&test_frames=3"
)
SMALL = [
    "model.scene.points=60", "model.human.points=40", "model.object.points=20",
    "model.human.deformation.resolution=8", "model.human.deformation.channels=2",
    "model.object.deformation.keyframe_step=1", "model.object.deformation.opacity=keyed",
    "train.log_every=1", "train.preview_every=0",
    "train.fill_unseen=[]", "train.steps=30", "train.checkpoint_every=100",
]  # fmt: skip
PAGED = {
    "entities.human.deformation.planes.time",
    "entities.object.deformation.keyframe_means",
    "entities.object.deformation.keyframe_quats",
    "entities.object.deformation.opacity_logits",
    "entities.object.deformation.tangents",
    "entities.object.features.embedding",
}


def opened(out: Path, *settings: str, **options: bool) -> Session:
    return Session.open(
        None if options else CLIP, None if options else "hoigs", out=out,
        overrides=[*SMALL, *settings], device="cpu", **options,
    )  # fmt: skip


def drawn(model: SceneModel, clip: Clip) -> list[Tensor]:
    """All numbers of the scene's Gaussians in every frame."""
    found = []
    with torch.no_grad():
        for moment in clip.moments:
            g = model(moment).joined()
            found.append(torch.cat([g.means, g.quats, g.opacity_logits[:, None], g.sh[:, 0]], 1))
    return found


def test_rows_about_a_time_are_those_that_are_read() -> None:
    rows = TimeRows(11)
    assert rows.about(0.0, 0.5) == slice(0, 8)
    assert rows.about(0.5, 1.0) == slice(3, 11)
    assert rows.about(0.0, 1.0) == slice(0, 11)
    assert rows.local(0.3, 11) == 0.3
    rows.first = 3
    assert rows.local(0.3, 8) == pytest.approx(0)
    assert rows.local(1.0, 8) == pytest.approx(1)


def test_a_window_draws_what_the_whole_model_draws(tmp_path: Path) -> None:
    clothes = "model.human.deformation.nonrigid=true"
    session = opened(tmp_path / "run", "train.chunk=6", clothes)
    trainer, clip, model = session.trainer, session.clip, session.trainer.model
    windows = trainer.windows
    assert windows is not None
    assert set(windows.names) == PAGED | {"entities.human.deformation.nonrigid.planes.time"}
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name in windows.names:
            values = trainer.optimizer.names[name]
            values += 0.05 * torch.randn(values.shape, generator=generator)
    model.eval()
    whole = drawn(model, clip)
    size = {n: p.numel() for n, p in trainer.optimizer.names.items() if n in PAGED}
    with windows.opened(1):
        assert windows.count == 4
        for frame, numbers in zip(drawn(model, clip), whole, strict=True):
            torch.testing.assert_close(frame, numbers)
        for name, parameter in trainer.optimizer.names.items():
            if name in PAGED:
                assert parameter.numel() < 0.7 * size[name], name
    for frame, numbers in zip(drawn(model, clip), whole, strict=True):
        assert torch.equal(frame, numbers)
    assert not (tmp_path / "run" / "windows").exists()


def test_training_in_windows_gives_an_ordinary_run(
    hoigs: Callable[..., Any], tmp_path: Path
) -> None:
    settings = [word for setting in SMALL for word in ("--set", setting)]
    run = tmp_path / "run"
    trained = hoigs("train", CLIP, "--out", run, "--chunk", "6", "--device", "cpu", *settings)
    assert trained.code == 0, trained.err
    said = "trained in 4 windows of at most 6 frames"
    assert said in " ".join(trained.out.split())
    record = json.loads((run / "provenance.json").read_text())
    assert record["windows"].startswith(said)
    assert record["cuda_graphs"] == {"mode": "plain", "captures": 0, "why": "train.graphs is off"}
    assert not (run / "windows").exists()
    assert (run / "evaluation.json").is_file()
    stored = LoadedRun.open(run).model.state_dict()
    whole = opened(tmp_path / "whole").trainer.model.state_dict()
    assert {n: v.shape for n, v in stored.items()} == {n: v.shape for n, v in whole.items()}
    planes = stored["entities.human.deformation.planes.time"]
    assert (planes != 1).any(0).any(-1).any(-1).all(), "every row was trained"


def test_a_finished_training_leaves_the_model_that_its_checkpoint_has(tmp_path: Path) -> None:
    session = opened(tmp_path / "run", "train.chunk=6")
    session.train()
    loaded = LoadedRun.open(tmp_path / "run")
    session.trainer.model.eval()
    pairs = zip(drawn(session.trainer.model, session.clip), drawn(loaded.model, loaded.clip),
                strict=True)  # fmt: skip
    for frame, numbers in pairs:
        torch.testing.assert_close(frame, numbers)


def in_memory(folder: Path) -> list[int]:
    """Bytes in memory of each mapping of a file below a folder."""
    text = Path("/proc/self/smaps").read_text()
    return [1024 * int(kib) for kib in re.findall(rf"{folder}/.*\n(?:.*\n){{3}}Rss: +(\d+)", text)]


@pytest.mark.skipif(not Path("/proc/self/smaps").is_file(), reason="reads /proc/self/smaps")
def test_a_finished_model_takes_rows_from_the_file_as_they_are_read(tmp_path: Path) -> None:
    words = ("model.human.deformation.time_resolution=4096", "train.steps=2",
             "model.human.deformation.channels=32", "train.checkpoint_every=1")  # fmt: skip
    session = opened(tmp_path / "run", *words)
    session.trainer.train(until=1)
    session.run.unlock()
    unfinished = LoadedRun.open(tmp_path / "run")
    assert not in_memory(tmp_path), "a training that goes on removes its checkpoints"
    assert unfinished.step == 1
    opened(tmp_path / "run", *words, resume=True).train()
    loaded = LoadedRun.open(tmp_path / "run")
    planes = loaded.model.state_dict()["entities.human.deformation.planes.time"]
    assert sum(in_memory(tmp_path)) < 0.75 * planes.nbytes, "the system reads ahead, by 2 MB"
    assert torch.isfinite(planes).all() and sum(in_memory(tmp_path)) >= planes.nbytes


def test_a_resumed_training_in_windows_equals_an_unbroken_one(tmp_path: Path) -> None:
    settings = ("train.chunk=6", "train.checkpoint_every=13")
    unbroken, broken = (opened(tmp_path / n, *settings) for n in ("one", "two"))
    unbroken.train()
    broken.trainer.train(until=13)
    broken.run.unlock()
    again = opened(tmp_path / "two", *settings, resume=True)
    assert again.trainer.step == 13
    again.train()
    one, two = unbroken.trainer.model.state_dict(), again.trainer.model.state_dict()
    for name, values in one.items():
        assert torch.equal(values, two[name]), name


def test_what_does_not_grow_with_the_clip_is_trained_at_once(tmp_path: Path) -> None:
    short = opened(tmp_path / "short", "train.chunk=24")
    assert short.trainer.windows is not None
    assert short.trainer.windows.sentence() == (
        "trained at once: all frames fit in one window of 24"
    )
    still = Session.open(CLIP, "static", out=tmp_path / "still", overrides=["train.chunk=6"])
    assert still.trainer.windows is not None
    assert "no parameter of this model grows with the clip" in still.trainer.windows.sentence()
    with pytest.raises(SpecError, match="chunk"):
        Spec.load("hoigs", overrides=["train.chunk=1"])


def test_rows_of_gaussians_whose_number_changes_stay_whole(tmp_path: Path) -> None:
    session = opened(tmp_path / "run", "train.chunk=6", "model.object.density.use=density:adc")
    assert session.trainer.windows is not None
    of_the_human = {f"entities.human.deformation.{part}planes.time" for part in ("", "nonrigid.")}
    assert set(session.trainer.windows.names) == of_the_human


def test_rows_move_as_adam_would_have_moved_them_without_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    parameter = nn.Parameter(torch.rand(2, 6, 3, generator=generator))
    adam = torch.optim.Adam([parameter], lr=0.01, eps=1e-15)
    kept: list[tuple[Tensor, ...]] = []
    schedule = Schedule(0.01, 0.001, decay_from=0.4)
    rates = np.array([schedule.at(step / 12) for step in range(200)])
    for step in range(12):
        adam.param_groups[0]["lr"] = rates[step]
        parameter.grad = torch.zeros_like(parameter)
        if step < 5:  # the later a row, the longer has it had no gradient
            parameter.grad[:, : 5 - step] = torch.rand(2, 5 - step, 3, generator=generator)
        adam.step()
        state = adam.state[parameter]
        now = (parameter.detach(), state["exp_avg"], state["exp_avg_sq"])
        kept.append(tuple(values.clone() for values in now))
    last = np.array([5, 7, 5, 9, 12, 5])
    old = [torch.stack([kept[n - 1][i][:, r] for r, n in enumerate(last)], 1) for i in range(3)]
    found = _caught_up(old[0], old[1], old[2], last, 12, lambda n: rates[n - 1])
    for values, expected in zip(found, kept[-1], strict=True):
        torch.testing.assert_close(values, expected)


def test_windows_train_as_the_whole_does(tmp_path: Path) -> None:
    """But for penalties along time, which see one window at a time."""
    without = ["train.loss.regularizers={tangent: 0, acceleration: 0, time_smoothness: 0, "
               "time_sparsity: 0}", "train.warmup.motion=0"]  # fmt: skip
    models = []
    for name, settings in (("whole", []), ("windows", ["train.chunk=3"])):
        session = opened(tmp_path / name, *without, *settings)
        session.train()
        models.append(session.trainer.model.eval())
    whole, windows = (drawn(model, session.clip) for model in models)
    for frame, numbers in zip(windows, whole, strict=True):
        torch.testing.assert_close(frame, numbers, atol=2e-3, rtol=2e-3)

"""What a trained model can do without: Gaussians, knots, time planes, tokens, bits."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from small_models import GIVEN, NAME, as_composed, drawn, validator_of

from hoigs.core.errors import CheckpointError, HoigsError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import RatesSpec
from hoigs.core.values.clip import Clip, FrameStore
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange
from hoigs.plugins.deformation.static import Static
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.runs.checkpoint import latest_checkpoint, load_checkpoint
from hoigs.runs.clip_source import read_clip
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.options import RunOptions
from hoigs.studies.needs import prune
from hoigs.studies.needs.after_training import add_to_answer, finish, table
from hoigs.studies.needs.compress import compress
from hoigs.studies.needs.prune import (
    Cut,
    Pruning,
    as_one,
    from_one,
    removable_rows,
    remove_rows,
    sensitivities,
    time_planes,
)
from hoigs.studies.needs.search_space import StepBudget
from hoigs.studies.needs.trial import SealedFrameError, Validator, sealed_view
from hoigs.training.session import Session
from hoigs.training.trainer import Trainer


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield read_clip(NAME)


# -- Gaussians -------------------------------------------------------------------------------------


def scattered(clip: Clip, count: int = 12) -> SceneModel:
    """A few large Gaussians before the camera of the clip, some behind others."""
    camera = clip.cameras[0]
    generator = torch.Generator().manual_seed(3)
    ahead = torch.linalg.inv(camera.world_to_camera)
    local = torch.rand(count, 3, generator=generator) * torch.tensor([1.2, 1.2, 1.0])
    local += torch.tensor([-0.6, -0.6, 2.5])
    points = local @ ahead[:3, :3].T + ahead[:3, 3]
    canonical = Gaussians.from_points(
        points, torch.rand(count, 3, generator=generator), scales=0.25, opacity=0.5
    )
    return SceneModel({"scene": Entity(canonical, Static())}, rasterizer=OracleRasterizer())


def test_sensitivity_is_the_squared_change_of_the_picture(clip):
    """Against drawing without each Gaussian in turn."""
    model = scattered(clip)
    found = sensitivities(model, clip, [0], probes=400)["scene"]
    with torch.no_grad():
        state = model(clip.moments[0]).joined()

        def draw(subset):
            request = RenderRequest(subset=subset)
            return model.rasterizer.render(state, clip.cameras[0], request).color

        whole = draw(None)
        true = []
        for row in range(len(state)):
            subset = torch.ones(len(state), dtype=torch.bool)
            subset[row] = False
            true.append(float((draw(subset) - whole).square().sum()))
    truth = torch.tensor(true).to(found)
    assert truth.max() > 4 * truth.min()
    torch.testing.assert_close(found, truth, rtol=0.35, atol=0.02 * float(truth.max()))
    assert torch.corrcoef(torch.stack((found, truth)))[0, 1] > 0.98


def test_gaussians_that_show_nowhere_go_and_others_stay(clip):
    trained = as_composed(clip)
    model, scene = trained.model, trained.model.entity("scene")
    with torch.no_grad():
        scene.opacity_logits[50:] = -12.0
    validator = validator_of(clip)
    before = validator.score(model)
    scores = sensitivities(model, clip, clip.split["train"][:6])["scene"]
    rows, cost = removable_rows(validator, model, "scene", scores, before, 0.01)
    assert cost <= 0.01 and len(rows) >= 0.8 * (len(scene) - 50)
    drawn_before = drawn(trained, clip.split["train"][3])
    kept = torch.ones(len(scene), dtype=torch.bool)
    kept[rows] = False
    opacities = scene.opacities if hasattr(scene, "opacities") else scene.canonical.opacities
    assert opacities[~kept].max() <= opacities.median()
    remove_rows(model, "scene", rows)
    assert len(model.entity("scene")) == int(kept.sum())
    change = (drawn(trained, clip.split["train"][3]) - drawn_before).square().mean()
    assert change < 1e-3


# -- planes, tokens --------------------------------------------------------------------------------


def test_time_planes_that_are_one_go_without_a_trace(clip):
    trained = as_composed(clip, "model.human.features=null", "interaction.use=interaction:none",
                          "model.object.features=null")  # fmt: skip
    planes = time_planes(trained.model.entity("human").deformation)
    assert planes and from_one(planes) == 0
    pruning = Pruning(trained, validator_of(clip))
    pruning.planes()
    after = pruning.trained
    assert after.spec.model["human"].deformation.settings["time_resolution"] == 0
    assert not time_planes(after.model.entity("human").deformation)
    position = clip.split["train"][4]
    torch.testing.assert_close(drawn(after, position), drawn(trained, position))
    assert pruning.cuts[0].after == 0 and "one everywhere" in pruning.cuts[0].why


def test_planes_come_back_after_a_look(clip):
    planes = time_planes(as_composed(clip).model.entity("human").deformation)
    with torch.no_grad():
        planes[0].normal_()
    kept = planes[0].detach().clone()
    with as_one(planes):
        assert from_one(planes) == 0
    assert torch.equal(planes[0], kept)


class Redrawn(FrameStore):
    """Other images for the frames of a clip."""

    def __init__(self, base: FrameStore, images: dict[int, torch.Tensor]) -> None:
        self.base, self.images = base, images

    def image(self, position):
        return self.images[position]

    def mask(self, entity, position):
        return self.base.mask(entity, position)

    def depth(self, position):
        return self.base.depth(position)


@pytest.mark.parametrize("strong", [False, True])
def test_interaction_that_does_nothing_goes_and_one_that_does_stays(clip, strong):
    """Judged by frames that the model itself has drawn, so that all it does is right."""
    trained = as_composed(clip)
    if strong:
        with torch.no_grad():
            for name, parameter in trained.model.interaction.named_parameters():
                if name.endswith("bias"):
                    parameter += 3.0
    images = {p: (255 * drawn(trained, p)).round().clamp(0, 255).byte() for p in range(len(clip))}
    validator = validator_of(replace(clip, store=Redrawn(clip.store, images)))
    pruning = Pruning(trained, validator)
    pruning.tokens()
    gone = pruning.trained.spec.interaction.use == "interaction:none"
    assert gone is not strong
    assert (pruning.trained.spec.model["object"].features is None) is not strong
    assert (pruning.cuts[0].drop > 0.05) is strong


@pytest.mark.parametrize("settle", [1.0, 0.02])
def test_tuning_settles_and_leaves_the_spec_as_it_was(clip, monkeypatch, settle):
    trained = as_composed(clip)
    trained.spec.train.rates.settle = settle
    rates = trained.spec.train.rates.model_copy()
    seen: list[RatesSpec] = []

    class Watched(Trainer):
        def train(self, *args, **kwargs):
            seen.append(self.spec.rates)
            super().train(*args, **kwargs)

    monkeypatch.setattr(prune, "Trainer", Watched)
    pruning = Pruning(trained, validator_of(clip))
    pruning.tune()
    assert not seen  # nothing was pruned
    pruning.cuts = [Cut("Gaussians", "Gaussians", 2, 1, 0.0, "")]
    pruning.tune()
    assert seen == [rates.model_copy(update={"settle": min(settle, prune.SETTLE)})]
    assert trained.spec.train.rates == rates


def test_no_test_frame_is_looked_at(clip):
    """What `finish` works on raises for them, so that a finished one has read none."""
    view = sealed_view(clip)
    model = as_composed(clip).model
    with pytest.raises(SealedFrameError, match=rf"\b{clip.split['test'][0]}\b"):
        Validator(view, clip.split["test"][:1], StepBudget(1e6)).score(model)
    assert Validator(view, clip.split["train"][:1], StepBudget(1e6)).score(model).psnr
    assert list(view.split) == ["train"] and view.held_out is None


# -- a run -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory, clip):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        folder = tmp_path_factory.mktemp("runs") / "mine"
        session = Session.open(NAME, "hoigs", out=folder, overrides=GIVEN)
        session.train()
        yield folder


def test_a_compact_run_reads_back(run, tmp_path):
    done = compress(run, out=tmp_path / "small")
    assert done.bytes_after < 0.5 * done.bytes_before and abs(done.drop) < 0.1
    whole, small = LoadedRun.open(run), LoadedRun.open(tmp_path / "small")
    assert whole.spec == small.spec and whole.step == small.step
    position = whole.clip.split["test"][1]
    a, b = (m.model.render(m.clip.moments[position], m.clip.cameras[position]).color.detach()
            for m in (whole, small))  # fmt: skip
    assert (a - b).abs().mean() < 2 / 255 and not torch.equal(a, b)
    size = sum(f.stat().st_size for f in (tmp_path / "small" / "checkpoints").iterdir())
    assert size == done.bytes_after
    with pytest.raises(HoigsError, match="already exists"):
        compress(run, out=tmp_path / "small")
    with pytest.raises(CheckpointError, match="pruned or compressed"):
        Session.open(NAME, whole.spec, out=tmp_path / "small", resume=True)


def test_a_damaged_compact_run_is_told(run, tmp_path):
    compress(run, out=tmp_path / "small")
    weights = next((tmp_path / "small" / "checkpoints").glob("*.safetensors"))
    data = bytearray(weights.read_bytes())
    data[-500] ^= 0x10
    weights.write_bytes(bytes(data))
    with pytest.raises(CheckpointError, match=r"step_000030\.safetensors: .*(damaged|restore it)"):
        LoadedRun.open(tmp_path / "small")
    weights.write_bytes(bytes(data[:-2000]))
    with pytest.raises(CheckpointError, match="damaged or absent"):
        load_checkpoint(latest_checkpoint(tmp_path / "small" / "checkpoints"))


def test_a_pruned_run_is_a_run(run, tmp_path):
    import shutil

    mine = run.with_name("pruned")
    shutil.copytree(run, mine)
    compact = run.with_name("pruned-compact")
    told: list[str] = []
    after = finish(
        mine, compact, options=RunOptions(device="cpu"), report=told.append, clock=(2.0, 4.0, 5.0)
    )
    again, small = LoadedRun.open(mine), LoadedRun.open(compact)
    assert again.model.count() == small.model.count()
    assert again.spec.model_hash() == small.spec.model_hash()
    assert (
        sum(p.numel() for p in again.model.parameters() if p.requires_grad) == (after.parameters[1])
    )
    assert after.parameters[1] <= after.parameters[0] and after.spent <= after.limit
    assert after.whole_cost == pytest.approx((6.0 + after.seconds) / 5.0)
    assert (mine / "metrics.jsonl").read_text() == (run / "metrics.jsonl").read_text()
    assert not list(run.parent.glob(".*part"))
    columns, rows = table(after)
    assert {len(row) for row in rows} == {len(columns)}
    answer = tmp_path / "answer"
    answer.mkdir()
    (answer / "needs.md").write_text("# What it needs\n")
    (answer / "needs.json").write_text('{"clip": "x"}')
    add_to_answer(after, answer)
    add_to_answer(after, answer)
    text = (answer / "needs.md").read_text()
    assert text.count("## After the training") == 1 and "Gaussians of scene" in text
    assert "full trainings" in text
    assert json.loads((answer / "needs.json").read_text())["after"]["bytes"][1] > 0


def test_keeping_rows_is_what_pruning_does_to_every_entity(clip):
    """Every deformation of the spec follows the loss of Gaussians and a checkpoint of it."""
    trained = as_composed(clip)
    for name in trained.model.entities:
        entity = trained.model.entity(name)
        mask = torch.arange(len(entity)) % 3 != 0
        entity.apply_topology(TopologyChange.keep(mask), entity.canonical[mask])
    less = trained.recomposed({"train.seed": 1})
    assert less.model.count() == trained.model.count()
    torch.testing.assert_close(drawn(less, 2), drawn(trained, 2))

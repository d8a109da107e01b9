"""The baselines: what is native to each, what is matched in all, and that each learns."""

from __future__ import annotations

import pytest
from matched import matched, score

from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.density import DensityControl
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.spec.files import builtin_specs, builtin_summary
from hoigs.core.spec.schema import Spec
from hoigs.core.spec.train_schema import RatesSpec
from hoigs.core.values.moment import Moment
from hoigs.training.trainer import Trainer

STEPS = 150
FIELD = "model.scene.deformation"

# how each is made small enough for a test; what it is stays
SMALL: dict[str, tuple[str, ...]] = {
    "static-3dgs": (),
    "4dgs": (f"{FIELD}.resolution=12", f"{FIELD}.multires=[1,2]", f"{FIELD}.width=32"),
    "d3dgs": (f"{FIELD}.width=40", f"{FIELD}.depth=4"),
    "e-d3dgs": (f"{FIELD}.width=32", f"{FIELD}.table=32"),
    "k-planes-gs": (f"{FIELD}.resolution=12", f"{FIELD}.multires=[1,2]", f"{FIELD}.width=32"),
    "nerfies-gs": (f"{FIELD}.width=40", f"{FIELD}.elastic_points=32"),
    "hypernerf-gs": (
        f"{FIELD}.width=40",
        f"{FIELD}.ambient_width=24",
        f"{FIELD}.elastic_points=32",
    ),
}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("name", SMALL)
def test_it_learns(name, clip):
    small = ("model.scene.points=500", "model.scene.density.cap=600", *SMALL[name])
    run = (f"train.steps={STEPS}", "train.preview_every=0")
    spec = Spec.load(f"{name}@matched", overrides=[*small, *run])
    model = compose(spec, clip)
    trainer = Trainer(model, clip, spec.train, density=compose_density(spec, clip))
    model.eval()
    untrained = score(model, clip)
    trainer.train()
    assert score(model, clip) > untrained + 5
    assert not trainer.guard.skipped
    first, last = (model(Moment(time)).gaussians["scene"] for time in (0.0, 1.0))
    moves = (first.means - last.means).norm(dim=-1).max().item()
    assert moves == 0 if name == "static-3dgs" else moves > 1e-3


@pytest.fixture
def native(request, clip) -> tuple[Spec, DeformationModel, DensityControl]:
    """A native spec, with few points only, its deformation and its density control."""
    spec = Spec.load(request.param, overrides=["model.scene.points=50"])
    deformation = compose(spec, clip).entity("scene").deformation
    deformation.set_progress(0.0)
    return spec, deformation, compose_density(spec, clip)["scene"]


def of(name: str):
    return pytest.mark.parametrize("native", [name], indirect=True)


@of("static-3dgs")
def test_3dgs(native):
    spec, _, density = native
    assert spec.train.steps == 30_000 and spec.train.sh_interval == 1000
    assert (density.config.threshold, density.config.reset_every) == (2e-4, 3000)
    assert density.window.refines(600, 30_000) and not density.window.refines(400, 30_000)
    assert not density.window.refines(15_100, 30_000)
    assert spec.train.rates.sh_rest == 0.05 and spec.model["scene"].sh_degree == 3
    assert spec.train.loss.depth == 0  # its authors had none


@of("4dgs")
def test_4dgs(native, clip):
    spec, field, density = native
    assert field.config.time_span == "half" and field.config.turning == "added"
    assert spec.train.loss.lambda_dssim == 0
    assert spec.train.steps == 3000 + 14_000
    assert field.still  # 3000 static steps
    field.set_progress(2999 / 17_000)
    assert field.still
    field.set_progress(3001 / 17_000)
    assert not field.still
    assert density.cap == 360_000 and density.config.reset_every is None
    assert set(spec.train.rates.by_extent) == {"means", "planes", "networks"}
    assert field.planes.width == 48 and field.planes.time[2].shape[1] == 150


@of("d3dgs")
def test_d3dgs(native):
    spec, mlp, density = native
    assert (mlp.config.space, mlp.config.turning) == ("activated", "added")
    assert mlp.heads.weight.abs().max() > 0  # torch's default start, not rest
    assert mlp.trunk.skip == 5 and len(mlp.trunk.layers) == 8  # "after layer 4"
    assert (
        density.absolute_gradients
        and density.config.threshold == density.config.split_threshold == 7e-4
    )
    assert spec.train.steps == 40_000 and mlp.config.start * 40_000 == pytest.approx(3000)
    assert mlp.noise_now() == pytest.approx(0.1 / 12)  # a tenth of a frame of 12
    mlp.set_progress(0.5)
    assert mlp.noise_now() == 0
    assert spec.train.loss.lambda_dssim == 0.2


@of("e-d3dgs")
def test_e_d3dgs(native):
    spec, embedded, density = native
    assert not embedded.embedding.any() and not embedded.time_table.any()  # zero starts
    assert embedded.config.table_smoothness == "last-row" and embedded.config.turning == "added"
    assert embedded.fine_rows == 20
    embedded.set_progress(0.25)
    assert embedded.fine_rows == 100  # 20 000 of 80 000 steps
    assert spec.train.steps == 80_000 and density.config.reset_every is None
    assert spec.train.loss.lambda_dssim == 0
    assert spec.train.loss.regularizers["embedding_smoothness"] == 1


@of("k-planes-gs")
def test_k_planes(native):
    spec, field, _ = native
    assert set(field.net.heads) == {"means", "opacity", "sh"}
    assert [planes.shape[1] for planes in field.planes.space] == [64, 128, 256, 512]
    assert spec.train.loss.regularizers["time_smoothness"] == 0.01
    assert spec.train.rates.planes == 0.01


@of("nerfies-gs")
def test_nerfies(native, clip):
    _, field, _ = native
    assert field.window == 0  # a smooth field first
    field.set_progress(0.16)
    assert field.window == pytest.approx(4)
    field.set_progress(0.32)
    assert field.window is None
    assert field.codes.codes.shape == (len(clip.split["train"]), 8)
    assert not field.config.ambient


@of("hypernerf-gs")
def test_hypernerf(native):
    _, field, _ = native
    assert field.config.ambient == 2 and field.coordinates.out_features == 2


@pytest.mark.parametrize("name", [n for n in builtin_specs() if n.endswith("-gs")])
def test_compositions_say_what_they_are(name):
    assert "in the spirit of" in builtin_summary(name)
    assert "not a reproduction" in builtin_summary(name)


@pytest.mark.parametrize("name", SMALL)
def test_matched_differs_in_the_method_alone(name):
    ours, hoigs = matched(name)
    block, theirs = ours.model["scene"], hoigs.model
    assert (block.sh_degree, block.opacity) == (theirs["scene"].sh_degree, theirs["scene"].opacity)
    # one set, in the place of three: as many Gaussians as these have together
    assert block.points == sum(theirs[kind].points for kind in ("scene", "human", "object"))
    extra = theirs["human"].points + theirs["object"].points
    density = {**theirs["scene"].density.settings, "cap": f"auto+{extra}"}
    assert theirs["scene"].density.settings["cap"] == "auto"
    assert block.density.settings == density and block.density.use == theirs["scene"].density.use
    # and the field is the native one, but for what the file says
    native = Spec.load(name)
    assert block.deformation.use == native.model["scene"].deformation.use
    assert ours.train.loss.regularizers == native.train.loss.regularizers


def test_native_rates_are_the_published_ones():
    def end(start: float, final: float, step: int, of: int) -> float:
        return start * (final / start) ** (step / of)

    rates = Spec.load("4dgs").train.rates
    assert rates.networks_final == pytest.approx(end(1.6e-4, 1.6e-5, 14, 20), rel=0.01)
    assert rates.planes_final == pytest.approx(end(1.6e-3, 1.6e-4, 14, 20), rel=0.01)
    assert rates.means_final == pytest.approx(end(1.6e-4, 1.6e-6, 14, 20), rel=0.01)
    for name in SMALL:
        rates = Spec.load(name).train.rates
        assert rates.means == 1.6e-4 != RatesSpec().means
        assert (rates.sh, rates.opacity, rates.rotation) == (2.5e-3, 0.05, 1e-3)

"""SceneModel refuses what does not fit, by name."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import hoigs as h
from hoigs.core.errors import PluginError, SpecError
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prompts import with_prompts
from hoigs.testing.material import TinyMotion, camera_at, moment_at

COUNT = 20


class Coordinates(h.FeatureExtractor):
    """Tokens of all Gaussians but the last `few`."""

    width = 3

    def __init__(self, few: int = 0, tokens: str = "any", width: int = 3) -> None:
        super().__init__()
        self.few, self.tokens, self.width = few, tokens, width

    def forward(self, deformation, canonical, moment):
        places = deformation.means_at(canonical, moment)[: len(canonical.means) - self.few]
        return h.Tokens(places, places)


class Gives(h.InteractionModule):
    """Zeros of some shape, or a displacement for each token."""

    def __init__(self, to: str = "cup", **shapes: tuple[int, ...]) -> None:
        super().__init__()
        self.to, self.shapes = to, shapes

    def forward(self, tokens, roles):
        parts = {part: torch.zeros(shape) for part, shape in self.shapes.items()}
        return {self.to: h.Residual(**parts or {"means": 0.1 * tokens["cup"].features})}


def cloud(count: int = COUNT) -> h.Gaussians:
    generator = torch.Generator().manual_seed(0)
    return h.Gaussians.from_points(torch.rand(count, 3, generator=generator), scales=0.1)


def scene(features=None, interaction=None, name: str = "cup") -> h.SceneModel:
    cup = h.Entity(cloud(), TinyMotion(), features, kind="object")
    return h.SceneModel({name: cup}, interaction=interaction, rasterizer=h.TorchRasterizer())


def test_tokens_and_residuals_that_fit() -> None:
    scene(Coordinates(tokens="gaussian"), Gives())(moment_at(0.4))
    scene(Coordinates(few=4), Gives(means=(COUNT, 3)))(moment_at(0.4))


@pytest.mark.parametrize(
    ("features", "interaction", "facts"),
    [
        (Coordinates(width=5), Gives(), ("'cup'", "Coordinates", "[20, 3]", "[M, 5]")),
        (Coordinates(4, "gaussian"), Gives(), ("Coordinates", "'gaussian'", "20", "16")),
        (Coordinates(0, "part"), Gives(), ("Coordinates", "'part'", "16", "20")),
        # the interaction takes each token for a Gaussian: both are named
        (Coordinates(4), Gives(), ("Gives", "Coordinates", "[16, 3]", "[20, 3]", "16 tokens")),
        (Coordinates(), Gives(means=(1, 3)), ("Gives", "[1, 3]", "[20, 3]")),
        (
            Coordinates(),
            Gives(pose=(21, 3)),
            ("Gives", "[21, 3]", "[51, 3]"),
        ),
        (Coordinates(), Gives("cupp"), ("Gives", "'cupp'", "'cup'")),
    ],
)
def test_a_wrong_shape_names_who_gave_it(features, interaction, facts, as_users_run_it) -> None:
    with pytest.raises(PluginError) as caught:
        scene(features, interaction)(moment_at(0.4))
    for fact in facts:
        assert fact in str(caught.value)


def test_arguments_of_another_type_are_named(as_users_run_it) -> None:
    model, moment, camera = scene(), moment_at(0.4), camera_at(0.4)
    for call, facts in (
        (lambda: model.render(camera, moment), ("moment", "Camera", "Moment")),
        (lambda: model.render(moment, moment), ("camera", "Moment", "Camera")),
        (lambda: model(0.4), ("moment", "float", "Moment")),
        (lambda: h.Entity(TinyMotion(), cloud()), ("canonical", "TinyMotion", "Gaussians")),
        (lambda: h.Entity(cloud(), TinyMotion), ("deformation", "TinyMotion", "DeformationModel")),
        (
            lambda: h.SceneModel({"cup": cloud()}, rasterizer=h.TorchRasterizer()),
            ("'cup'", "Gaussians", "Entity"),
        ),
        (
            lambda: h.SceneModel(model.entities, rasterizer=h.TorchRasterizer),
            ("rasterizer", "class TorchRasterizer", "Rasterizer"),
        ),
    ):
        with pytest.raises(TypeError) as caught:
            call()
        for fact in facts:
            assert fact in str(caught.value)


@pytest.mark.parametrize("name", ["red.ball", "", "a/b", "train", "type"])
def test_names_that_no_entity_can_have_are_refused_everywhere(name) -> None:
    with pytest.raises(ValueError, match="entity name") as caught:
        scene(name=name)
    assert repr(name) in str(caught.value)
    if name and "/" not in name:
        with pytest.raises(SpecError, match=name):
            with_prompts(PrepareOptions(object=f"{name}=3,4"))


def test_a_model_shows_its_entities_in_a_notebook() -> None:
    shown = scene(Coordinates(), Gives())._repr_html_()
    for fact in ("cup", str(COUNT), "TinyMotion", "Coordinates", "Gives", "TorchRasterizer"):
        assert fact in shown


def test_a_model_is_copied_after_a_training_pass() -> None:
    model = scene(Coordinates(), Gives()).train()
    output = model.render(moment_at(0.4), camera_at(0.4)).color
    twin = torch.optim.swa_utils.AveragedModel(model).module
    assert torch.equal(twin.render(moment_at(0.4), camera_at(0.4)).color, output)
    assert isinstance(twin, nn.Module) and twin is not model

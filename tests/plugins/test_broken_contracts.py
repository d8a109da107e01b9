"""A plugin that breaks each contract between components, and what its author is told, and when."""

from __future__ import annotations

import textwrap

import pytest
from fake_plugins import PluginFolder

from hoigs.core.errors import HoigsError, PluginError, SpecError
from hoigs.core.model.compose import compose
from hoigs.core.spec.schema import Spec, require_fitting
from hoigs.testing.material import tiny_clip
from hoigs.training.trainer import Trainer

SOURCE = """
import torch
from torch import nn

import hoigs
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import Residual, Tokens


class Sixteen(FeatureExtractor):
    "Sixteen tokens, of which nothing is said."

    width = 3

    def forward(self, deformation, canonical, moment):
        means = deformation(canonical, moment).means
        rows = torch.arange(16) % len(means)
        return Tokens(means[rows], means[rows])


class Parts(Sixteen):
    tokens = "part"


class Broadcast(InteractionModule):
    "One displacement for all Gaussians, which torch would broadcast."

    def forward(self, tokens, roles):
        return {n: Residual(means=torch.zeros(1, 3)) for n in tokens if roles[n].kind == "object"}


class Spread(InteractionModule):
    "The mean token moves all Gaussians, however many there are: breaks nothing."

    def bind(self, widths, kinds):
        self.push = nn.Linear(3, 3)

    def forward(self, tokens, roles):
        return {
            n: Residual(means=self.push(t.features.mean(0)).expand(roles[n].gaussians, 3))
            for n, t in tokens.items()
            if roles[n].kind == "object"
        }


class OddRate(hoigs.DeformationModel):
    rates = {"swing": "fast"}
    input_space = "world"

    def bind(self, canonical):
        self.swing = nn.Parameter(torch.zeros(3))

    def forward(self, canonical, moment, residual=None):
        return canonical.replace(means=canonical.means + self.swing * moment.time)


class QuietOddRate(OddRate):
    "Declares it on the instance, where no class tells."

    rates = {}

    def bind(self, canonical):
        super().bind(canonical)
        self.rates = {"swing": "fast"}


@hookimpl
def hoigs_components():
    yield Component("body:tiny", "hoigs.testing.material:TinyBody")
    for key, name in {
        "features:sixteen": "Sixteen", "features:parts": "Parts",
        "interaction:broadcast": "Broadcast", "interaction:spread": "Spread",
        "deformation:odd-rate": "OddRate", "deformation:quiet-odd-rate": "QuietOddRate",
    }.items():
        yield Component(key, f"{__name__}:{name}")
"""


@pytest.fixture(scope="module")
def registry(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        plugins = PluginFolder(folder)
        plugins.add("acme", textwrap.dedent(SOURCE))
        yield plugins.registry()


def spec(registry, object_: str, more: str = "") -> Spec:
    text = f"""
    extends: hoigs
    name: mine
    model:
      human: {{points: 60}}
      scene: {{points: 60}}
      object: {{points: 60, {object_}}}
    {more}
    """
    return Spec.parse(textwrap.dedent(text), source="mine.yaml", registry=registry)


@pytest.fixture(scope="module")
def clip():
    return tiny_clip()


SIXTEEN, PARTS = (f'features: {{use: "features:{name}"}}' for name in ("sixteen", "parts"))
ODD, QUIET = (
    f'features: null, deformation: {{use: "deformation:{name}odd-rate"}}' for name in ("", "quiet-")
)
BROADCAST, SPREAD = (f'interaction: {{use: "interaction:{n}"}}' for n in ("broadcast", "spread"))
RATE = "train.rates has means, sh, opacity"


@pytest.mark.parametrize(
    ("block", "words"),
    [
        (PARTS, ("CrossAttention needs a token for each Gaussian of each object", "Parts gives")),
        (ODD, ('deformation:odd-rate declares rates["swing"] as "fast"', RATE)),
    ],
)
def test_told_without_a_clip(registry, block, words):
    with pytest.raises(SpecError) as told:
        require_fitting(spec(registry, block), registry)
    message = str(told.value)
    assert message.startswith("mine.yaml:7:") and all(word in message for word in words), message


@pytest.mark.parametrize(
    ("block", "more", "words"),
    [
        (SIXTEEN, "", ("Sixteen, gave 16 tokens", "a token for each Gaussian", "[16, 3]")),
        (PARTS, "", ("interaction: CrossAttention needs a token for each Gaussian", "Parts gives")),
        (SIXTEEN, BROADCAST, ("Broadcast moves the means of 'object' by [1, 3]",)),
    ],
)
def test_told_before_the_first_step(registry, clip, block, more, words):
    with pytest.raises(HoigsError) as told:
        compose(spec(registry, block, more), clip, registry)
    assert all(word in str(told.value) for word in words), told.value


def test_a_rate_that_no_class_declares(registry, clip):
    quiet = spec(registry, QUIET, 'interaction: {use: "interaction:none"}')
    require_fitting(quiet, registry)
    with pytest.raises(PluginError, match=r"object.deformation.swing declares the rate 'fast'"):
        Trainer(compose(quiet, clip, registry), clip, quiet.train)


def test_an_interaction_may_read_any_number_of_tokens(registry, clip):
    fits = spec(registry, SIXTEEN, SPREAD)
    require_fitting(fits, registry)
    model = compose(fits, clip, registry)
    state = model(clip.moments[0])
    assert len(state.tokens["object"].features) == 16
    assert state.residuals["object"].means.shape == (len(model.entity("object")), 3)

"""A run with a decoder: trained, resumed, opened, shown and exported as any other, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import hoigs as h
from hoigs.core.clip_folder.write import write_clip
from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.testing.material import moment_at, tiny_clip, tiny_scene
from hoigs.viewing.playback import Playback
from hoigs.viewing.player.page import write_page
from hoigs.viewing.viewer.run_drawing import Look, RunDrawing

PAPERS = Path(__file__).parents[2] / "examples" / "papers"
PLUGIN = PAPERS / "spacetime_gaussians.py"
SMALL = ["model.scene.points=64", "train.preview_every=0", "train.checkpoint_every=3"]


def scenery() -> h.Clip:
    """The tiny clip with nobody in it."""
    return replace(tiny_clip(), kinds={}, bodies={}, objects={})


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("decoded")
    clip = folder / "clip"
    write_clip(scenery(), clip)
    h.train(
        clip, PAPERS / "spacetime-gaussians.yaml", out=folder / "run", plugins=[PLUGIN],
        overrides=[*SMALL, "train.steps=6"], evaluate=False, device="cpu",
        rasterizer="torch",
    )  # fmt: skip
    return folder / "run"


@pytest.fixture(scope="module")
def loaded(trained):
    # whose colours do not depend on how many channels are drawn with them, to the last bit
    return h.open_run(trained, rasterizer="warp", device="cpu", plugins=[PLUGIN])


def first_view(loaded):
    return loaded.clip.moments[3], loaded.clip.cameras[3]


def test_it_is_trained_and_saved(trained, loaded):
    decoder = loaded.model.decoder
    fresh = h.compose(loaded.spec, loaded.clip, default_registry(plugin_files=[PLUGIN])).decoder
    for (name, now), before in zip(decoder.named_parameters(), fresh.parameters(), strict=True):
        assert not torch.equal(now, before), name
    again = h.open_run(trained, device="cpu", plugins=[PLUGIN]).model.decoder
    assert all(torch.equal(a, b) for a, b in zip(again.parameters(), decoder.parameters()))


def test_pictures_are_decoded_everywhere(loaded):
    moment, camera = first_view(loaded)
    with torch.no_grad():
        wanted = loaded.model.render(moment, camera)
        state = loaded.model(moment)
        plain = loaded.model.rasterize(state.joined(), camera)
        asked = RenderRequest(features=torch.ones(len(state.joined()), 2))
        drawn = loaded.model.draw(state.joined(), camera, asked, moment)
    assert (wanted.color - plain.color).abs().max() > 1e-3 and wanted.features is None
    assert drawn.features.shape[-1] == 2 and torch.equal(drawn.color, wanted.color)
    play = Playback(loaded.model, [first_view(loaded)], mode="cached")
    torch.testing.assert_close(play(moment, camera).color, wanted.color, atol=1e-5, rtol=0)
    shown, everything = RunDrawing(loaded), frozenset(loaded.model.entities)
    picture = shown.draw(moment.index, camera, Look(entities=everything)).image
    expected = (wanted.color.clamp(0, 1) * 255).round().to(torch.uint8)
    assert abs(picture.astype(int) - expected.numpy().astype(int)).max() <= 1
    false = shown.draw(moment.index, camera, Look("entity", everything)).image
    assert (false != picture).any()


def test_a_draw_without_a_moment_says_what_is_missing(loaded):
    moment, camera = first_view(loaded)
    with pytest.raises(HoigsError, match=r"FeatureDecoder, needs the moment"):
        loaded.model.draw(loaded.model(moment).joined(), camera)


def test_colours_alone_are_not_exported(trained, loaded, tmp_path):
    with pytest.raises(HoigsError, match=r"page run\.html .*FeatureDecoder, makes the pictures"):
        write_page(loaded, tmp_path / "run.html")
    with pytest.raises(HoigsError, match=r"PlyExporter.*FeatureDecoder, makes the pict"):
        h.export(trained, format="ply", out=tmp_path / "ply", plugins=[PLUGIN], device="cpu")
    assert not (tmp_path / "ply").exists()


def test_resumed_in_the_middle_it_ends_the_same(trained, tmp_path):
    def trainer(steps):
        registry = default_registry(plugin_files=[PLUGIN])
        spec = Spec.load(
            PAPERS / "spacetime-gaussians.yaml",
            overrides=[*SMALL, "train.steps=6", "rasterizer.use=rasterizer:torch"],
            registry=registry,
        )
        made = h.Trainer(h.compose(spec, scenery(), registry), scenery(), spec.train)
        made.train(until=steps)
        return made

    whole, half = trainer(6), trainer(3)
    middle = half.checkpoint()
    other = trainer(0)
    other.resume(middle)
    other.train()
    for (name, one), two in zip(
        whole.model.named_parameters(), other.model.parameters(), strict=True
    ):
        assert torch.equal(one, two), name


class Wrong(h.Decoder):
    channels = 2

    def forward(self, drawn, camera, moment):
        return drawn.alpha


class Carries(h.DeformationModel):
    def __init__(self, channels):
        super().__init__()
        self.given = channels

    def forward(self, canonical, moment, residual=None):
        return canonical.replace(channels=torch.zeros(len(canonical), self.given))


def test_faults_have_names():
    scene = tiny_scene()
    made = h.SceneModel(dict(scene.entities), rasterizer=scene.rasterizer, decoder=Wrong())
    camera = tiny_clip().cameras[0]
    with pytest.raises(PluginError, match=r"decoder: .*Wrong gave a picture \[16, 20\]"):
        made.render(moment_at(0.3), camera)
    cup = h.Entity(scene.entity("object").canonical, Carries(5), kind="object")
    made = h.SceneModel({"cup": cup}, rasterizer=scene.rasterizer, decoder=Wrong())
    with pytest.raises(PluginError, match=r"'cup': .*Carries gave channels .* 5\].* 2\], as .*Wr"):
        made(moment_at(0.3))

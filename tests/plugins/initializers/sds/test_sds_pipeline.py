"""initializer:sds with tiny pipelines of random weights: they load, gradients flow, the loop
runs."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from pydantic import ValidationError

from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.interfaces.context import BuildContext
from hoigs.plugins.initializers.sds import SdsInitializer, SdsInitializerConfig
from hoigs.plugins.initializers.sds_distillation import distillation_loss
from hoigs.plugins.initializers.sds_pipelines import TextDenoiser, ViewDenoiser
from hoigs.rasterizers.warp import WarpRasterizer

LETTERS = "abcdefghijklmnopqrstuvwxyz,"
CPU = {"guidance": 5.0, "device": "cpu"}


def tiny_pipeline(folder: Path, *, views: bool = False, **schedule) -> Path:
    """A Stable Diffusion, or a Zero-1-to-3, of a few thousand random weights, as saved to disk."""
    diffusers = pytest.importorskip("diffusers", reason="the extra hoigs[sds] is not installed")
    transformers = pytest.importorskip("transformers", reason="the extra hoigs[sds]")
    torch.manual_seed(0)
    blocks = {"block_out_channels": (8, 16), "norm_num_groups": 4}
    diffusers.UNet2DConditionModel(
        sample_size=8, in_channels=8 if views else 4, out_channels=4, layers_per_block=1,
        cross_attention_dim=16, attention_head_dim=4, **blocks,
        down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
    ).save_pretrained(folder / "unet")  # fmt: skip
    diffusers.AutoencoderKL(
        latent_channels=4, sample_size=16, **blocks,
        down_block_types=("DownEncoderBlock2D",) * 2, up_block_types=("UpDecoderBlock2D",) * 2,
    ).save_pretrained(folder / "vae")  # fmt: skip
    diffusers.DDPMScheduler(
        beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012, **schedule
    ).save_pretrained(folder / "scheduler")
    shape = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    shape |= {"num_attention_heads": 2, "projection_dim": 16}
    if views:
        from safetensors.torch import save_file

        config = transformers.CLIPVisionConfig(image_size=16, patch_size=8, **shape)
        transformers.CLIPVisionModelWithProjection(config).save_pretrained(folder / "image_encoder")
        (folder / "cc_projection").mkdir()
        layer = {"projection.weight": torch.randn(16, 20), "projection.bias": torch.randn(16)}
        save_file(layer, folder / "cc_projection" / "diffusion_pytorch_model.safetensors")
        return folder
    words = [*LETTERS, *(letter + "</w>" for letter in LETTERS), "<|startoftext|>", "<|endoftext|>"]
    (folder / "tokenizer").mkdir()
    vocabulary = {word: i for i, word in enumerate(words)}
    (folder / "tokenizer" / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "tokenizer" / "merges.txt").write_text("#version: 0.2\n")
    settings = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 32}
    (folder / "tokenizer" / "tokenizer_config.json").write_text(json.dumps(settings))
    config = transformers.CLIPTextConfig(
        vocab_size=len(words), max_position_embeddings=32, eos_token_id=len(words) - 1, **shape
    )
    transformers.CLIPTextModel(config).save_pretrained(folder / "text_encoder")
    return folder


@pytest.fixture(scope="module")
def text_pipeline(tmp_path_factory) -> Path:
    return tiny_pipeline(tmp_path_factory.mktemp("text"))


@pytest.fixture(scope="module")
def view_pipeline(tmp_path_factory) -> Path:
    return tiny_pipeline(tmp_path_factory.mktemp("views"), views=True)


def gradient_of(denoiser, view=(0.1, 0.2, 0.0), step: int = 400) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(1, 3, denoiser.size, denoiser.size, generator=generator).requires_grad_()
    loss = distillation_loss(denoiser, images, torch.tensor([view]), step, generator)
    return torch.autograd.grad(loss, images)[0]


def test_gradients_reach_the_image_through_a_text_pipeline(text_pipeline):
    denoiser = TextDenoiser(text_pipeline, "a box", **CPU)
    assert denoiser.size == 16 and len(denoiser.alphas) == 1000
    gradient = gradient_of(denoiser)
    assert torch.isfinite(gradient).all() and gradient.abs().mean() > 0
    assert not any(p.requires_grad for p in denoiser.unet.parameters())
    back = gradient_of(denoiser, (0.1, 3.0, 0.0))  # other words: ", back view"
    assert not torch.allclose(gradient, back)
    torch.testing.assert_close(gradient, gradient_of(denoiser, (0.1, -0.2, 0.0)))  # the same side
    other = TextDenoiser(text_pipeline, "a cup", **CPU)
    assert not torch.allclose(gradient, gradient_of(other))


def test_guidance_and_prediction_of_velocity(text_pipeline, tmp_path):
    """Guidance extrapolates linearly; a v-model's guess of the noise follows from v."""
    guesses = {}
    noisy = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    for guidance in (1.0, 3.0, 5.0):
        denoiser = TextDenoiser(text_pipeline, "a box", guidance=guidance, device="cpu")
        with torch.no_grad():
            guesses[guidance] = denoiser.predict(noisy, 300, torch.zeros(1, 3))
    torch.testing.assert_close(
        guesses[5.0] - guesses[3.0], guesses[3.0] - guesses[1.0], atol=1e-4, rtol=1e-3
    )
    path = tiny_pipeline(tmp_path / "v", prediction_type="v_prediction")
    denoiser = TextDenoiser(path, "a box", guidance=1.0, device="cpu")
    a = denoiser.alphas[300]
    with torch.no_grad():
        guess = denoiser.predict(noisy, 300, torch.zeros(1, 3))
    expected = a.sqrt() * guesses[1.0] + (1 - a).sqrt() * noisy  # the weights are the same
    torch.testing.assert_close(guess, expected, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("condition", ["zero123", "stable-zero123"])
def test_a_pipeline_that_knows_the_view(view_pipeline, condition):
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    denoiser = ViewDenoiser(view_pipeline, image, condition, 0.3, **CPU)
    gradient = gradient_of(denoiser)
    assert torch.isfinite(gradient).all() and gradient.abs().mean() > 0
    assert not torch.allclose(gradient, gradient_of(denoiser, (0.1, 2.0, 0.0)))
    assert not torch.allclose(
        gradient, gradient_of(ViewDenoiser(view_pipeline, 1 - image, condition, 0.3, **CPU))
    )
    with_it, without = denoiser.tokens(torch.tensor([[0.1, 0.2, 0.5]]))
    last = 0.5 if condition == "zero123" else torch.pi / 2 - 0.3
    angles = torch.tensor([0.1, torch.tensor(0.2).sin(), torch.tensor(0.2).cos(), last])
    joined = torch.cat((denoiser.image_tokens[0], angles))
    torch.testing.assert_close(with_it[0, 0], denoiser.weight @ joined + denoiser.bias)
    assert (without == 0).all() and denoiser.white


def settings(path: Path, **changes) -> SdsInitializerConfig:
    loop = {"steps": 3, "count": 60, "min_opacity": 0.02}
    return SdsInitializerConfig(
        path=path, prompt="a box", distillation=loop, device="cpu", **changes
    )


def test_the_whole_initializer_and_its_cache(text_pipeline, clip, tmp_path, monkeypatch):
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path))
    context = BuildContext(entity="object", clip=clip, rasterizer=WarpRasterizer(), seed=1)
    config = settings(text_pipeline, scale_frames="all")
    track = SdsInitializer.from_config(config, context).initialize(clip, "object")
    assert 30 < len(track.points) <= 60 and torch.isfinite(track.points).all()
    assert 0.1 < track.points.abs().max() < 0.4  # as large as its masks: a box 0.34 m wide
    assert "(text) and frame" in track.provenance
    (kept,) = (tmp_path / "initializers").iterdir()
    # what is kept is used, placed anew, and made again when anything else changes
    monkeypatch.setattr(SdsInitializer, "denoiser", lambda *_: pytest.fail("it was made again"))
    again = SdsInitializer.from_config(config, context).initialize(clip, "object")
    assert torch.equal(again.points, track.points)
    moved = settings(text_pipeline, scale_frames="all", place="depth", smooth=False)
    assert SdsInitializer.from_config(moved, context).initialize(clip, "object").points.shape == (
        track.points.shape
    )
    with pytest.raises(pytest.fail.Exception, match="made again"):
        other = settings(text_pipeline, guidance=7.0)
        SdsInitializer.from_config(other, context).initialize(clip, "object")
    kept.write_bytes(b"PK\x03\x04 half a file")
    with pytest.raises(HoigsError, match=r"is damaged .* delete it"):
        SdsInitializer.from_config(config, context).initialize(clip, "object")
    assert list((tmp_path / "initializers").iterdir()) == [kept]


def test_settings():
    with pytest.raises(ValidationError, match="condition: text needs a prompt"):
        SdsInitializerConfig(path="x")
    assert SdsInitializerConfig(path="x", condition="zero123").guidance is None
    with pytest.raises(ValueError, match="needs a rasterizer"):
        SdsInitializer.from_config(settings(Path("x")), BuildContext())


def test_folders_that_are_no_pipeline(clip, tmp_path):
    def refusal(path: Path, **changes) -> str:
        with pytest.raises(HoigsError) as caught:
            SdsInitializer(
                settings(path, cache=False, **changes), rasterizer=WarpRasterizer()
            ).initialize(clip, "object")
        return str(caught.value)

    assert "no such folder; expected a diffusers pipeline" in refusal(tmp_path / "absent")
    assert "no unet, vae, scheduler, tokenizer, text_encoder in it" in refusal(tmp_path)
    for part in ("unet", "vae", "scheduler", "tokenizer", "text_encoder"):
        (tmp_path / part).mkdir()
    (tmp_path / "unet" / "diffusion_pytorch_model.bin").write_bytes(b"\x80\x04.")
    assert "no .safetensors file; other formats may run code" in refusal(tmp_path)
    assert "image_encoder, cc_projection or clip_camera_projection in it" in refusal(
        tmp_path, condition="zero123"
    )


def test_without_diffusers_the_pip_line_is_told(tmp_path, monkeypatch):
    for part in ("unet", "vae", "scheduler", "tokenizer", "text_encoder"):
        (tmp_path / part).mkdir()
        (tmp_path / part / "model.safetensors").touch()
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(PluginError, match=r"pip install 'hoigs\[sds\]'"):
        TextDenoiser(tmp_path, "a box", **CPU)


def test_damaged_weights_are_told(text_pipeline, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(text_pipeline, copy)
    weights = next((copy / "unet").glob("*.safetensors"))
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(HoigsError, match="unet cannot be loaded"):
        TextDenoiser(copy, "a box", **CPU)

"""A plugin's component that raises, or computes NaN, is named; exit code 2."""

from __future__ import annotations

import pytest

SOURCE = """
import torch

import hoigs
from hoigs import Component, hookimpl
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.values.gaussians import Gaussians


class Faulty(DeformationModel):
    def forward(self, canonical, moment, residual=None):
        {body}


@hookimpl
def hoigs_components():
    yield Component("deformation:{name}", __name__ + ":Faulty", summary="fails")
"""


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return canonical.replace(means=canonical.means * torch.nan)", "of means as NaN"),
        ("raise RuntimeError('out of luck')", "raised RuntimeError: out of luck"),
        ("return canonical.means[10**9]", "raised IndexError"),
    ],
)
def test_a_faulty_deformation(hoigs, tiny_clip, tmp_path, body, words):
    name = f"faulty{len(body)}"  # plugin files stay loaded
    file = tmp_path / f"{name}.py"
    file.write_text(SOURCE.format(body=body, name=name))
    outcome = hoigs("train", tiny_clip, "--spec", "hoigs", "--out", tmp_path / "run",
                    "--plugin", file, "--device", "cpu", "--no-eval",
                    "--set", f"model.object.deformation.use=deformation:{name}",
                    "--set", "model.object.features=null", "--set", "model.human.points=300",
                    "--set", "model.scene.points=300", "--set", "interaction.use=interaction:none",
                    "--set", "train.steps=3", "--set", "train.preview_every=0")  # fmt: skip
    assert outcome.code == 2, outcome.err
    assert "deformation of 'object': hoigs_plugin_faulty" in outcome.err and words in outcome.err


@pytest.mark.parametrize("key", ["means", "sh", "keyframes", "camera"])
@pytest.mark.parametrize("value", [".inf", ".nan"])
def test_rates_are_finite(hoigs, tiny_clip, tmp_path, key, value):
    outcome = hoigs("train", tiny_clip, "--out", tmp_path / "run",
                    "--set", f"train.rates.{key}={value}")  # fmt: skip
    assert outcome.code == 2 and f"train.rates.{key}" in outcome.err, outcome.err

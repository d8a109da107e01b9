"""`hoigs spec list|check|show|keys`."""

from __future__ import annotations

import json

import pytest

from hoigs.core.spec.files import builtin_specs
from hoigs.core.spec.schema import Spec
from hoigs.core.spec.train_schema import rate_names


def test_list(hoigs):
    lines = hoigs("spec", "list").out.splitlines()
    assert [line.split()[0] for line in lines] == builtin_specs()
    assert all(len(line.split()) > 4 for line in lines)


def test_what_is_shown_is_the_spec(hoigs, tmp_path):
    path = tmp_path / "copy.yaml"
    path.write_text(hoigs("spec", "show", "hoigs", "--set", "train.steps=12").out)
    spec = Spec.load("hoigs", overrides=["train.steps=12"])
    assert spec.train.steps == 12 and Spec.load(path) == spec
    assert hoigs("spec", "show", path).out == path.read_text()


def test_check(hoigs, tmp_path):
    outcome = hoigs("spec", "check", "static")
    assert outcome.code == 0 and outcome.out.startswith("static: ok\n")
    assert outcome.out.count(": ok") == 1
    assert "model.scene.deformation" in outcome.out
    path = tmp_path / "my.yaml"
    path.write_text("extends: static\nmodel: {scene: {pionts: 3}}\n")
    outcome = hoigs("spec", "check", path)
    assert outcome.code == 2 and not outcome.out
    assert outcome.err == (
        f'error: {path}:2:17 model.scene.pionts: unknown key; did you mean "points"?\n'
    )


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ('human: {deformation: {use: "deformation:chs"}}',
         "3:30 model.human.deformation.use: BodyPartFeatures requires field, but CubicHermite"),
        ('human: {features: {use: "features:spline-motion"}}',
         "3:27 model.human.features.use: SplineMotionFeatures requires velocity, but HexPlane"),
        ('object: {deformation: {use: "deformation:hexplane-skinning"}}',
         "3:31 model.object.deformation.use: HexPlaneSkinning deforms entities of kind human, not"),
        ('scene: {deformation: {use: "deformation:rigid-frames"}}',
         "3:30 model.scene.deformation.use: RigidFrames deforms entities of kind object, not"),
    ],
)  # fmt: skip
def test_parts_that_do_not_fit(hoigs, tmp_path, block, words):
    path = tmp_path / "my.yaml"
    path.write_text(f"extends: hoigs\nmodel:\n  {block}\n")
    outcome = hoigs("spec", "check", path)
    assert outcome.code == 2 and outcome.err.startswith(f"error: {path}:{words}"), outcome.err


@pytest.mark.parametrize("verb", ["check", "show"])
def test_an_unknown_name(hoigs, verb):
    outcome = hoigs("spec", verb, "statik")
    assert outcome.code == 2 and 'did you mean "static"?' in outcome.err


def test_profiles(hoigs, tmp_path):
    lines = {line.split()[0]: line for line in hoigs("spec", "list").out.splitlines()}
    assert lines["hoigs"].endswith(" [@matched]") and "@" not in lines["static"]
    assert hoigs("spec", "show", "hoigs@matched").out.startswith("name: hoigs@matched\n")
    checked = hoigs("spec", "check", "hoigs")
    assert "hoigs: ok\n" in checked.out and "hoigs@matched: ok\n" in checked.out
    assert "hoigs: ok\n" not in hoigs("spec", "check", "hoigs@matched").out
    outcome = hoigs("spec", "check", "hoigs@mached")
    assert outcome.code == 2 and 'did you mean "matched"?' in outcome.err
    path = tmp_path / "my.yaml"
    path.write_text("extends: hoigs\nprofiles: {quick: {train: {stps: 3}}}\n")
    outcome = hoigs("spec", "check", path)  # all profiles are looked at
    assert outcome.code == 2 and f"{path}:2:28 train.stps: unknown key" in outcome.err
    # a run stores the resolved spec, whose name has the sign in it
    copy = tmp_path / "copy.yaml"
    copy.write_text(hoigs("spec", "show", "hoigs@matched").out)
    assert hoigs("spec", "check", copy).out.startswith("hoigs@matched: ok\n")


def test_keys(hoigs):
    listed = hoigs("spec", "keys").out
    assert "\ntrain.steps: int >= 1; default 2000\n    Optimizer steps" in listed
    assert "\nmodel.human.points: int >= 1; default 10000\n" in listed
    rates = hoigs("spec", "keys", "train.rates").out.splitlines()
    assert rates[0].startswith("train.rates.means: float")
    found = json.loads(hoigs("spec", "keys", "train.rates", "--json").out)["keys"]
    assert {f"train.rates.{rate}" for rate in rate_names()} < {key["name"] for key in found}
    outcome = hoigs("spec", "keys", "train.rate")
    assert outcome.code == 2 and 'did you mean "train.rates"?' in outcome.err

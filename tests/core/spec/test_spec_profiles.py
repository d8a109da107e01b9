"""Profiles: variants of one spec, and what "matched" means for all of them."""

from __future__ import annotations

import pytest

from hoigs.core.errors import SpecError
from hoigs.core.spec.files import spec_profiles, split_profile
from hoigs.core.spec.schema import Spec
from hoigs.core.spec.train_schema import RatesSpec

TEXT = """\
name: mine
summary: a spec with profiles
entities: [scene]
model:
  scene:
    deformation: {use: "deformation:static"}
    density: {use: "density:adc", threshold: 7e-4, cap: 77}
    points: 55
train: {steps: 9, loss: {lambda_dssim: 0}, warmup: {interaction: 0.5}}
profiles:
  quick: {train: {steps: 3}, summary: faster}
  matched:
    model: {scene: {points: 66}}
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text(TEXT)
    return path


def complaint(source) -> str:
    with pytest.raises(SpecError) as caught:
        Spec.load(source)
    return str(caught.value)


@pytest.mark.parametrize(
    ("source", "parts"),
    [
        ("4dgs", ("4dgs", None)),
        ("4dgs@matched", ("4dgs", "matched")),
        ("a/b.yaml@quick", ("a/b.yaml", "quick")),
        ("runs/x-4dgs@matched/spec.yaml", ("runs/x-4dgs@matched/spec.yaml", None)),
        ("me@home.yaml", ("me@home.yaml", None)),
        ("me@home.yaml@quick", ("me@home.yaml", "quick")),
        ("4dgs@", ("4dgs", "")),
    ],
)
def test_what_is_a_profile_and_what_a_path(source, parts):
    assert split_profile(source) == parts


def test_the_file_is_the_native_profile(path):
    native, asked = Spec.load(path), Spec.load(f"{path}@native")
    assert (native.name, asked.name) == ("mine", "mine@native")
    assert native.hash() == asked.hash() and native.train.steps == 9
    assert spec_profiles(path) == ["native", "quick", "matched"]
    assert spec_profiles(f"{path}@quick") == []


def test_a_profile_is_a_spec_of_its_own(path):
    quick = Spec.load(f"{path}@quick")
    assert (quick.name, quick.summary, quick.train.steps) == ("mine@quick", "faster", 3)
    assert quick.train.loss.lambda_dssim == 0 and quick.model["scene"].points == 55
    assert "profiles" not in quick.dump() and Spec.parse(quick.dump()) == quick
    assert Spec.load(f"{path}@quick", overrides=["train.steps=4"]).train.steps == 4
    assert Spec.parse(TEXT) == Spec.load(path)


def test_matched_takes_what_the_yardstick_has(path):
    matched, hoigs, yardstick = map(Spec.load, (f"{path}@matched", "hoigs", "hoigs@matched"))
    assert matched.train.steps == hoigs.train.steps
    assert matched.train.loss == hoigs.train.loss
    # a whole component: no setting of the native one survives in it
    assert matched.model["scene"].density == hoigs.model["scene"].density
    assert matched.model["scene"].points == 66  # its own tree is laid over
    assert matched.train.warmup.interaction == 0.5 and matched.summary == "a spec with profiles"
    # what the profile leaves to its default is the same for all, and all else is hoigs
    for spec in (matched, yardstick):
        for key in ("low_pass", "antialiased"):
            assert getattr(spec, key) == Spec.model_fields[key].default != getattr(hoigs, key)
        assert spec.train.rates == RatesSpec() != hoigs.train.rates
    as_it_is = {key: getattr(hoigs, key) for key in ("low_pass", "antialiased", "name")}
    as_it_is["train"] = yardstick.train.model_copy(update={"rates": hoigs.train.rates})
    # an object has no more Gaussians than those of the others
    thing = yardstick.model["object"].model_copy(update={"points": 4000, "upsample": True})
    as_it_is["model"] = yardstick.model | {"object": thing}
    assert yardstick.model_copy(update=as_it_is).hash() == hoigs.hash()


def test_profiles_are_inherited(path, tmp_path):
    child = tmp_path / "child.yaml"
    child.write_text("extends: ./my.yaml\nprofiles: {quick: {train: {seed: 5}}}\n")
    quick = Spec.load(f"{child}@quick")
    assert (quick.name, quick.train.steps, quick.train.seed) == ("child@quick", 3, 5)
    child.write_text("extends: ./my.yaml@quick\n")
    assert Spec.load(child).name == "child" and Spec.load(child).train.steps == 3
    assert spec_profiles(child) == ["native"]
    child.write_text("name: child\nextends: ./my.yaml@quik\n")
    line = complaint(child)
    assert line.startswith(f"{child}:2:10 extends: ") and 'did you mean "quick"?' in line


def test_mistakes_keep_their_place(path):
    path.write_text(TEXT.replace("steps: 3", "stps: 3").replace("points: 66", "points: 0"))
    assert complaint(f"{path}@quick") == (
        f'{path}:11:19 train.stps: unknown key; did you mean "steps"?'
    )
    assert complaint(f"{path}@matched").startswith(f"{path}:13:29 model.scene.points: must be")
    assert Spec.load(path).train.steps == 9  # the others are not in the way


@pytest.mark.parametrize(
    ("old", "new", "at", "words"),
    [
        ("  quick:", "  native:", "11:3 profiles.native", "the file itself is its native profile"),
        ("  quick: {train: {steps: 3}, summary: faster}", "  quick: 3", "11:3 profiles.quick",
         "expected a block of keys ({} for none), got 3"),
        ("summary: faster", "name: x", "11:30 profiles.quick.name", "cannot have this key"),
        ("summary: faster", "extends: hoigs", "11:30 profiles.quick.extends", "cannot have"),
    ],
)  # fmt: skip
def test_what_profiles_cannot_be(path, old, new, at, words):
    assert old in TEXT
    path.write_text(TEXT.replace(old, new))
    line = complaint(path)
    assert line.startswith(f"{path}:{at}: ") and words in line


def test_a_list_is_no_profiles(path):
    path.write_text(TEXT.partition("profiles:")[0] + "profiles: [quick]\n")
    assert complaint(path).startswith(f"{path}:10:11 profiles: expected a block of names")


def test_a_profile_that_is_not_there(path):
    line = complaint(f"{path}@mached")
    assert line == (
        f'{path}:10:1: "{path}@mached": no profile "mached"; did you mean "matched"? '
        "(has: native, quick, matched)"
    )
    assert "(has: native)" in complaint("static@matched")

"""Specs: what they resolve to, and what is said about wrong ones."""

from __future__ import annotations

import sys

import pytest
from fake_plugins import PluginFolder

from hoigs.core.errors import SpecError
from hoigs.core.spec.schema import ComponentSpec, Spec

MODULE = """
from pathlib import Path
from typing import Literal
from pydantic import BaseModel, Field
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.density import DensityControl
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.interfaces.rasterizer import Rasterizer

class Nested(BaseModel, extra="forbid"):
    depth: int = 2

class Config(ComponentConfig):
    keyframe_step: int = Field(4, ge=1)
    tangents: Literal["learned", "fixed"] = "learned"
    rates: tuple[float, ...] = (1e-5, 0.1)
    file: Path | None = None
    size: int | Literal["all"] = "all"
    nested: Nested = Nested()
    settings: dict[str, float] = {}

class Needy(ComponentConfig):
    path: str

class Move(DeformationModel): ...
class See(FeatureExtractor): ...
class Grow(DensityControl): ...
class Draw(Rasterizer): ...
class Meet(InteractionModule): ...
class Doll(BodyModel): ...

@hookimpl
def hoigs_components():
    for key, name in {
        "deformation:move": "Move", "deformation:stay": "Move", "features:see": "See",
        "features:grow": "Grow", "density:grow": "Grow", "rasterizer:draw": "Draw",
        "interaction:meet": "Meet", "body:doll": "Doll",
    }.items():
        yield Component(key, target=f"fake_kit:{name}", config="fake_kit:Config")
    yield Component("body:needy", target="fake_kit:Doll", config="fake_kit:Needy")
    yield Component("features:plain", target="fake_kit:See")
    yield Component("features:gone", target="fake_gone:Thing")
"""

TEXT = """\
name: mine
rasterizer: {use: "rasterizer:draw"}
interaction: {use: "interaction:meet", keyframe_step: 2}
model:
  scene:
    deformation: {use: "deformation:stay"}
    density: {use: "density:grow"}
  object:
    deformation: {use: "deformation:move", keyframe_step: 3, settings: {a: 1e-3}}
    features: {use: "features:plain"}
    density: {use: "density:grow"}
    points: 1e3
train: {steps: 7, loss: {scene: 0.5}}
"""


@pytest.fixture
def registry(tmp_path, monkeypatch):
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "fake_kit", raising=False)
    plugins = PluginFolder(folder)
    plugins.add("kit", MODULE, module="fake_kit")
    return plugins.registry()


@pytest.fixture
def parse(registry):
    return lambda text=TEXT: Spec.parse(text, source="my.yaml", registry=registry)


def complaints(call, *args, **kwargs) -> list[str]:
    with pytest.raises(SpecError) as caught:
        call(*args, **kwargs)
    return str(caught.value).splitlines()


def test_a_spec_is_resolved(parse):
    spec = parse()
    block = spec.model["object"]
    assert block.deformation.use == "deformation:move"
    assert block.deformation.settings == {
        "keyframe_step": 3,
        "tangents": "learned",
        "rates": [1e-5, 0.1],
        "file": None,
        "size": "all",
        "nested": {"depth": 2},
        "settings": {"a": 0.001},
    }
    assert block.features.settings == {} and block.points == 1000 and block.opacity == 0.1
    assert spec.model["scene"].features is None
    assert (spec.train.steps, spec.train.loss.scene, spec.train.seed) == (7, 0.5, 0)
    assert spec.components()["model.object.deformation"] == "deformation:move"
    assert len(spec.components()) == 7


def test_what_is_dumped_is_an_equal_spec(parse):
    spec = parse()
    text = spec.dump()
    again = parse(text)
    assert again == spec and again.dump() == text and hash(again) == hash(spec)
    assert again.hash() == spec.hash() and again.model_hash() == spec.model_hash()
    assert "keyframe_step: 4" in text and "checkpoint_every" in text  # defaults are filled in


@pytest.mark.parametrize(
    ("old", "new", "same_model"),
    [
        ("keyframe_step: 3", "keyframe_step: 5", False),
        ("keyframe_step: 2", "keyframe_step: 5", False),
        ("points: 1e3", "points: 1001", False),
        ("points: 1e3", "points: 1e3\n    sh_degree: 1", False),
        ("points: 1e3", "points: 1e3\n    opacity: 0.5", True),
        ('"density:grow"', '"density:grow", keyframe_step: 9', True),
        ("steps: 7", "steps: 8", True),
        ("name: mine", "name: mine\nentities: [object]", False),
        ("name: mine", "name: mine\nevaluation: {held_out: false}", True),
    ],
)
def test_hashes(parse, old, new, same_model):
    assert old in TEXT
    spec, other = parse(), parse(TEXT.replace(old, new))
    assert other != spec and other.hash() != spec.hash()
    assert (other.model_hash() == spec.model_hash()) is same_model


def test_a_name_changes_no_hash(parse):
    other = parse(TEXT.replace("mine", "yours"))
    assert other != parse() and other.hash() == parse().hash()


def test_how_a_step_is_computed_changes_no_hash(parse):
    other = parse(TEXT.replace("steps: 7", "steps: 7, graphs: off"))
    assert other.train.graphs == "off" and other.hash() == parse().hash()


AT_LEAST_1 = "must be greater than or equal to 1, got 0"
NAME_RULE = "use letters, digits, _, - and . , a letter or digit first, got "
NO_INT = "must be a valid integer, got "
NO_NUMBER = "must be a valid number, got "

# what is put in the place of what, where the complaint stands, and what it says;
# "D" is model.object.deformation
MISTAKES = [
    ("keyframe_step: 3", "keyframe_stp: 3", "9:44 D.keyframe_stp",
     'unknown key; did you mean "keyframe_step"?'),
    ("keyframe_step: 3", "keyframe_step: 0", "9:59 D.keyframe_step", AT_LEAST_1),
    ("keyframe_step: 3", "tangents: lerned", "9:54 D.tangents",
     "must be 'learned' or 'fixed', got 'lerned'"),
    ("keyframe_step: 3", "nested: {dept: 3}", "9:53 D.nested.dept",
     'unknown key; did you mean "depth"?'),
    ("keyframe_step: 3", "nested: {depth: x}", "9:60 D.nested.depth", NO_INT + "'x'"),
    ("keyframe_step: 3", "rates: [1, x]", "9:55 D.rates.1", NO_NUMBER + "'x'"),
    ("keyframe_step: 3", "size: x", "9:50 D.size",
     "must be a valid integer, or 'all', got 'x'"),
    ("keyframe_step: 3", "nested: 4", "9:52 D.nested",
     "expected a block of keys with depth, got 4"),
    ('"features:plain"', '"features:plain", x: 1', "10:39 model.object.features.x",
     "unknown key (it has no settings)"),
    ("points: 1e3", "points: 0", "12:13 model.object.points", AT_LEAST_1),
    ("points: 1e3", "pionts: 3", "12:5 model.object.pionts", 'unknown key; did you mean "points"?'),
    ("scene: 0.5", "sceen: 1", "13:26 train.loss.sceen", 'unknown key; did you mean "scene"?'),
    ("steps: 7", "steps: many", "13:16 train.steps", NO_INT + "'many'"),
    ("train:", "trian:", "13:1 trian", 'unknown key; did you mean "train"?'),
    ("deformation:move", "deformation:mve", "9:24 D.use",
     'no component "deformation:mve"; did you mean "deformation:move"?'),
    ('"deformation:move"', '"density:grow"', "9:24 D.use",
     '"density:grow" is no deformation (known: deformation:'),
    ("features:plain", "features:gone", "10:21 model.object.features.use",
     "features:gone@kit: cannot import fake_gone:Thing"),
    ("features:plain", "features:grow", "10:21 model.object.features.use",
     "features:grow@kit: fake_kit:Grow is the class Grow, expected a subclass of "
     "hoigs.core.interfaces.feat"),
    ('{use: "features:plain"}', "features:plain", "10:15 model.object.features",
     "expected a block of keys with use, got 'features:plain'"),
    ('use: "features:plain"', "x: 1", "10:5 model.object.features.use", "this key is missing"),
    ("name: mine", "name: 3", "1:7 name", "must be a valid string, got 3"),
    ("name: mine", "name: x/../../../evil", "1:7 name", NAME_RULE + "'x/../../../evil'"),
    ("name: mine", r'name: "x\0y"', "1:7 name", NAME_RULE + r"'x\x00y'"),
    ("name: mine", "name: ..", "1:7 name", NAME_RULE + "'..'"),
    ("name: mine", "name: a@b/c", "1:7 name", NAME_RULE + "'a@b/c'"),
    ("name: mine", "name: a@", "1:7 name", NAME_RULE + "'a@'"),
    ("model:", "modl:", "1:1 model", "this key is missing"),
    ("    points: 1e3", "    body: {use: 'body:needy'}", "12:5 model.object.body.path",
     "this key is missing"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "place", "message"), MISTAKES)
def test_mistakes_have_a_position(parse, old, new, place, message):
    assert old in TEXT
    lines = complaints(parse, TEXT.replace(old, new))
    start = f"my.yaml:{place.replace('D.', 'model.object.deformation.')}: {message}"
    assert any(line.startswith(start) for line in lines), "\n".join(lines)


def test_all_mistakes_are_told_at_once(parse):
    text = TEXT.replace("keyframe_step: 3", "keyframe_stp: 3, tangents: 3")
    text = text.replace("keyframe_step: 2", "qqq: 3")
    lines = complaints(parse, text)
    assert len(lines) == 3
    assert lines[0].startswith("my.yaml:3:40 interaction.qqq: unknown key (valid: keyframe_step")


def test_mistakes_of_the_spec_do_not_hide_those_of_its_components(parse):
    text = TEXT.replace("keyframe_step: 3", "keyframe_stp: 3").replace("steps: 7", "stps: 7")
    text = text.replace("points: 1e3", "points: 0").replace("features:plain", "features:plan")
    lines = complaints(parse, text.replace("interaction:", "interactoin:"))
    places = {line.partition(": ")[0].partition(" ")[2] for line in lines}
    assert places == {
        "interactoin", "train.stps", "model.object.points", "model.object.features.use",
        "model.object.deformation.keyframe_stp",
    }  # fmt: skip


def test_where_a_part_of_a_spec_stands(parse):
    assert parse().at("model", "object") == "my.yaml:9:5 model.object"
    assert parse().at("evaluation") == "my.yaml:1:1 evaluation"


def test_a_file_without_a_name_gives_its_own_made_safe(registry, tmp_path):
    path = tmp_path / "my spec (2).yaml"
    path.write_text(TEXT.replace("name: mine\n", ""))
    assert Spec.load(path, registry=registry).name == "my-spec-2"


def test_extending_a_file(registry, tmp_path):
    (tmp_path / "base.yaml").write_text(TEXT + "summary: the base\n")
    (tmp_path / "sub").mkdir()
    child = tmp_path / "sub" / "child.toml"
    child.write_text('extends = "../base.yaml"\n[model.object]\ndeformation.keyframe_step = 9\n')
    spec, base = (
        Spec.load(child, registry=registry),
        Spec.load(tmp_path / "base.yaml", registry=registry),
    )
    assert (spec.name, spec.summary, base.name) == ("child", "", "mine")
    assert spec.model["object"].deformation.settings["keyframe_step"] == 9
    assert spec.model["object"].points == 1000
    assert spec.model["scene"] == base.model["scene"]
    assert spec.hash() != base.hash()


def test_another_component_inherits_no_settings(registry, tmp_path):
    (tmp_path / "base.yaml").write_text(TEXT)
    child = tmp_path / "child.yaml"
    child.write_text(
        "extends: ./base.yaml\nmodel: {object: {deformation: {use: 'deformation:stay'}}}"
    )
    spec = Spec.load(child, registry=registry)
    assert spec.model["object"].deformation.settings["keyframe_step"] == 4
    assert spec.model["object"].deformation.settings["settings"] == {}


def test_mistakes_in_a_chain_name_the_file_that_made_them(registry, tmp_path):
    (tmp_path / "base.yaml").write_text(TEXT.replace("points: 1e3", "pionts: 3"))
    child = tmp_path / "child.yaml"
    child.write_text("extends: ./base.yaml\ntrain: {stps: 3}\n")
    lines = complaints(Spec.load, child, registry=registry)
    assert any(
        line.startswith(f"{tmp_path / 'base.yaml'}:12:5 model.object.pion") for line in lines
    )
    assert any(line.startswith(f"{child}:2:9 train.stps: unknown key") for line in lines)


def test_a_circle(registry, tmp_path):
    for name, base in (("a", "b"), ("b", "c"), ("c", "a")):
        (tmp_path / f"{name}.yaml").write_text(f"name: {name}\nextends: ./{base}.yaml\n")
    (line,) = complaints(Spec.load, tmp_path / "a.yaml", registry=registry)
    assert "extends itself: a.yaml -> b.yaml -> c.yaml -> a.yaml" in line
    assert line.startswith(f"{tmp_path / 'a.yaml'}:2:10 extends: ")


def test_extends_that_leads_nowhere(registry, tmp_path):
    path = tmp_path / "a.yaml"
    for base, words in (
        ("hoig", 'no spec "hoig"; did you mean "hoigs"?'),
        ("./b.yaml", "no such file"),
        ("[1]", "expected a spec's name or file, got [1]"),
        ("./b.txt", "a spec file ends in .yaml, .yml, .toml"),
    ):
        path.write_text(f"name: a\nextends: {base}\n")
        (line,) = complaints(Spec.load, path, registry=registry)
        assert line.startswith(f"{path}:2:10 extends: ") and words in line


def test_overrides(registry, tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text(TEXT)

    def load(*overrides: str) -> Spec:
        return Spec.load(path, overrides=overrides, registry=registry)

    spec = load(
        "model.object.deformation.keyframe_step=2", "train.loss.scene=1e-1", "entities=[object]"
    )
    assert spec.model["object"].deformation.settings["keyframe_step"] == 2
    assert spec.train.loss.scene == 0.1 and spec.entities == ("object",)
    assert load("train.loss.scene=").train.loss.scene is None
    assert load("model.object.features=").model["object"].features is None
    changed = load("interaction.tangents=fixed", "train.steps=1")
    assert changed.interaction.settings["tangents"] == "fixed"
    swapped = load(
        "model.object.deformation.rates=[3]", "model.object.deformation.use=deformation:stay"
    )
    settings = swapped.model["object"].deformation.settings
    assert settings["rates"] == [3.0] and settings["keyframe_step"] == 4
    (line,) = complaints(load, "model.object.deformation.keyframe_stp=2")
    assert line == (
        "--set model.object.deformation.keyframe_stp=2: model.object.deformation.keyframe_stp: "
        'unknown key; did you mean "keyframe_step"?'
    )
    (line,) = complaints(load, "train.steps=0")
    assert line.startswith("--set train.steps=0: train.steps: must be greater than")
    (line,) = complaints(load, "rasterizer=torch")
    assert line.endswith("write --rasterizer torch or --set rasterizer.use=rasterizer:torch")
    (line,) = complaints(load, "model.objct.points=3")
    assert '"objct" there; did you mean "object"? (has: ' in line
    (line,) = complaints(load, f"train.seed={2**63}")
    assert "train.seed: must be less than or equal to" in line


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("hoig", 'no spec "hoig"; did you mean "hoigs"? (built in: '),
        ("nowhere/mine.yaml", "nowhere/mine.yaml: no such file"),
        ("a/b", "a/b: a spec file ends in"),
    ],
)
def test_specs_that_are_not_there(source, words):
    assert words in complaints(Spec.load, source)[0]


def test_the_block_of_an_entity(parse):
    text = TEXT.replace(
        "  object:",
        "  cup:\n    deformation: {use: 'deformation:stay'}\n"
        "    density: {use: 'density:grow'}\n  object:",
    )
    spec = parse(text)
    assert spec.block("cup", "object") == ("cup", spec.model["cup"])
    assert spec.block("plate", "object") == ("object", spec.model["object"])
    assert spec.block("anna", "human") is None
    assert spec.selects("cup", "object")
    only = parse(text + "entities: [cup, scene]\n")
    assert only.selects("cup", "object") and only.selects("scene", "scene")
    assert not only.selects("plate", "object")


def test_specs_do_not_change(parse):
    with pytest.raises(ValueError, match="frozen"):
        parse().name = "other"
    assert ComponentSpec(use="a:b").settings == {}

"""`model.object.initializer` in a spec: who is built from it, and what is said when it cannot
be."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from hoigs.core.errors import SpecError
from hoigs.core.interfaces.initializer import ObjectInitializer, check_track, training_frames
from hoigs.core.model.compose import compose
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec

TEXT = """\
name: mine
rasterizer: {{use: "rasterizer:torch"}}
entities: [{entity}]
model:
  {entity}:
    deformation: {{use: "deformation:{motion}"}}
    points: 300
    {initializer}
"""


def spec(initializer: str = "", *, entity: str = "object", motion: str = "chs") -> Spec:
    return Spec.parse(
        TEXT.format(initializer=initializer, entity=entity, motion=motion), source="my.yaml"
    )


@pytest.fixture
def box(tmp_path, truth):
    path = tmp_path / "box.ply"
    truth.mesh.export(path)
    return path


def test_every_initializer_is_listed():
    registry = default_registry()
    for key in ("depth", "mesh", "points", "sds", "sfm"):
        assert issubclass(registry.get(f"initializer:{key}"), ObjectInitializer)
        assert f"initializer:{key}" in registry.keys("initializer")


def test_gaussians_start_on_what_the_initializer_gives(clip, truth, box):
    without = compose(spec(), clip).entity("object").means
    assert torch.isin(without, clip.objects["object"].points).all()
    text = f'initializer: {{use: "initializer:mesh", path: "{box}", unit: m, center: origin}}'
    means = compose(spec(text), clip).entity("object").means
    assert len(means) == 300 and truth.to_surface(means.detach()).max() < 1e-5
    assert truth.to_surface(without.detach()).max() > 1e-3  # the clip's points are noisy
    placed = compose(spec(text, motion="mlp"), clip)
    assert placed.entity("object").means.shape == (300, 3)


def test_motion_follows_the_initializers_track(clip, box):
    settings = f'path: "{box}", count: 400, place: depth, smooth: false'
    text = f'initializer: {{use: "initializer:mesh", {settings}}}'
    entity = compose(spec(text), clip).entity("object")
    frame = clip[clip.split["train"][1]]
    moved = entity(frame.moment).means.mean(0)
    mask = frame.masks["object"]
    center = mask.nonzero().float().mean(0).flip(0) + 0.5
    assert (frame.camera.project(moved)[0] - center).norm() < 4


def test_the_same_spec_gives_the_same_gaussians(clip, box):
    text = f'initializer: {{use: "initializer:mesh", path: "{box}", count: 400}}'
    first, again = (compose(spec(text), clip).state_dict() for _ in range(2))
    assert all(torch.equal(v, again[k]) for k, v in first.items())


def test_the_resolved_spec_holds_it(box):
    made = spec(f'initializer: {{use: "initializer:points", path: "{box}"}}')
    assert Spec.parse(made.dump()) == made
    assert made.components()["model.object.initializer"] == "initializer:points"
    assert made.model["object"].initializer.settings["scale_reduce"] == "median"
    assert made.model_hash() != spec().model_hash()


def refusal(text: str, clip, **settings) -> str:
    with pytest.raises(SpecError) as caught:
        compose(spec(text, **settings), clip)
    return str(caught.value)


def test_errors_name_their_place(clip, box):
    message = refusal('initializer: {use: "initializer:points", path: "box.ply"}', clip)
    assert message.startswith(
        "my.yaml:8:18 model.object.initializer: object: box.ply: no such file"
    )
    text = 'initializer: {use: "initializer:depth"}'
    message = refusal(text, clip, entity="human", motion="static")
    assert "model.human.initializer: initializers make objects; human is a human" in message
    message = refusal(text, replace(clip, depth_kind="none"))
    assert 'my.yaml:8:18 model.object.initializer: object: the clip\'s depth is "none"' in message
    message = refusal("", replace(clip, objects={}))
    assert message.endswith("the clip has no track of object; give an `initializer`")
    for text, expected in (
        ('initializer: {use: "initializer:mesh"}', "path"),
        ('initializer: {use: "initializer:meshes", path: x}', 'did you mean "initializer:mesh"'),
        ('initializer: {use: "density:none"}', "is no initializer"),
        (
            'initializer: {use: "initializer:mesh", path: x.ply, axes: "x y"}',
            "expected opencv, opengl",
        ),
    ):
        with pytest.raises(SpecError, match=r"my.yaml:8:\d+ model.object.initializer") as caught:
            spec(text)
        assert expected in str(caught.value)


def test_what_a_track_must_be(clip):
    track = clip.objects["object"]
    assert check_track(track, len(clip)) is track

    def broken(**changes) -> SimpleNamespace:  # ObjectTrack itself is checked in tests
        return SimpleNamespace(**{**vars(track), **changes})

    spoilt = track.points.clone()
    spoilt[3, 1] = torch.nan
    for bad, message in (
        (broken(points=track.points[:3], colors=track.colors[:3]), "3 points are too few"),
        (broken(points=spoilt), r"points: 1 of \d+ rows are not finite"),
        (broken(colors=track.colors[:9]), "have colours of shape"),
        (broken(observed=track.observed[:-1]), "observed has 11 rows, the clip has 12"),
    ):
        with pytest.raises(ValueError, match=message):
            check_track(bad, len(clip))


def test_frames_that_may_be_looked_at(clip):
    assert training_frames(clip) == list(clip.split["train"])
    assert training_frames(replace(clip, split={"train": [], "test": [0]})) == list(range(12))


def test_the_snippets_of_the_docs_are_specs():
    page = Path(__file__).parents[3] / "docs" / "reference" / "initializers.md"
    blocks = re.findall(r"```yaml\n(.*?)```", page.read_text(), flags=re.S)
    used = {Spec.parse(f"name: x\n{b}").components()["model.object.initializer"] for b in blocks}
    assert used == {f"initializer:{k}" for k in ("depth", "points", "mesh", "sfm", "sds")}

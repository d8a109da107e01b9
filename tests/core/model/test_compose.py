"""A spec and a clip to a SceneModel, with parts that are as small as can be."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from fake_plugins import PluginFolder

from hoigs.core.errors import PluginError, SpecError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.spec.schema import Spec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import BodyTrack, Clip, FrameStore, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment

MODULE = '''
import torch
from torch import nn
from hoigs.core.interfaces.body import BodyModel, BodyOutput, BodySurface
from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.core.interfaces.density import DensityControl
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.values.tokens import Tokens
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import Residual
from hoigs.core.interfaces.rasterizer import Rasterizer, RenderOutput

class Still(DeformationModel):
    """Does nothing, in either space."""
    def __init__(self, context, space, fail):
        super().__init__()
        if fail:
            raise ValueError("it is told to fail")
        self.context, self.input_space = context, space
        self.weight = nn.Parameter(torch.rand(3))
    @classmethod
    def from_config(cls, config, context):
        return cls(context, config.space, config.fail)
    def forward(self, rest, moment, residual=None):
        return rest

class StillConfig(ComponentConfig):
    space: str = "canonical"
    fail: bool = False

class Speed(FeatureExtractor):
    requires = frozenset({"velocity"})
    width = 3
    def forward(self, deformation, rest, moment):
        return Tokens(rest.means, rest.means)

class Centre(Speed):
    requires = frozenset()

class Meet(InteractionModule):
    def bind(self, widths, kinds):
        if len(widths) > 1:
            raise ValueError("one is enough")
        self.widths, self.kinds = widths, kinds
    def forward(self, tokens, roles):
        return {}

class Draw(Rasterizer):
    def render(self, gaussians, camera, request=None):
        raise AssertionError("composing draws nothing")

class Grow(DensityControl):
    def __init__(self, cap): self.cap = cap
    def refine(self, *args, **kwargs): return None

class GrowConfig(ComponentConfig):
    cap: int = 5

class Stick(BodyModel):
    """A triangle in the plane z = 0, as wide as the first beta says; posing only displaces it."""
    num_betas = 1
    def __init__(self, lean: float = 0.0):
        super().__init__()
        self.lean, self.faces = lean, torch.tensor([[0, 1, 2]])
    def shaped(self, betas): raise AssertionError("composing asks for surfaces only")
    def skinning_transforms(self, pose): raise AssertionError("composing poses nothing")
    def forward(self, pose):
        corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        return BodyOutput(corners + pose.transl, corners)
    def surface(self, count=None, betas=None, seed=0):
        generator = torch.Generator().manual_seed(seed)
        b = torch.rand(count, 3, generator=generator)
        b = b / b.sum(1, keepdim=True)
        points = b @ torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) * betas[0]
        zeros = torch.zeros(count, dtype=torch.int64)
        spacing = torch.full((count,), 0.25)
        return BodySurface(points, points, spacing, points, zeros, zeros, b)

class StickConfig(ComponentConfig):
    lean: float = 0.0

class NeedyConfig(StickConfig):
    path: str

@hookimpl
def hoigs_components():
    for key, name, config in (
        ("deformation:still", "Still", "StillConfig"), ("features:speed", "Speed", None),
        ("features:centre", "Centre", None), ("interaction:meet", "Meet", None),
        ("rasterizer:draw", "Draw", None), ("density:grow", "Grow", "GrowConfig"),
        ("body:stick", "Stick", "StickConfig"), ("body:other", "Stick", "StickConfig"),
        ("body:needy", "Stick", "NeedyConfig"),
    ):
        config = config and f"fake_doll:{config}"
        yield Component(key, target=f"fake_doll:{name}", config=config)
'''

TEXT = """\
name: mine
rasterizer: {use: "rasterizer:draw"}
interaction: {use: "interaction:meet"}
model:
  scene: {deformation: {use: "deformation:still"}, density: {use: "density:grow"}, points: 40}
  human:
    deformation: {use: "deformation:still"}
    density: {use: "density:grow", cap: 7}
    points: 30
    opacity: 0.9
    sh_degree: 1
  object: &
    deformation: {use: "deformation:still"}
    features: {use: "features:centre"}
    density: {use: "density:grow"}
    points: 8
""".replace(" &", "")


class NoPixels(FrameStore):
    def image(self, position):
        raise AssertionError("composing looks at no pixels")

    mask = depth = image


@pytest.fixture
def registry(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "fake_doll", raising=False)
    plugins = PluginFolder(tmp_path)
    plugins.add("doll", MODULE, module="fake_doll")
    return plugins.registry()


@pytest.fixture
def clip() -> Clip:
    frames = 5
    generator = torch.Generator().manual_seed(3)
    poses = BodyPose.zeros(frames, betas=1)
    poses = replace(poses, transl=torch.arange(frames * 3.0).reshape(frames, 3))
    poses = replace(poses, betas=torch.full((frames, 1), 2.0))
    turn = torch.tensor([[0.8, 0.0, 0.6, 0.0]]).expand(frames, 4)
    cup = ObjectTrack(
        points=torch.rand(20, 3, generator=generator),
        colors=torch.rand(20, 3, generator=generator),
        rotations=quats_to_matrices(turn),
        translations=torch.arange(frames * 3.0).reshape(frames, 3) + 10,
        observed=torch.tensor([False, True, True, False, True]),
    )
    K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    return Clip(
        name="made up",
        store=NoPixels(),
        cameras=[Camera(K, torch.eye(4), 16, 16)] * frames,
        moments=[Moment(i / 4, i) for i in range(frames)],
        kinds={"anna": "human", "cup": "object"},
        bodies={"anna": BodyTrack("body:stick", poses)},
        objects={"cup": cup},
        points=torch.rand(100, 3, generator=generator),
        point_colors=torch.rand(100, 3, generator=generator),
        split={"train": [0, 1, 3, 4], "test": [2]},
    )


@pytest.fixture
def parse(registry):
    def parse(text: str = TEXT) -> Spec:
        return Spec.parse(text, source="my.yaml", registry=registry)

    return parse


def refusal(*args) -> str:
    with pytest.raises(SpecError) as caught:
        compose(*args)
    return str(caught.value)


def test_entities_and_their_gaussians(parse, registry, clip):
    model = compose(parse(), clip, registry)
    assert model.count() == {"scene": 40, "anna": 30, "cup": 8}
    assert [model.entity(n).kind for n in model.entities] == ["scene", "human", "object"]
    scene, anna, cup = (model.entity(n).canonical for n in model.entities)
    # each scene and object point is one of the clip's, with its colour
    for canonical, points, colors in (
        (scene, clip.points, clip.point_colors),
        (cup, clip.objects["cup"].points, clip.objects["cup"].colors),
    ):
        same = (canonical.means[:, None] == points).all(-1)
        assert (same.sum(1) == 1).all() and (same.sum(0) <= 1).all()
        torch.testing.assert_close(canonical.colors, colors[same.long().argmax(1)])
        torch.testing.assert_close(canonical.opacities, torch.full((len(canonical),), 0.1))
    # the human lies on its body, shaped by the track's betas, as wide as the points are apart
    assert anna.means[:, 2].abs().max() == 0 and 1 < anna.means.max() < 2
    torch.testing.assert_close(anna.scales, torch.full((30, 3), 0.25))
    torch.testing.assert_close(anna.opacities, torch.full((30,), 0.9))
    assert (scene.sh_degree, anna.sh_degree) == (0, 1)


def test_a_model_is_drawn_with_the_low_pass_of_its_spec(parse, registry, clip):
    model = compose(parse(f"low_pass: 0.1\nantialiased: true\n{TEXT}"), clip, registry)
    seen: list[RenderRequest] = []
    model.rasterizer = SimpleNamespace(render=lambda gaussians, camera, how: seen.append(how))
    moment, camera = clip.moments[0], clip.cameras[0]
    model.draw(model(moment).joined(), camera, RenderRequest(near=0.2))
    model.render(moment, camera, background=torch.ones(3))
    assert [(how.low_pass, how.near) for how in seen] == [(0.1, 0.2), (0.1, RenderRequest.near)]
    assert all(how.antialiased for how in seen)
    plain = compose(parse(), clip, registry)  # as 3DGS
    ours = (plain.low_pass, plain.antialiased)
    assert ours == (RenderRequest.low_pass, RenderRequest.antialiased)


@pytest.mark.parametrize(("step", "degree"), [(0.0, 0), (0.001, 0), (0.1, 2)])
def test_colours_depend_on_the_direction_where_training_cameras_move(
    step, degree, parse, registry, clip
):
    spec = parse(TEXT.replace("points: 40", "points: 40, sh_degree: auto"))
    places = [torch.eye(4) for _ in clip.cameras]
    for i, place in enumerate(places):
        place[0, 3] = step * i
    places[2][0, 3] = 9.0  # a test camera may be anywhere
    cameras = [replace(c, world_to_camera=p) for c, p in zip(clip.cameras, places, strict=True)]
    model = compose(spec, replace(clip, cameras=cameras), registry)
    assert model.entity("scene").canonical.sh_degree == degree


def test_more_points_than_the_clip_has(parse, registry, clip):
    spec = parse(TEXT.replace("points: 40", "points: 400").replace("points: 8", "points: 21"))
    model = compose(spec, clip, registry)
    assert model.count() == {"scene": 100, "anna": 30, "cup": 20}
    torch.testing.assert_close(model.entity("scene").means, clip.points)


def test_more_points_than_a_track_has(parse, registry, clip):
    spec = parse(TEXT.replace("points: 8", "points: 50\n    upsample: true"))
    model = compose(spec, clip, registry)
    assert model.count()["cup"] == 50
    again = compose(spec, clip, registry)
    assert torch.equal(model.entity("cup").means, again.entity("cup").means)
    message = refusal(
        parse(TEXT.replace("points: 40", "points: 40, upsample: true")), clip, registry
    )
    assert message.endswith("model.scene: upsample belongs to objects; remove it here")


def test_what_components_are_told(parse, registry, clip):
    model = compose(parse(TEXT + "train: {seed: 4}\n"), clip, registry)
    context = model.entity("anna").deformation.context
    assert context.entity == "anna" and context.clip is clip and context.seed == 4
    assert type(context.body).__name__ == "Stick"
    assert context.body_track is clip.bodies["anna"] and context.object_track is None
    context = model.entity("cup").deformation.context
    assert context.object_track is clip.objects["cup"] and context.body is None
    assert model.interaction.widths == {"cup": 3}
    assert model.interaction.kinds == {"scene": "scene", "anna": "human", "cup": "object"}


def test_a_motion_that_knows_no_track_starts_in_the_world(parse, registry, clip):
    text = TEXT.replace('"deformation:still"', '"deformation:still", space: world')
    placed, plain = (compose(parse(t), clip, registry) for t in (text, TEXT))
    cup, canonical = placed.entity("cup").means, plain.entity("cup").means
    track = clip.objects["cup"]  # first seen in frame 1
    expected = canonical @ track.rotations[1].T + track.translations[1]
    torch.testing.assert_close(cup, expected)
    anna = placed.entity("anna").means  # the middle frame's pose; posing knows no betas here
    middle = clip.bodies["anna"].poses.transl[2]
    torch.testing.assert_close(anna, plain.entity("anna").means / 2 + middle)
    torch.testing.assert_close(placed.entity("scene").means, plain.entity("scene").means)


def test_composing_repeats_itself_and_leaves_the_random_state_alone(parse, registry, clip):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    first = compose(parse(), clip, registry)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(7)
    second = compose(parse(), clip, registry).state_dict()
    assert all(torch.equal(value, second[name]) for name, value in first.state_dict().items())
    other = compose(parse(TEXT + "train: {seed: 1}\n"), clip, registry).state_dict()
    for name in ("scene.means", "anna.means", "cup.means", "cup.deformation.weight"):
        assert not torch.equal(other[f"entities.{name}"], second[f"entities.{name}"])


def test_density_controls(parse, registry, clip):
    controls = compose_density(parse(), clip, registry)
    assert {name: c.cap for name, c in controls.items()} == {"scene": 5, "anna": 7, "cup": 5}


def test_only_some_entities(parse, registry, clip):
    for chosen, expected in (("[scene]", {"scene"}), ("[cup, human]", {"anna", "cup"})):
        spec = parse(TEXT + f"entities: {chosen}\n")
        assert set(compose(spec, clip, registry).entities) == expected
        assert set(compose_density(spec, clip, registry)) == expected
    message = refusal(parse(TEXT + "entities: [dog]\n"), clip, registry)
    assert message.startswith("my.yaml:17:11 entities: none of dog is in the clip")


def test_an_exact_name_wins_and_unused_blocks_are_ignored(parse, registry, clip):
    block = "deformation: {use: 'deformation:still'}, density: {use: 'density:grow'}"
    text = f"{TEXT}  cup: {{{block}, points: 3}}\n  dog: {{{block}, points: 5}}\n"
    model = compose(parse(text), clip, registry)
    assert model.count() == {"scene": 40, "anna": 30, "cup": 3}


def test_an_entity_without_a_block(parse, registry, clip):
    message = refusal(parse(TEXT.replace("  human:", "  ann:")), clip, registry)
    assert message.startswith(
        'my.yaml:5:3 model: no block for the clip\'s human "anna"; did you mean "ann"?'
    )
    clip = replace(clip, kinds={"cup": "object"})  # without her, nothing is missing
    assert set(compose(parse(TEXT.replace("  human:", "  ann:")), clip, registry).entities)


def test_a_clip_of_a_scene_alone(parse, registry, clip):
    bare = replace(clip, kinds={}, bodies={}, objects={})
    message = refusal(parse(), bare, registry)
    assert "mine models human and object, and clip made up has no entity but the scene" in message
    assert "my.yaml:5:3 model" in message and "--spec 4dgs" in message
    alone = parse(TEXT + "entities: [scene]\n")
    assert compose(alone, bare, registry).count() == {"scene": 40}


def test_a_human_without_poses(parse, registry, clip):
    unposed = replace(clip, bodies={}, provenance={"poses of anna": "give smpl="})
    message = refusal(parse(), unposed, registry)
    assert "model.human: clip made up has no body poses of anna: give smpl=; or take" in message
    canonical = parse(TEXT + "entities: [scene, object]\n")
    assert compose(canonical, unposed, registry).count() == {"scene": 40, "cup": 8}


def test_a_component_that_cannot_be_built(parse, registry, clip):
    text = TEXT.replace(
        "human:\n    deformation: {use:", "human:\n    deformation: {fail: true, use:"
    )
    assert refusal(parse(text), clip, registry) == (
        "my.yaml:7:18 model.human.deformation: it is told to fail"
    )


def test_features_that_ask_for_too_much(parse, registry, clip):
    message = refusal(parse(TEXT.replace("features:centre", "features:speed")), clip, registry)
    assert message.startswith("my.yaml:13:5 model.object: Speed requires velocity, but")


def test_an_interaction_that_refuses_its_tokens(parse, registry, clip, monkeypatch):
    def forward(self, tokens, roles):
        raise ValueError(f"no {' and '.join(tokens)}")

    meet = registry.get("interaction:meet")
    monkeypatch.setattr(meet, "forward", forward)
    with pytest.raises(
        PluginError, match=r"interaction: fake_doll\.Meet raised ValueError: no cup"
    ):
        compose(parse(), clip, registry)
    monkeypatch.setattr(meet, "__module__", "hoigs.doll")
    assert refusal(parse(), clip, registry) == "my.yaml:3:14 interaction: no cup"


def test_an_interaction_that_cannot_be_bound(parse, registry, clip):
    text = TEXT.replace("human:\n", 'human:\n    features: {use: "features:centre"}\n')
    assert refusal(parse(text), clip, registry) == "my.yaml:3:14 interaction: one is enough"


def test_a_clip_without_points(parse, registry, clip):
    empty = replace(clip, points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3))
    message = refusal(parse(), empty, registry)
    assert message.startswith("my.yaml:5:10 model.scene: the clip has no scene points")


def test_settings_of_the_body(parse, registry, clip):
    def body(line: str) -> str:
        return TEXT.replace("    opacity: 0.9\n", f"    body: {{use: '{line}}}\n")

    model = compose(parse(body("body:stick', lean: 0.5")), clip, registry)
    assert model.entity("anna").deformation.context.body.lean == 0.5
    assert compose(parse(body("body:stick@doll'")), clip, registry)
    message = refusal(parse(body("body:other'")), clip, registry)
    assert message.startswith(
        "my.yaml:10:11 model.human.body: the clip's anna was fitted with body:stick"
    )


def test_a_body_that_nobody_offers(parse, registry, clip):
    track = replace(clip.bodies["anna"], model="body:stik")
    message = refusal(parse(), replace(clip, bodies={"anna": track}), registry)
    assert message.startswith("my.yaml:7:5 model.human: the clip's anna is a body:stik: no compo")
    assert 'did you mean "body:stick"?' in message


def test_a_body_that_needs_settings(parse, registry, clip):
    track = replace(clip.bodies["anna"], model="body:needy")
    message = refusal(parse(), replace(clip, bodies={"anna": track}), registry)
    assert message == (
        "my.yaml:7:5 model.human: the clip's anna is a body:needy: "
        'add `body: {use: "body:needy", path: …}` to this block'
    )

"""Which knots a scene needs: before the training by a refit, after it by what anybody would see."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from small_models import NAME, as_composed

from hoigs.core.interfaces.deformation import has_knots
from hoigs.core.maths.splines import Knots
from hoigs.core.model.entity import Entity
from hoigs.core.model.knot_refit import KnotTrial, as_movable, screen_of
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.rigid_spline import RigidSpline
from hoigs.plugins.deformation.static import Static
from hoigs.plugins.features.spline_motion import SplineMotionFeatures
from hoigs.rasterizers.oracle import OracleRasterizer
from hoigs.runs.clip_source import read_clip
from hoigs.studies.needs.prune import Pruning, fewer_uniform
from hoigs.studies.needs.result import cheapest_refit
from hoigs.studies.needs.search_space import Candidate
from hoigs.studies.needs.trial import Scores


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield read_clip(NAME)


def moving(clip: Clip, knots: int, path) -> Entity:
    """A box of points on a path (time -> metres), with an uneven `SplineMotionFeatures`."""
    torch.manual_seed(4)
    points = torch.rand(40, 3) * 0.3 + torch.tensor([0.0, 0.9, 0.3])
    features = SplineMotionFeatures(SplineMotionFeatures.Config(embedding="shared"))
    motion = RigidSpline(RigidSpline.Config(keyframes=knots))
    entity = Entity(Gaussians.from_points(points, scales=0.02), motion, features)
    times = [k / (knots - 1) for k in range(knots)]
    with torch.no_grad():
        places = torch.stack([path(t) for t in times])
        entity.deformation.keyframe_translations.copy_(places)
        entity.deformation.translation_tangents.copy_(
            entity.deformation.knots.differences(places[None])[0]
        )
    return entity


def test_an_even_motion_needs_two_knots_and_an_eight_more(clip):
    screen = screen_of(clip)
    even = moving(clip, 9, lambda t: torch.tensor([0.4 * t, 0.1 * t, 0.0]))
    assert has_knots(even.deformation) and not has_knots(Static())
    count, values = fewer_uniform(even.deformation, even.canonical.detach(), screen, 1.0)
    assert count == 2 and values["keyframe_translations"].shape == (2, 3)

    def eight(t: float) -> torch.Tensor:
        phase = 2 * math.pi * t
        return torch.tensor([0.6 * math.sin(phase), 0.4 * math.sin(2 * phase), 0.0])

    looped = moving(clip, 13, eight)
    kept = looped.deformation.keyframe_translations.detach().clone()
    count, values = fewer_uniform(looped.deformation, looped.canonical.detach(), screen, 0.2)
    assert 4 <= count < 13
    assert len(looped.deformation.knots) == 13 and not looped.deformation.knots.movable
    assert torch.equal(looped.deformation.keyframe_translations, kept)  # only asked, not changed
    finer, _ = fewer_uniform(looped.deformation, looped.canonical.detach(), screen, 0.02)
    assert finer > count


class Seen:
    """A validator whose score falls with the distance of an object from its first place."""

    affordable = True

    def __init__(self, entity: Entity, dear: float) -> None:
        self.entity, self.dear = entity, dear
        self.first = self._means()

    def _means(self) -> torch.Tensor:
        with torch.no_grad():
            return torch.stack([self.entity(Moment(t / 13)).means for t in range(14)])

    def score(self, model: object) -> Scores:
        del model
        away = (self._means() - self.first).norm(dim=-1).mean()
        return Scores({"human_object": 30.0 - self.dear * float(away)})


@pytest.mark.parametrize("dear", [0.0, 1e4])
def test_movable_knots_go_only_where_the_picture_allows(clip, dear):
    """A pixel may be worth decibels where frames are small: then they stay."""
    trained = as_composed(
        clip, "model.object.deformation={use: 'deformation:rigid-spline', keyframes: adaptive}",
        "model.object.features=null", "interaction.use=interaction:none",
    )  # fmt: skip
    entity = trained.model.entity("object")
    curve, times = entity.deformation, [k / 8 for k in range(9)]
    with KnotTrial(curve) as trial:
        trial.place(times, ())
        trial.keep()
    with torch.no_grad():
        shake = torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
        curve.keyframe_translations += 2e-3 * shake
    pruning = Pruning(trained, Seen(entity, dear))  # type: ignore[arg-type]
    pruning.knots()
    (cut,) = pruning.cuts
    assert (cut.before, cut.after) == (9, len(curve.knots))
    assert (len(curve.knots) == 9) == ("dB worse" in cut.why) == (dear > 0)
    if dear:
        torch.testing.assert_close(pruning.validator._means(), pruning.validator.first)


def trials_of(*models: SceneModel) -> dict[str, SimpleNamespace]:
    return {
        str(k): SimpleNamespace(model=model, names=("object",)) for k, model in enumerate(models)
    }


def test_a_motion_that_fewer_knots_hold_gets_fewer(clip):
    """An even sweep with a tenth of a pixel of noise takes 2 knots; an eight keeps its own; a box
    that only trembles stands still."""

    def noisy(path) -> SceneModel:
        torch.manual_seed(0)
        entity = moving(clip, 9, lambda t: path(t) + 1e-3 * torch.randn(3))
        return SceneModel({"object": entity}, rasterizer=OracleRasterizer())

    def candidate_of(path) -> int:
        still = Entity(moving(clip, 9, path).canonical, Static(), kind="object")
        space = (
            SceneModel({"object": still}, rasterizer=OracleRasterizer()),
            *(SceneModel({"object": moving(clip, k, path)}, rasterizer=OracleRasterizer())
              for k in (2, 3)),
            noisy(path),
        )  # fmt: skip
        trials = trials_of(*space)
        candidates = [Candidate(name=name, why="it does") for name in trials]
        return cheapest_refit(candidates, 3, trials, clip)  # type: ignore[arg-type]

    assert candidate_of(lambda t: torch.tensor([0.5 * t, 0.1 * t, 0.0])) == 1
    assert candidate_of(lambda t: torch.zeros(3)) == 0
    eight = lambda t: torch.tensor([math.sin(6.3 * t), 0.7 * math.sin(12.6 * t), 0.0])  # noqa: E731
    assert candidate_of(eight) == 3


@pytest.mark.parametrize("apart", [0.0, 1.0])
def test_parts_that_move_as_one_piece_are_one(clip, apart):
    """Whatever they score: a joint that does not turn is of no use, one that turns is kept."""

    def bent(t: float) -> torch.Tensor:
        return torch.tensor([0.5 * t + apart * math.sin(6.3 * t) / 5, 0.1 * t, 0.0])

    parts = moving(clip, 9, bent)
    parts.deformation.__class__ = type("Parts", (type(parts.deformation),), {})
    straight = lambda t: torch.tensor([0.5 * t, 0.1 * t, 0.0])  # noqa: E731
    models = [
        SceneModel({"object": entity}, rasterizer=OracleRasterizer())
        for entity in (moving(clip, 2, straight), moving(clip, 9, straight), parts)
    ]
    trials = trials_of(*models)
    candidates = [Candidate(name=name, why="it does") for name in trials]
    assert cheapest_refit(candidates, 2, trials, clip) == 2  # type: ignore[arg-type]
    candidates[2] = candidates[2].model_copy(update={"moves_unlike": "1"})
    # the one piece is then held by fewer knots
    assert cheapest_refit(candidates, 2, trials, clip) == (2 if apart else 0)  # type: ignore[arg-type]


def test_a_refit_of_movable_knots_leaves_their_tangents_what_they_are(clip):
    """They are per interval of the knots that it began with, however many there are now."""
    entity = moving(clip, 5, lambda t: torch.tensor([0.4 * t, 0.1 * t, 0.0]))
    curve = entity.deformation
    curve.knots = Knots(5, movable=True)
    with KnotTrial(curve) as trial:
        trial.place([k / 11 for k in range(12)], ())
        trial.keep()
    before = curve.traced(entity.canonical, [0.13, 0.5, 0.77])
    with as_movable(curve):
        torch.testing.assert_close(curve.traced(entity.canonical, [0.13, 0.5, 0.77]), before)
        count, _ = fewer_uniform(curve, entity.canonical.detach(), screen_of(clip), 0.3)
    assert count == 2


def test_fewer_knots_move_alike_and_say_the_same(clip):
    """Places within the pixel, velocities in tokens too, though their unit has changed."""
    entity = moving(clip, 9, lambda t: torch.tensor([0.4 * t, 0.3 * t * t, 0.0]))
    screen = screen_of(clip)
    count, values = fewer_uniform(entity.deformation, entity.canonical.detach(), screen, 0.2)
    assert count < 9
    fewer = moving(clip, count, lambda t: torch.zeros(3))
    state = entity.state_dict() | {f"deformation.{n}": v for n, v in values.items()}
    settings, tensors = entity.features.with_fewer_knots(9, count)
    assert settings == {"keyframes": 9}
    state |= {f"features.{name}": tensor for name, tensor in tensors.items()}
    state["features.embedding"] = fewer.features.embedding.detach() * 0
    fewer.load_state_dict(state)
    with torch.no_grad():
        entity.features.embedding.zero_()
    for time in (0.0, 0.31, 0.77, 1.0):
        moment = Moment(time)
        ours, theirs = fewer(moment), entity(moment)
        assert (ours.means - theirs.means).norm(dim=-1).max() < 0.02
    said, meant = (e.tokens(Moment(0.5)).features for e in (fewer, entity))
    assert (said - meant).norm() < 0.05 * meant.norm()

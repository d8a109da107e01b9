"""After the search: what the trained model can do without goes, cheapest question first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any

from torch import Tensor

from hoigs.plugins.deformation.knot_schedule import KnotSchedule, KnotTrial
from hoigs.plugins.features.spline_motion import SplineMotionFeatures
from hoigs.studies.needs.judge import Judge, Look
from hoigs.studies.needs.prune_knots import (
    Knotted,
    fewer_uniform,
    is_knotted,
    measure,
    remove_movable,
    slowed,
)
from hoigs.studies.needs.prune_planes import ONE, as_one, from_one, time_planes
from hoigs.studies.needs.prune_splats import rows_to_lose, sensitivities, take_out
from hoigs.studies.needs.search import SETTLE
from hoigs.studies.needs.trained import Trained, state_prefix
from hoigs.training.trainer import Trainer

VISIBLE = 0.05  # dB that one cut may cost in any region, before the model is tuned to it
PIXELS = (1.0, 0.5, 0.25)  # that nothing may move by when knots go, until nobody sees it
VIEWS = 16  # training frames whose pictures tell which Gaussians matter

NO_INTERACTION = "interaction:none"


@dataclass(frozen=True)
class Cut:
    """One thing that was asked of a trained model.

    Attributes:
        what: "knots of object". before, after: how many, of `unit`. drop: dB that it costs in the
            region where it costs most; None where it was not looked at. why: "because …".
    """

    what: str
    unit: str
    before: int
    after: int
    drop: float | None
    why: str

    def __str__(self) -> str:
        kept = f"{self.after:,} of {self.before:,} {self.unit}"
        return f"{self.what}: {kept}, because {self.why}"


@dataclass
class Pruning:
    """One model's cuts; each method is one question, and `run` asks all of them.

    Args:
        trained: the winner of a search, trained. judge: looks at it, and is paid.
        visible: dB that one cut may cost.
    """

    trained: Trained
    judge: Judge
    visible: float = VISIBLE
    report: Callable[[str], None] = lambda line: None

    def __post_init__(self) -> None:
        self.cuts: list[Cut] = []
        self.first = self.now = self.judge.look(self.trained.model)

    def run(self, tune: bool = True) -> Trained:
        """Ask everything, then train the rest on with what is left of the ledger."""
        self.tokens()
        self.planes()
        self.knots()
        self.splats()
        if tune:
            self.tune()
        return self.trained

    def tokens(self) -> None:
        """Tokens that nothing reads, or that change no picture."""
        spec, model = self.trained.spec, self.trained.model
        described = {
            key: names
            for key, names in self.trained.blocks().items()
            if spec.model[key].features is not None
        }
        if not described:
            return
        off = spec.interaction.use == NO_INTERACTION
        entities = sum(len(names) for names in described.values())
        overrides: dict[str, Any] = {f"model.{key}.features": None for key in described}
        if off:
            self._take(self.trained.asking_less(overrides), "tokens", "described entities",
                       entities, 0, 0.0, "there is no interaction to read them")  # fmt: skip
            return
        if not self.judge.affordable:
            return
        enabled, model.interaction_enabled = model.interaction_enabled, False
        without = self.judge.look(model)
        model.interaction_enabled = enabled
        drop = self.now.drop_to(without)
        if drop > self.visible:
            self._keep("tokens", "described entities", entities, drop,
                       f"the picture without interaction is {drop:.2f} dB worse")  # fmt: skip
            return
        overrides["interaction"] = {"use": NO_INTERACTION}
        less = self.trained.asking_less(overrides)
        self._take(less, "tokens", "described entities", entities, 0, drop,
                   f"without interaction nothing is more than {drop:.2f} dB worse",
                   without)  # fmt: skip

    def planes(self) -> None:
        """Time planes that are one, or might as well be."""
        for key, names in self.trained.blocks().items():
            planes = [
                p for n in names for p in time_planes(self.trained.model.entity(n).deformation)
            ]
            deformation = self.trained.spec.model[key].deformation
            if not planes or "time_resolution" not in deformation.settings:
                continue
            cells, what = sum(p.numel() for p in planes), f"time planes of {key}"
            apart, after, drop = from_one(planes), None, 0.0
            why = f"they are one everywhere (to {apart:.0e})"
            if apart > ONE:
                if not self.judge.affordable:
                    return
                with as_one(planes):
                    after = self.judge.look(self.trained.model)
                drop = self.now.drop_to(after)
                why = f"with ones in their place nothing is more than {drop:.2f} dB worse"
                if drop > self.visible:
                    self._keep(what, "values", cells, drop, f"without them it is {drop:.2f} dB "
                               "worse")  # fmt: skip
                    continue
            less = self.trained.asking_less({f"model.{key}.deformation.time_resolution": 0})
            self._take(less, what, "values", cells, 0, drop, why, after)

    def knots(self) -> None:
        """Spline knots, by a refit that moves nothing by a pixel, nor the picture by `visible`."""
        for key, names in self.trained.blocks().items():
            curves = {n: self.trained.model.entity(n).deformation for n in names}
            if not all(is_knotted(curve) for curve in curves.values()):
                continue
            movable = [c.knots.movable for c in curves.values() if is_knotted(c)]
            if all(movable):
                for name, curve in curves.items():
                    assert is_knotted(curve)
                    self._movable(name, curve)
            elif len(names) == 1 and not any(movable):
                self._uniform(key, names[0])

    def _schedule(self, pixels: float) -> KnotSchedule:
        return measure(self.trained.clip, pixels)

    def _movable(self, name: str, curve: Knotted) -> None:
        """Knots of one adaptive spline."""
        rest, before = self.trained.model.entity(name).rest, len(curve.knots)
        what, drop = f"knots of {name}", 0.0
        for pixels in PIXELS:
            if not self.judge.affordable:
                return
            with KnotTrial(curve) as trial:
                gone = remove_movable(curve, rest, self._schedule(pixels))
                if not gone:
                    break
                after = self.judge.look(self.trained.model)
                drop = self.now.drop_to(after)
                if drop <= self.visible:
                    trial.keep()
                    self.now = after
                    why = f"refitted with {before - gone}, nothing moves by {pixels:g} pixel"
                    self._tell(Cut(what, "knots", before, before - gone, drop, why))
                    return
        self._knots_kept(what, before, drop)

    def _uniform(self, key: str, name: str) -> None:
        """Knots of one uniform spline, and what of its tokens goes by them."""
        entity = self.trained.model.entity(name)
        curve, features = entity.deformation, entity.features
        assert is_knotted(curve)
        if isinstance(features, SplineMotionFeatures) and features.tau == "keyframes":
            return  # its tokens are the tangents themselves
        before, drop, what = len(curve.knots), 0.0, f"knots of {key}"
        for pixels in PIXELS:
            count, values = fewer_uniform(curve, entity.rest.detach(), self._schedule(pixels))
            if count == before:
                break
            less = self._with_knots(key, name, before, count, values)
            if not self.judge.affordable:
                return
            after = self.judge.look(less.model)
            drop = self.now.drop_to(after)
            if drop <= self.visible:
                why = f"refitted with {count}, nothing moves by {pixels:g} pixel"
                self._take(less, what, "knots", before, count, drop, why, after)
                return
        self._knots_kept(what, before, drop)

    def _with_knots(
        self, key: str, name: str, before: int, count: int, values: dict[str, Tensor]
    ) -> Trained:
        """The model with other uniform knots, and features to match."""
        features, place = self.trained.model.entity(name).features, state_prefix(name)
        changed: dict[str, Tensor] = {f"{place}deformation.{n}": v for n, v in values.items()}
        overrides: dict[str, Any] = {f"model.{key}.deformation.keyframes": count}
        if isinstance(features, SplineMotionFeatures):
            changed[f"{place}features.mlp.0.weight"] = slowed(features, before, count)
            if features.kind != "none":
                overrides[f"model.{key}.features.keyframes"] = features.keyframes or before
        return self.trained.asking_less(overrides, changed)

    def _knots_kept(self, what: str, count: int, drop: float) -> None:
        why = f"one fewer would move it by more than {PIXELS[-1]:g} pixel"
        if drop > self.visible:
            why = f"with fewer it is {drop:.2f} dB worse"
        self._keep(what, "knots", count, drop, why)

    def splats(self) -> None:
        """Gaussians by sensitivity, entity by entity."""
        frames = _spread(self.trained.clip.split["train"], VIEWS)
        views = min(len(frames), int(self.judge.ledger.left / 3))
        if views < 2:
            self.report("splats: not asked, as nothing is left to pay for it")
            return
        self.judge.ledger.spend("sensitivities", views)
        model = self.trained.model
        scores = sensitivities(model, self.trained.clip, _spread(frames, views))
        for name in list(model.entities):
            before = len(model.entity(name))
            rows, cost = rows_to_lose(self.judge, model, name, scores[name], self.now, self.visible)
            if len(rows):
                take_out(model, name, rows)
                if self.judge.affordable:
                    self.now, was = self.judge.look(model), self.now
                    cost = was.drop_to(self.now)
            unseen = int((scores[name][rows] == 0).sum())
            why = f"without the others nothing is more than {cost:.2f} dB worse"
            why += f" ({unseen:,} of these are in no picture)" if unseen else ""
            if not len(rows):
                why = "each that goes is missed"
            self._tell(Cut(f"splats of {name}", "Gaussians", before, before - len(rows), cost, why))

    def tune(self) -> None:
        """Train on with what is left, one look kept back: nothing grows so late, and all settles.

        At rates that never fall a model ends beside its optimum: on one throw, 200 steps gained
        0.03 dB of people and things at their full size, and 0.20 at a tenth of it.
        """
        steps = int(self.judge.ledger.left - self.judge.price)
        whole = self.trained.spec.train.steps
        steps = min(steps, whole // 10)
        if steps < 1 or not any(cut.before != cut.after for cut in self.cuts):
            return
        self.judge.ledger.spend("tuning", steps)
        settings = self.trained.spec.train.model_copy(deep=True)
        settings.preview_every = 0
        settings.loss.lpips = 0.0
        settings.rates.camera = 0.0
        settings.rates.settle = min(settings.rates.settle, SETTLE)
        trainer = Trainer(self.trained.model, self.trained.clip, settings)
        trainer.step = whole - steps  # the schedules' last part: rates are small, nothing grows
        kept = {k: v.clone() for k, v in self.trained.model.state_dict().items()}
        trainer.train()
        self.trained.model.eval()
        tuned = self.judge.look(self.trained.model)
        gained = mean(tuned.psnr.values()) - mean(self.now.psnr.values())
        if gained <= 0:  # what was pruned stays as it was
            self.trained.model.load_state_dict(kept)
            self.report(f"tuning by {steps} steps undone: {gained:+.2f} dB, mean of the regions")
            return
        self.report(f"tuned by {steps} steps: {gained:+.2f} dB, mean of the regions")
        self.now = tuned

    def _take(self, less: Trained, what: str, unit: str, before: int, after: int, drop: float,
              why: str, look: Look | None = None) -> None:  # fmt: skip
        self.trained = less
        self.now = look or self.now
        self._tell(Cut(what, unit, before, after, drop, why))

    def _keep(self, what: str, unit: str, count: int, drop: float, why: str) -> None:
        self._tell(Cut(what, unit, count, count, drop, why))

    def _tell(self, cut: Cut) -> None:
        self.cuts.append(cut)
        self.report(str(cut))


def _spread(positions: Sequence[int], count: int) -> list[int]:
    """At most `count` of them, evenly."""
    count = min(count, len(positions))
    return [positions[int((k + 0.5) * len(positions) / count)] for k in range(count)]

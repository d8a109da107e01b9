"""Pruning of a trained model: tokens, time planes, spline knots, Gaussians; then tuning."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import mean
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.interfaces.deformation import DeformationModel, HasKnots, has_knots
from hoigs.core.interfaces.features import ReadsKnots
from hoigs.core.maths.splines import uniform_times
from hoigs.core.model.knot_refit import KnotTrial, ScreenMotion, as_movable, remove_knots, screen_of
from hoigs.core.model.scene import SceneModel
from hoigs.core.parameters import on_host
from hoigs.core.values.clip import Clip
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.topology import TopologyChange
from hoigs.studies.needs.result import SETTLE
from hoigs.studies.needs.trial import Scores, Trained, Validator, state_prefix
from hoigs.training.trainer import Trainer

# Fewer spline knots: refit with one fewer, as long as nothing moves by a pixel.
#
# That is the criterion of SplineGS (Park et al. 2025), in the worst frame instead of the mean over
# all frames, so that a long quiet clip does not hide one jerk.

FEWEST_UNIFORM, FEWEST_MOVABLE = 2, 4


@torch.no_grad()
def fewer_movable(
    curve: HasKnots, canonical: Gaussians, screen: ScreenMotion, bounds: Sequence[float]
) -> list[tuple[float, KnotTrial]]:
    """What is left of an adaptive spline's knots for each bound, pixels: bound, and the knots to
    restore; only where there are fewer than with the bound before.

    A looser bound goes on where a tighter one stopped, which traces each removal once. The curve
    is left with the fewest.

    Args:
        bounds: of motion, ascending.
    """
    found = []
    with on_host(curve):
        near = canonical.to("cpu")
        before = screen.paths(curve, near)
    for pixels in bounds:
        count = len(curve.knots)
        with on_host(curve):
            remove_knots(curve, near, screen, pixels=pixels, minimum=FEWEST_MOVABLE, before=before)
        if len(curve.knots) < count:
            found.append((pixels, KnotTrial(curve)))
    return found


@torch.no_grad()
def fewer_uniform(
    curve: HasKnots, canonical: Gaussians, screen: ScreenMotion, pixels: float
) -> tuple[int, dict[str, Tensor]]:
    """The fewest uniform knots whose refitted motion stays within `pixels` of the present one, and
    the parameters at them, on the CPU; tangents are per interval of the new knots.

    Each count is refitted to the motion as it is now, one fewer at a time, until one fails.
    """
    count = len(curve.knots)
    canonical = canonical.to("cpu")
    with on_host(curve), as_movable(curve):
        best, values = count, _values(curve)
        before, fit = screen.paths(curve, canonical), screen.sample_times()
        for fewer in range(count - 1, FEWEST_UNIFORM - 1, -1):
            with KnotTrial(curve) as trial:
                trial.place(uniform_times(fewer), fit)
                if screen.deviation(before, screen.paths(curve, canonical)) > pixels:
                    break
                best, values = fewer, _values(curve)
    if best == count:
        return count, values
    longer = (count - 1) / (best - 1)  # tangents are displacements per interval, which is longer
    return best, {n: v * longer if "tangents" in n else v for n, v in values.items()}


def _values(curve: HasKnots) -> dict[str, Tensor]:
    """The parameters at the knots."""
    return {name: curve.get_parameter(name).detach().clone() for name in curve.knot_axes}


# Time planes that are one everywhere, and so change nothing (K-Planes, 2023; 4DGS, 2024).

ONE = 1e-4  # planes nearer to one than this change no image by a grey level


def time_planes(deformation: DeformationModel) -> list[nn.Parameter]:
    """The space-time planes of a deformation that multiplies with them; none of another."""
    planes = getattr(deformation, "planes", None)
    if not isinstance(planes, nn.Module):
        return []
    return [p for n, p in planes.named_parameters() if n.partition(".")[0] == "time"]


def from_one(planes: Sequence[nn.Parameter]) -> float:
    """The largest distance of any of their values from one."""
    return max(float((p.detach() - 1).abs().max()) for p in planes)


@contextmanager
def as_one(planes: Sequence[nn.Parameter]) -> Iterator[None]:
    """Set planes to one inside the block, and restore them after it."""
    kept = [p.detach().clone() for p in planes]
    try:
        with torch.no_grad():
            for p in planes:
                p.fill_(1.0)
        yield
    finally:
        with torch.no_grad():
            for p, value in zip(planes, kept, strict=True):
                p.copy_(value)


# Pruning of Gaussians by how much each changes the rendered images.
#
# Removing Gaussian i changes a pixel by T a c - T a C_behind, which is linear in its opacity: the
# derivative by a factor s on the opacity is the whole change (but for the cut-offs of compositing).
# The squared change, summed over pixels and channels, is the pruning score of PUP 3D-GS (Hanson et
# al. 2025, arXiv:2406.10219) and Speedy-Splat (Hanson et al. 2025, arXiv:2412.00578), here of the
# opacity alone. It is estimated with random signs v: E (d(v . C) / ds)^2 = sum (dC / ds)^2.

KEEP = 16  # fewest Gaussians that an entity keeps
HALVINGS = 5  # of the interval of counts
SURE = 1e-4  # least 1 - opacity: the derivative by the logit vanishes at one


def sensitivities(
    model: SceneModel, clip: Clip, positions: Sequence[int], *, probes: int = 1, seed: int = 0
) -> dict[str, Float[Tensor, " N"]]:
    """By entity, how much removing each Gaussian changes the images: squared error, summed over
    pixels, channels and frames. Gaussians that are visible in no frame have 0.

    Args:
        positions: of the frames that are rendered. probes: vectors of random signs for each frame.
    """
    generator = torch.Generator().manual_seed(seed)
    total: Tensor | None = None
    rows: dict[str, slice] = {}
    for position in positions:
        moment, camera = clip.moments[position], clip.cameras[position]
        with torch.no_grad():
            state = model(moment.to(model.device))
            joined = state.joined()
        rows = state.slices()
        logits = joined.opacity_logits.detach().requires_grad_()
        drawn = model.draw(
            joined.replace(opacity_logits=logits), camera.to(model.device), moment=state.moment
        ).color
        clear = (1 - torch.sigmoid(logits.detach())).clamp_min(SURE)
        squares = torch.zeros_like(clear)
        for probe in range(probes):
            signs = torch.randint(0, 2, drawn.shape, generator=generator).to(drawn) * 2 - 1
            last = probe == probes - 1
            (slope,) = torch.autograd.grad((drawn * signs).sum(), logits, retain_graph=not last)
            squares += (slope / clear).square() / probes  # d / ds = d / dlogit / (1 - o)
        total = squares if total is None else total + squares
    if total is None:
        raise ValueError("sensitivities need at least one frame")
    return {name: total[row] for name, row in rows.items()}


def removable_rows(
    validator: Validator,
    model: SceneModel,
    name: str,
    scores: Float[Tensor, " N"],
    before: Scores,
    visible: float,
) -> tuple[Int[Tensor, " L"], float]:
    """The most Gaussians of an entity, in order of sensitivity, whose removal costs at most
    `visible` dB in any region, and what it costs; by bisection, as far as the budget allows."""
    order = scores.argsort(stable=True)
    first = model.rows()[name].start
    everything = torch.ones(sum(model.count().values()), dtype=torch.bool, device=scores.device)
    fine, too_many, cost = 0, max(0, len(order) - KEEP) + 1, 0.0
    for _ in range(HALVINGS):
        count = (fine + too_many) // 2
        if count == fine or not validator.affordable:
            break
        subset = everything.clone()
        subset[first + order[:count]] = False
        drop = before.drop_to(validator.score(model, subset))
        if drop <= visible:
            fine, cost = count, drop
        else:
            too_many = count
    return order[:fine], cost


@torch.no_grad()
def remove_rows(model: SceneModel, name: str, rows: Int[Tensor, " L"]) -> None:
    """Remove rows of an entity, also from its deformation and features."""
    entity = model.entity(name)
    mask = torch.ones(len(entity), dtype=torch.bool, device=entity.means.device)
    mask[rows] = False
    entity.apply_topology(TopologyChange.keep(mask), entity.canonical[mask])


VISIBLE = 0.05  # dB that one cut may cost in any region, before tuning
PIXELS = (1.0, 0.5, 0.25)  # bounds of motion when knots are removed, tried in this order
VIEWS = 16  # training frames that the sensitivities of Gaussians are estimated from
NO_INTERACTION = "interaction:none"


@dataclass(frozen=True)
class Cut:
    """One attempt to remove a part of a trained model.

    Attributes:
        what: "knots of object". before, after: how many, of `unit`. drop: dB that it costs in the
            region that loses most; None where it was not scored. why: "because …".
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
    """The cuts of one model; each method tries one kind, and `run` tries all of them.

    Args:
        trained: the model. validator: scores it, within a budget.
        visible: dB that one cut may cost.
    """

    trained: Trained
    validator: Validator
    visible: float = VISIBLE
    report: Callable[[str], None] = lambda line: None

    def __post_init__(self) -> None:
        self.cuts: list[Cut] = []
        self.first = self.now = self.validator.score(self.trained.model)

    def run(self, tune: bool = True) -> Trained:
        """Try all cuts, then tune the pruned model with the rest of the budget."""
        self.tokens()
        self.planes()
        self.knots()
        self.splats()
        if tune:
            self.tune()
        return self.trained

    def tokens(self) -> None:
        """Remove tokens that no module reads, or that change no image visibly."""
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
            cut = Cut("tokens", "described entities", entities, 0, 0.0,
                      "there is no interaction to read them")  # fmt: skip
            self._apply(self.trained.recomposed(overrides), cut)
            return
        if not self.validator.affordable:
            return
        with model.interacting(False):
            without = self.validator.score(model)
        drop = self.now.drop_to(without)
        if drop > self.visible:
            self._keep("tokens", "described entities", entities, drop,
                       f"the picture without interaction is {drop:.2f} dB worse")  # fmt: skip
            return
        overrides["interaction"] = {"use": NO_INTERACTION}
        less = self.trained.recomposed(overrides)
        cut = Cut("tokens", "described entities", entities, 0, drop,
                  f"without interaction nothing is more than {drop:.2f} dB worse")  # fmt: skip
        self._apply(less, cut, without)

    def planes(self) -> None:
        """Remove time planes that are one, or that may be replaced by one."""
        for key, names in self.trained.blocks().items():
            models = [self.trained.model.entity(name).deformation for name in names]
            planes = [plane for model in models for plane in time_planes(model)]
            deformation = self.trained.spec.model[key].deformation
            if not planes or "time_resolution" not in deformation.settings:
                continue
            cells, what = sum(p.numel() for p in planes), f"time planes of {key}"
            apart, after, drop = from_one(planes), None, 0.0
            why = f"they are one everywhere (to {apart:.0e})"
            if apart > ONE:
                if not self.validator.affordable:
                    return
                with as_one(planes):
                    after = self.validator.score(self.trained.model)
                drop = self.now.drop_to(after)
                why = f"with ones in their place nothing is more than {drop:.2f} dB worse"
                if drop > self.visible:
                    self._keep(what, "values", cells, drop, f"without them it is {drop:.2f} dB "
                               "worse")  # fmt: skip
                    continue
            less = self.trained.recomposed({f"model.{key}.deformation.time_resolution": 0})
            self._apply(less, Cut(what, "values", cells, 0, drop, why), after)

    def knots(self) -> None:
        """Remove spline knots if a refit moves nothing by a pixel and costs at most `visible`."""
        for key, names in self.trained.blocks().items():
            curves = {n: self.trained.model.entity(n).deformation for n in names}
            knotted = {n: curve for n, curve in curves.items() if has_knots(curve)}
            if len(knotted) < len(curves):
                continue
            movable = [curve.knots.movable for curve in knotted.values()]
            if all(movable):
                for name, curve in knotted.items():
                    self._movable(name, curve)
            elif len(names) == 1 and not any(movable):
                self._uniform(key, names[0], knotted[names[0]])

    def _movable(self, name: str, curve: HasKnots) -> None:
        """Knots of one adaptive spline."""
        canonical, before = self.trained.model.entity(name).canonical, len(curve.knots)
        what, drop = f"knots of {name}", 0.0
        with KnotTrial(curve) as trial:
            fewer = fewer_movable(curve, canonical, screen_of(self.trained.clip), PIXELS[::-1])
            for pixels, less in reversed(fewer):
                if not self.validator.affordable:
                    return
                less.restore()
                after = self.validator.score(self.trained.model)
                drop = self.now.drop_to(after)
                if drop <= self.visible:
                    trial.keep()
                    self.now, left = after, len(curve.knots)
                    why = f"refitted with {left}, nothing moves by {pixels:g} pixel"
                    self._record(Cut(what, "knots", before, left, drop, why))
                    return
        self._knots_kept(what, before, drop)

    def _uniform(self, key: str, name: str, curve: HasKnots) -> None:
        """Knots of one uniform spline; the tokens that read them follow."""
        canonical, before = self.trained.model.entity(name).canonical.detach(), len(curve.knots)
        what, drop, screen = f"knots of {key}", 0.0, screen_of(self.trained.clip)
        for pixels in PIXELS:
            count, values = fewer_uniform(curve, canonical, screen, pixels)
            if count == before:
                break
            less = self._with_knots(key, name, before, count, values)
            if less is None or not self.validator.affordable:
                return
            after = self.validator.score(less.model)
            drop = self.now.drop_to(after)
            if drop <= self.visible:
                why = f"refitted with {count}, nothing moves by {pixels:g} pixel"
                self._apply(less, Cut(what, "knots", before, count, drop, why), after)
                return
        self._knots_kept(what, before, drop)

    def _with_knots(
        self, key: str, name: str, before: int, count: int, values: dict[str, Tensor]
    ) -> Trained | None:
        """The model with other uniform knots, and features to match; None where they cannot."""
        features, place = self.trained.model.entity(name).features, state_prefix(name)
        changed: dict[str, Tensor] = {f"{place}deformation.{n}": v for n, v in values.items()}
        overrides: dict[str, Any] = {f"model.{key}.deformation.keyframes": count}
        if isinstance(features, ReadsKnots):
            following = features.with_fewer_knots(before, count)
            if following is None:
                return None
            settings, tensors = following
            overrides |= {f"model.{key}.features.{n}": v for n, v in settings.items()}
            changed |= {f"{place}features.{n}": v for n, v in tensors.items()}
        return self.trained.recomposed(overrides, changed)

    def _knots_kept(self, what: str, count: int, drop: float) -> None:
        why = f"one fewer would move it by more than {PIXELS[-1]:g} pixel"
        if drop > self.visible:
            why = f"with fewer it is {drop:.2f} dB worse"
        self._keep(what, "knots", count, drop, why)

    def splats(self) -> None:
        """Remove Gaussians by sensitivity, entity by entity."""
        frames = _spread(self.trained.clip.split["train"], VIEWS)
        views = min(len(frames), int(self.validator.budget.left / 3))
        if views < 2:
            self.report("Gaussians: not tried, as the budget is spent")
            return
        self.validator.budget.spend("sensitivities", views)
        model = self.trained.model
        scores = sensitivities(model, self.trained.clip, _spread(frames, views))
        for name in list(model.entities):
            before = len(model.entity(name))
            rows, cost = removable_rows(
                self.validator, model, name, scores[name], self.now, self.visible
            )
            if len(rows):
                remove_rows(model, name, rows)
                if self.validator.affordable:
                    self.now, was = self.validator.score(model), self.now
                    cost = was.drop_to(self.now)
            unseen = int((scores[name][rows] == 0).sum())
            why = f"without the others nothing is more than {cost:.2f} dB worse"
            why += f" ({unseen:,} of these are in no training image)" if unseen else ""
            if not len(rows):
                why = "removing any of them is visible"
            what, after = f"Gaussians of {name}", before - len(rows)
            self._record(Cut(what, "Gaussians", before, after, cost, why))

    def tune(self) -> None:
        """Train with the rest of the budget, less one scoring, at the last rates of the schedules.

        Constant rates keep a model off its optimum: on one clip, 200 steps gained 0.03 dB of people
        and objects at full rates, and 0.20 dB at rates that fall to a tenth.
        """
        steps = int(self.validator.budget.left - self.validator.cost)
        whole = self.trained.spec.train.steps
        steps = min(steps, whole // 10)
        if steps < 1 or not any(cut.before != cut.after for cut in self.cuts):
            return
        self.validator.budget.spend("tuning", steps)
        settings = self.trained.spec.train.model_copy(deep=True)
        settings.preview_every = 0
        settings.loss.lpips = 0.0
        settings.rates.camera = 0.0
        settings.rates.settle = min(settings.rates.settle, SETTLE)
        trainer = Trainer(self.trained.model, self.trained.clip, settings)
        trainer.step = whole - steps  # the last part of the schedules, without density control
        kept = {k: v.clone() for k, v in self.trained.model.state_dict().items()}
        trainer.train()
        self.trained.model.eval()
        tuned = self.validator.score(self.trained.model)
        gained = mean(tuned.psnr.values()) - mean(self.now.psnr.values())
        if gained <= 0:  # keep the model as pruned
            self.trained.model.load_state_dict(kept)
            self.report(f"tuning by {steps} steps undone: {gained:+.2f} dB, mean of the regions")
            return
        self.report(f"tuned by {steps} steps: {gained:+.2f} dB, mean of the regions")
        self.now = tuned

    def _apply(self, less: Trained, cut: Cut, scores: Scores | None = None) -> None:
        self.trained = less
        self.now = scores or self.now
        self._record(cut)

    def _keep(self, what: str, unit: str, count: int, drop: float, why: str) -> None:
        self._record(Cut(what, unit, count, count, drop, why))

    def _record(self, cut: Cut) -> None:
        self.cuts.append(cut)
        self.report(str(cut))


def _spread(positions: Sequence[int], count: int) -> list[int]:
    """At most `count` of them, evenly."""
    count = min(count, len(positions))
    return [positions[int((k + 0.5) * len(positions) / count)] for k in range(count)]

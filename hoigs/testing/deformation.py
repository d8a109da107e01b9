"""Conformance of deformations: `CHECKS`, for the human or the object of a tiny synthetic clip."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import (
    DeformationModel,
    ProvidesFace,
    ProvidesField,
    ProvidesSkeleton,
    ProvidesVelocity,
    StepStatistics,
)
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import FIELDS, Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import EntityKind, Residual
from hoigs.core.values.topology import AxisChange, TopologyChange
from hoigs.testing import modules
from hoigs.testing.checks import CheckError, CheckList, Need, require, require_close, require_finite
from hoigs.testing.material import (
    FRAMES,
    HUMAN,
    OBJECT,
    TinyBody,
    body_track,
    camera_at,
    moment_at,
    object_track,
    tiny_clip,
)
from hoigs.testing.modules import (
    ModuleSubject,
    Moments,
    perturb,
    plain_state,
    require_finite_gradients,
    require_gradients,
    require_penalties,
    require_true_gradients,
    seeded,
    trained,
    unchanged,
    weighted_sum,
)

RAW = FIELDS
COUNT = 7
INSIDE = (0.0, 0.13, 0.5, 0.77, 1.0)  # times of the clip: first and last frame, and between frames
OUTSIDE = (-0.6, -0.01, 1.01, 1.6)
TRAINED = tuple(i / (FRAMES - 1) for i in range(FRAMES))


class DeformationSubject(ModuleSubject[DeformationModel]):
    """The component under check: for the human if it provides a skeleton, else for the object."""

    times = (*INSIDE, *OUTSIDE)

    @cached_property
    def declared(self) -> DeformationModel:
        """An instance, for what it declares."""
        return self.entity(perturbed=False).deformation

    @property
    def kind(self) -> EntityKind:
        return "human" if "skeleton" in self.cls.provides else "object"

    def context(self) -> BuildContext:
        """The context that a spec would pass."""
        if self.kind == "human":
            return BuildContext(HUMAN, tiny_clip(), body=TinyBody(), body_track=body_track())
        bodies = {HUMAN: TinyBody()}
        return BuildContext(OBJECT, tiny_clip(), object_track=object_track(), bodies=bodies)

    def model(self, seed: int = 0, config: Any = None) -> DeformationModel:
        config = self.config if config is None else config
        return seeded(lambda: self.cls.from_config(config, self.context()), seed)

    def entity(
        self,
        count: int = COUNT,
        *,
        seed: int = 0,
        perturbed: bool = True,
        dtype: torch.dtype = torch.float32,
        config: Any = None,
    ) -> Entity:
        """An entity of `count` Gaussians, in eval mode; by default with perturbed parameters."""
        model = self.model(seed, config)
        entity = seeded(lambda: Entity(self.canonical(model, count), model, kind=self.kind), seed)
        if perturbed:
            perturb(entity.deformation)
        return entity.to(device=self.device, dtype=dtype).eval()

    def canonical(self, model: DeformationModel, count: int) -> Gaussians:
        """Gaussians in its input space, each with its own shape and colour."""
        if self.kind == "human":
            surface = TinyBody().surface(count, body_track().poses.betas)
            points = surface.points
            if model.input_space == "world":
                body, pose = TinyBody(), body_track().poses.frame(FRAMES // 2)
                corners = body(pose).vertices[body.faces[surface.faces]]
                points = (corners * surface.barycentric[..., None]).sum(1)
        else:
            track = object_track()
            points = track.points[:count]
            if model.input_space == "world":
                points = points @ track.rotations[0].mT + track.translations[0]
        generator = torch.Generator().manual_seed(2)

        def normal(*shape: int) -> Tensor:
            return torch.randn(count, *shape, generator=generator)

        upright = torch.tensor((1.0, 0, 0, 0))
        return Gaussians(
            means=points.detach().clone(),
            quats=upright + 0.3 * normal(4),
            log_scales=0.3 * normal(3) - 3.5,
            opacity_logits=normal(),
            sh=0.3 * normal(4, 3),
        )

    made = entity

    def checked(self, made: Entity) -> DeformationModel:
        return made.deformation

    def cases(self, dtype: torch.dtype = torch.float32) -> Sequence[float]:
        return (0.4, 0.0, 0.77, 1.3)

    def outputs(self, made: Entity, case: float) -> dict[str, Tensor]:
        return self.draw(made, case).tensors()

    def at(self, entity: Entity, time: float) -> Moment:
        return moment_at(time, entity.means.dtype, entity.means.device)

    def draw(self, entity: Entity, time: float, residual: Residual | None = None) -> Gaussians:
        """The entity at `time`."""
        return entity(self.at(entity, time), residual)


CHECKS: CheckList[DeformationSubject] = CheckList("D")
CHECKS.check("D03")(modules.keeps_dtype_and_device)
CHECKS.check("D05")(modules.cases_are_independent)
CHECKS.check("D06")(modules.values_are_finite)
CHECKS.check("D16")(modules.same_seed_same_module)
CHECKS.check("D17")(modules.a_deep_copy_is_independent)
CHECKS.check("D31")(modules.rates_exist_in_the_spec)
subject = DeformationSubject.of


def require_same(what: str, got: Gaussians, expected: Gaussians, atol: float = 2e-5) -> None:
    """Every field the same to `atol`, also the signs of quaternions."""
    modules.require_same(what, got.tensors(), expected.tensors(), atol)


def changed_by(
    source: list[int], fresh: Sequence[int] = (), offsets: Tensor | None = None
) -> TopologyChange:
    """An index map; `fresh` are new rows."""
    marks = torch.zeros(len(source), dtype=torch.bool)
    marks[list(fresh)] = True
    shifts = torch.zeros(len(source), 3) if offsets is None else offsets
    return TopologyChange(torch.tensor(source, dtype=torch.int64), marks, shifts)


def apply(entity: Entity, change: TopologyChange) -> None:
    """Apply the change, with the canonical values of the sources plus offsets."""
    device = entity.means.device
    offsets = change.offsets.to(entity.means)
    change = TopologyChange(change.source.to(device), change.fresh.to(device), offsets)
    canonical = entity.canonical[change.source]
    entity.apply_topology(change, canonical.replace(means=canonical.means + offsets))


def continuous(subject: DeformationSubject) -> str | None:
    return None if subject.declared.continuous else "it declares continuous = False"


def provides(what: str) -> Need:
    def need(subject: DeformationSubject) -> str | None:
        return None if what in subject.declared.provides else f'it does not provide "{what}"'

    return need


def applies(part: str) -> Need:
    def need(subject: DeformationSubject) -> str | None:
        known = part in subject.declared.residuals
        return None if known else f'it does not declare "{part}" residuals'

    return need


def leaves_out_some(subject: DeformationSubject) -> str | None:
    missing = {"means", "pose"} - subject.declared.residuals
    return None if missing else "it declares every residual"


# D20 to D23: residuals of the interaction are applied or refused as declared.


def mean_residual(entity: Entity) -> torch.Tensor:
    generator = torch.Generator().manual_seed(11)
    return 0.1 * torch.randn(len(entity), 3, generator=generator).to(entity.means)


def pose_residual(entity: Entity) -> torch.Tensor:
    generator = torch.Generator().manual_seed(12)
    return 0.2 * torch.randn(51, 3, generator=generator).to(entity.means)


@CHECKS.check("D20", applies("means"))
def a_displacement_is_added(subject: DeformationSubject) -> None:
    """A residual of the means is added to them in the world, and changes nothing else."""
    entity = subject.entity()
    for time in INSIDE:
        plain = subject.draw(entity, time)
        moved = subject.draw(entity, time, Residual(means=mean_residual(entity)))
        expected = plain.means + mean_residual(entity)
        require_close(f"means at {time}", moved.means, expected, atol=1e-5)
        require_same(f"at {time}", moved.replace(means=plain.means), plain, atol=1e-6)


@CHECKS.check("D21", applies("pose"))
def a_pose_correction_moves_the_body(subject: DeformationSubject) -> None:
    """A residual of the pose moves Gaussians; one of zeros moves none."""
    entity = subject.entity(40)
    plain = subject.draw(entity, 0.4)
    still = subject.draw(entity, 0.4, Residual(pose=0 * pose_residual(entity)))
    require_same("a pose correction of zeros", still, plain)
    moved = subject.draw(entity, 0.4, Residual(pose=pose_residual(entity)))
    apart = float((moved.means - plain.means).norm(dim=-1).max())
    require(apart > 1e-3, f"with 0.2 rad at every joint, no Gaussian moves over {apart:.2g} m")


@CHECKS.check("D22", leaves_out_some)
def undeclared_residuals_change_nothing(subject: DeformationSubject) -> None:
    """A residual that is not declared is refused, or changes nothing."""
    entity = subject.entity()
    plain = subject.draw(entity, 0.4)
    every = {"means": mean_residual(entity), "pose": pose_residual(entity)}
    for part in sorted({"means", "pose"} - entity.deformation.residuals):
        try:
            output = subject.draw(entity, 0.4, Residual(**{part: every[part]}))
        except (ValueError, HoigsError):
            continue
        require_same(f'with a residual of the "{part}", undeclared', output, plain, atol=0.0)


@CHECKS.check("D23")
def residuals_get_gradients(subject: DeformationSubject) -> None:
    """Declared residuals get gradients, which train the interaction."""
    entity = subject.entity(40)
    every = {"means": mean_residual(entity), "pose": pose_residual(entity)}
    for part in sorted(entity.deformation.residuals):
        leaf = every[part].requires_grad_()
        loss = weighted_sum(subject.draw(entity, 0.4, Residual(**{part: leaf})).tensors())
        if loss.requires_grad:
            loss.backward()
        reached = leaf.grad is not None and bool((leaf.grad != 0).any())
        require(reached, f'no gradient reaches the residual of the "{part}"')


# D19, D24, D26, D31, D33 and D34: inputs, penalties, progress, learning rates and caches.


@CHECKS.check("D19")
def inputs_are_not_modified(subject: DeformationSubject) -> None:
    """Canonical Gaussians, poses and residuals are not written to."""
    entity = subject.entity()
    moment = subject.at(entity, 0.4)
    parts = {"means": mean_residual(entity), "pose": pose_residual(entity)}
    residual = {name: x for name, x in parts.items() if name in entity.deformation.residuals}
    inputs: dict[str, Tensor] = {f"canonical.{n}": x for n, x in entity.canonical.tensors().items()}
    inputs |= {f"residual.{name}": x for name, x in residual.items()}
    for name, pose in moment.poses.items():
        fields = {n: x for n, x in vars(pose).items() if isinstance(x, Tensor)}
        inputs |= {f"moment.poses[{name!r}].{n}": x for n, x in fields.items()}
    with unchanged("", inputs), torch.no_grad():
        entity.deformation(entity.canonical, moment, Residual(**residual))
    with unchanged("", inputs):
        drawn = entity.deformation(entity.canonical, moment, Residual(**residual))
        weighted_sum(drawn.tensors()).backward()


@CHECKS.check("D24")
def penalties_are_finite(subject: DeformationSubject) -> None:
    """Regularizers are finite scalars with finite gradients, from the start; weights are >= 0."""
    for count, perturbed in ((1, True), (7, False), (7, True)):
        entity = subject.entity(count, perturbed=perturbed).train()
        for time in (0.0, 0.4):
            subject.draw(entity, time)
            require_penalties(entity.regularizers(), subject.cls.regularizer_weights)
            subject.draw(entity, time)
            penalties = entity.regularizers()
            if penalties:
                require_finite_gradients(entity, weighted_sum(penalties))


@CHECKS.check("D26")
def values_are_finite_at_every_stage(subject: DeformationSubject) -> None:
    """In training mode, values and gradients are finite at every progress."""
    entity = subject.entity(perturbed=False).train()
    for progress in (0.0, 0.1, 0.5, 0.9, 1.0):
        entity.deformation.set_progress(progress)
        for time in INSIDE:
            output = subject.draw(entity, time)
            for name, value in output.tensors().items():
                require_finite(f"{name} at {time}, {progress:.0%} done", value)
            require_finite_gradients(entity, weighted_sum(output.tensors()))


@CHECKS.check("D33", modules.learns)
@torch.no_grad()
def no_stale_caches(subject: DeformationSubject) -> None:
    """After an optimizer step, the output has no values from before it."""
    used, fresh = subject.entity(), subject.entity()
    subject.draw(used, 0.4)
    for entity in (used, fresh):
        entity.train()
        perturb(entity, seed=6)
        entity.eval()
    require_same("after a step", subject.draw(used, 0.4), subject.draw(fresh, 0.4), atol=1e-6)


@CHECKS.check("D34")
def values_do_not_depend_on_grad_mode(subject: DeformationSubject) -> None:
    """Values are the same without gradients."""
    entity = subject.entity()
    for time in INSIDE:
        expected = subject.draw(entity, time)
        with torch.no_grad():
            got = subject.draw(entity, time)
        require_same(f"without gradients, at {time}", got, expected, atol=1e-6)


# D01 to D06: settings, shapes, dtypes, rows, moments and finite values.


@CHECKS.check("D01")
def settings_are_kept_and_survive_json(subject: DeformationSubject) -> None:
    """Building does not change the settings, and their JSON builds the same model."""
    before = subject.config.model_dump_json()
    first = subject.draw(subject.entity(), 0.5)
    after = subject.config.model_dump_json()
    require(after == before, f"from_config changed its settings from {before} to {after}")
    again = type(subject.config).model_validate(json.loads(before))
    require_same("built from JSON", subject.draw(subject.entity(config=again), 0.5), first)


@CHECKS.check("D02")
def shapes_for_any_number(subject: DeformationSubject) -> None:
    """0, 1 and 7 Gaussians give as many, with every field in its shape."""
    for count in (0, 1, 7):
        entity = subject.entity(count)
        output = subject.draw(entity, 0.4)
        shapes = {name: x.shape for name, x in entity.canonical.tensors().items()}
        for name, x in output.tensors().items():
            expected = shapes.get(name, (count, x.shape[-1]))  # channels: any number
            require(
                x.shape == expected,
                f"with {count} Gaussians, {name} is {list(x.shape)}, expected {list(expected)}",
            )


@CHECKS.check("D04")
def order_of_rows_does_not_matter(subject: DeformationSubject) -> None:
    """Permuted rows, with their parameters, give permuted outputs."""
    order = [3, 0, 6, 2, 5, 1, 4]
    plain, permuted = subject.entity(), subject.entity()
    apply(permuted, changed_by(order))
    for time in INSIDE:
        expected = subject.draw(plain, time)[order]
        require_same(f"permuted, at {time}", subject.draw(permuted, time), expected)


# D09: continuity in time.

GRID, STEEPEST, HALVINGS = 64, 3, 18
JUMP = 1e-4  # metres, radians, and units of the other fields


@CHECKS.check("D09", continuous)
@torch.no_grad()
def output_is_continuous_in_time(subject: DeformationSubject) -> None:
    """The output does not jump where it changes most."""
    entity = subject.entity(dtype=torch.float64)

    def at(time: float) -> Tensor:
        drawn = subject.draw(entity, time)
        turns = quats_to_matrices(drawn.quats)
        looks = (drawn.log_scales, drawn.opacity_logits[:, None], drawn.sh)
        return torch.cat([x.flatten(1) for x in (drawn.means, turns, *looks)], 1)

    times = [-0.05 + 1.1 * i / GRID for i in range(GRID + 1)]
    values = [at(time) for time in times]
    spans = [(float((b - a).abs().max()), i) for i, (a, b) in enumerate(pairwise(values))]
    for _, i in sorted(spans, reverse=True)[:STEEPEST]:
        low, high, a, b = times[i], times[i + 1], values[i], values[i + 1]
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            c = at(middle)
            if (c - a).abs().max() > (b - c).abs().max():
                high, b = middle, c
            else:
                low, a = middle, c
        jump = float((b - a).abs().max())
        require(
            jump < JUMP,
            f"it jumps by {jump:.3g} at time {low:.6f}; if this is intended, declare "
            "continuous = False",
        )


# Running `evolve` as training does after every step.

STEPS = 1000


@torch.no_grad()
def evolved(
    subject: DeformationSubject, entity: Entity, moments: Moments | None = None
) -> list[Mapping[str, AxisChange]]:
    """Run `evolve` for the steps of a short training; returns the changes of each step with any.

    Args:
        moments: of the deformation's parameters; they follow the changes.
    """
    found: list[Mapping[str, AxisChange]] = []
    if type(entity.deformation).evolve is DeformationModel.evolve:
        return found
    # a deformation may evolve only parameters that have moved
    perturb(entity.deformation, seed=4, size=1e-3)
    if moments is not None:
        moments.values = {n: p.detach().clone() for n, p in moments.parameters.items()}
    canonical = entity.canonical.detach()
    frames = [statistics_of(subject, entity, i) for i in range(FRAMES)]
    for step in range(1, STEPS + 1):
        statistics = replace(frames[step % FRAMES], step=step)
        entity.deformation.set_progress(step / STEPS)
        changes = entity.deformation.evolve(canonical, statistics)
        if changes:
            found.append(changes)
        for name, change in changes.items() if moments is not None else ():
            moments.follow(name, change)  # type: ignore[union-attr]
    entity.deformation.set_progress(1.0)
    return found


def statistics_of(subject: DeformationSubject, entity: Entity, frame: int) -> StepStatistics:
    """The statistics of one frame at the first step."""
    time = frame / (FRAMES - 1)
    return StepStatistics(
        moment=subject.at(entity, time),
        camera=camera_at(time).to(entity.means),
        error=torch.tensor(1.0 + 0.5 * time),
        screen_gradient=torch.linspace(0, 1, 2 * len(entity)).reshape(-1, 2).to(entity.means),
        radii=torch.full_like(entity.opacity_logits.detach(), 5.0),
        step=1,
        total_steps=STEPS,
    )


# D07, D08 and D32: every parameter gets a gradient, and gradients are true.


def loss(subject: DeformationSubject, entity: Entity, time: float) -> Tensor:
    """A loss of everything that a deformation computes at a moment."""
    values = subject.draw(entity, time).tensors()
    model, moment = entity.deformation, subject.at(entity, time)
    if "velocity" in model.provides and isinstance(model, ProvidesVelocity):
        values["velocity"] = model.velocity(entity.canonical, moment)
    if "field" in model.provides and isinstance(model, ProvidesField):
        values["field"] = model.posed_field(entity.canonical, moment)[0]
    return weighted_sum(values)


@CHECKS.check("D07", modules.learns)
def every_parameter_gets_a_gradient(subject: DeformationSubject) -> None:
    """Every trained parameter gets a gradient from some moment, once heads are not zero."""
    entity = subject.entity(perturbed=False)
    evolved(subject, entity)
    perturb(entity.deformation)
    times = (*TRAINED, *INSIDE)
    require_gradients(entity.deformation, (loss(subject, entity, time) for time in times))


@CHECKS.check("D08")
def gradients_are_derivatives(subject: DeformationSubject) -> None:
    """In float64, gradients of parameters and canonical fields agree with differences."""
    entity = subject.entity(dtype=torch.float64)
    with torch.no_grad():
        aside = torch.randn(entity.means.shape, generator=torch.Generator().manual_seed(9))
        entity.means.add_(1e-3 * aside.to(entity.means))
    # canonical values of fields in `owns` are not trained
    leaves = {n.removeprefix("deformation."): p for n, p in trained(entity).items()}
    for time in (0.37, 0.81):
        require_true_gradients(
            leaves,
            lambda time=time: weighted_sum(subject.draw(entity, time).tensors()),  # type: ignore[misc]
            cut=sorted(entity.deformation.cut_gradients),
        )


@CHECKS.check("D32")
def canonical_fields_are_trained_or_owned(subject: DeformationSubject) -> None:
    """Every field of the canonical Gaussians gets a gradient, or is declared in `owns`."""
    entity = subject.entity()
    names = set(entity.canonical.tensors())
    unknown = sorted(entity.deformation.owns - names)
    require(not unknown, f"owns names {unknown}, fields are {sorted(names)}")
    entity.zero_grad()
    weighted_sum(subject.draw(entity, 0.4).tensors()).backward()
    for name in sorted(names - entity.deformation.owns):
        slope = entity.get_parameter(name).grad
        reached = slope is not None and bool((slope != 0).any())
        require(
            reached,
            f"canonical.{name} gets no gradient; list a field that is computed here in `owns`",
        )


# D10 to D14 and D25: pruned, cloned, split and relocated rows, with optimizer moments.

OFFSET = 1e-3  # metres


def require_rows(subject: DeformationSubject, change: TopologyChange) -> None:
    """After the change, each row equals its source's, at every moment."""
    before, after = subject.entity(), subject.entity()
    for entity in (before, after):
        evolved(subject, entity)
    apply(after, change)
    for time in INSIDE:
        expected = subject.draw(before, time)[change.source]
        got = subject.draw(after, time)
        require(len(got) == len(change), f"expected {len(change)} rows, got {len(got)}")
        require_same(f"at {time}", got, expected)


@CHECKS.check("D10")
def pruning_keeps_other_rows(subject: DeformationSubject) -> None:
    """Pruning does not change the other rows."""
    require_rows(subject, changed_by([0, 2, 3, 5]))


@CHECKS.check("D11")
def clones_equal_their_sources(subject: DeformationSubject) -> None:
    """Clones, appended at the end, look and move as their sources."""
    require_rows(subject, changed_by([0, 1, 2, 3, 4, 5, 6, 2, 5], fresh=[7, 8]))


@CHECKS.check("D12")
def split_children_are_offset(subject: DeformationSubject) -> None:
    """Children of a split are about their offset away from the source, at every moment."""
    before = subject.entity(dtype=torch.float64)
    after = subject.entity(dtype=torch.float64)
    for entity in (before, after):
        evolved(subject, entity)
    offsets = torch.zeros(8, 3)
    offsets[6:] = OFFSET * torch.tensor([[0.6, -0.64, 0.48], [-0.48, 0.6, 0.64]])
    change = changed_by([0, 1, 2, 3, 5, 6, 4, 4], fresh=[6, 7], offsets=offsets)
    apply(after, change)
    for time in INSIDE:
        source, children = subject.draw(before, time)[[4, 4]], subject.draw(after, time)[6:]
        apart = (children.means - source.means).norm(dim=-1)
        # where means are the canonical ones, a steep field may move children farther apart
        far = 5.0 if "means" in after.deformation.owns else torch.inf
        require(
            ((apart > 0.2 * OFFSET) & (apart < far * OFFSET)).all(),
            f"children {OFFSET:g} m from their source in canonical space are {apart.tolist()} m "
            f"from it at {time}; add TopologyChange.offsets to all kept positions",
        )


@CHECKS.check("D13")
def relocated_rows_equal_their_sources(subject: DeformationSubject) -> None:
    """Relocated rows equal their new sources; the count stays."""
    require_rows(subject, changed_by([0, 3, 2, 3, 4, 5, 3], fresh=[1, 3, 6]))


def follow(entity: Entity, change: TopologyChange, moments: Moments) -> None:
    """Update the moments as training does before rows change."""
    for name, _ in entity.per_gaussian():
        moments.follow(name, change)
    for name, axis in entity.deformation.axis_changes(change).items():
        moments.follow(f"deformation.{name}", axis)


@CHECKS.check("D14")
def optimizer_moments_follow(subject: DeformationSubject) -> None:
    """Optimizer moments follow their rows; parameters stay the same objects."""
    entity = subject.entity()
    evolved(subject, entity)
    moments = Moments(trained(entity))
    change = changed_by([0, 2, 3, 5, 2, 6, 1, 4], fresh=[4])
    follow(entity, change, moments)
    apply(entity, change)
    now = {name: entity.get_parameter(name) for name in moments.parameters}
    for name in RAW:  # canonical values, which the kit itself has set
        now.pop(name, None)
    moments.require_in_step(now)


@CHECKS.check("D25")
def evolve_reports_its_changes(subject: DeformationSubject) -> str | None:
    """`evolve` returns every change of size, and rows still follow density control."""
    entity = subject.entity()
    before = subject.draw(entity, 0.4)
    every = dict(entity.deformation.named_parameters())
    moments = Moments({n: p for n, p in every.items() if p.requires_grad})
    changes = evolved(subject, entity, moments)
    require(
        set(dict(entity.deformation.named_parameters())) == set(every),
        "evolve adds or removes parameters; change their size",
    )
    for name, parameter in moments.parameters.items():
        now = entity.deformation.get_parameter(name)
        require(now is parameter, f"evolve made {name} another Parameter object; change its data")
        require(
            now.shape == moments.values[name].shape,
            f"after evolve {name} is {list(now.shape)}, its moments "
            f"{list(moments.values[name].shape)}; return an AxisChange for it",
        )
    after = subject.draw(entity, 0.4)
    require(len(after) == len(before), f"{len(before)} rows became {len(after)} by evolve")
    return f"it changed its size {len(changes)} times" if changes else None


# D15 and D18: checkpoints.


@CHECKS.check("D15")
def a_checkpoint_restores_it(subject: DeformationSubject) -> None:
    """The state dict after `evolve` and density control restores everything in a new instance."""
    entity = subject.entity()
    evolved(subject, entity)
    apply(entity, changed_by([0, 1, 2, 3, 4, 5, 6, 2, 5], fresh=[7, 8]))
    perturb(entity)
    fresh = subject.entity(seed=5, perturbed=False)
    fresh.resize(len(entity))
    try:
        fresh.load_state_dict(entity.state_dict())
    except RuntimeError as error:
        raise CheckError(f"a new instance cannot load the state dict: {error}") from error
    for time in INSIDE:
        got, expected = subject.draw(fresh, time), subject.draw(entity, time)
        require_same(f"loaded, at {time}", got, expected, atol=1e-6)


@CHECKS.check("D18")
def state_is_saved_without_pickle(subject: DeformationSubject) -> None:
    """The state dict holds only tensors, which safetensors saves and loads bit for bit."""
    entity = subject.entity()
    loaded = plain_state(entity)
    for name, x in entity.state_dict().items():
        require(torch.equal(loaded[name], x.cpu()), f"{name} is not the same after safetensors")


# D27 to D30: what a deformation declares in `provides`.

H = 1e-5


@CHECKS.check("D27", provides("velocity"))
@torch.no_grad()
def velocity_is_the_derivative(subject: DeformationSubject) -> None:
    """`velocity` is the time derivative of the means, up to one common factor."""
    entity = subject.entity(dtype=torch.float64)
    model = entity.deformation
    require(isinstance(model, ProvidesVelocity), "it has no method velocity(canonical, moment)")
    assert isinstance(model, ProvidesVelocity)
    found, expected = [], []
    for time in (0.07, 0.31, 0.68, 0.9):
        found.append(model.velocity(entity.canonical, subject.at(entity, time)))
        require(found[-1].shape == (COUNT, 3), f"velocity has shape {list(found[-1].shape)}")
        after, before = (subject.draw(entity, time + h).means for h in (H, -H))
        expected.append((after - before) / (2 * H))
    got, slope = torch.stack(found), torch.stack(expected)
    factor = (got * slope).sum() / slope.square().sum()
    require(float(factor) > 0, f"velocity is {float(factor):.3g} times the derivative of the means")
    scale = float((factor * slope).abs().max())
    require_close("velocity, in its own unit", got, factor * slope, atol=1e-4 * scale)


@CHECKS.check("D28", provides("field"))
def the_field_describes_every_part(subject: DeformationSubject) -> None:
    """`posed_field` has finite features and moving positions of points on all 16 parts."""
    entity = subject.entity()
    model = entity.deformation
    require(isinstance(model, ProvidesField), "it has no posed_field, field_parts or field_width")
    assert isinstance(model, ProvidesField)
    parts = model.field_parts()
    missing = sorted(set(range(len(PART_NAMES))) - set(parts.tolist()))
    require(not missing, f"no point of the field on {[PART_NAMES[i] for i in missing]}")
    positions = []
    for time in (-0.2, 0.0, 0.6, 1.0, 1.2):
        features, at = model.posed_field(entity.canonical, subject.at(entity, time))
        expected = (len(parts), model.field_width)
        require(features.shape == expected, f"features are {list(features.shape)}, not {expected}")
        require(at.shape == (len(parts), 3), f"positions are {list(at.shape)}")
        require_finite("features of the field", features)
        require_finite("positions of the field", at)
        positions.append(at)
    require(
        (positions[1] - positions[3]).norm(dim=-1).max() > 0.05,
        "its points do not move in the world",
    )


@CHECKS.check("D29", provides("skeleton"))
def the_skeleton_is_where_the_body_is(subject: DeformationSubject) -> None:
    """Anchors, arm length, pose and parts of the Gaussians match the body."""
    entity = subject.entity(40)
    model = entity.deformation
    require(isinstance(model, ProvidesSkeleton), "it lacks a method of ProvidesSkeleton")
    assert isinstance(model, ProvidesSkeleton)
    moment = subject.at(entity, 0.4)
    pose, anchors = model.pose(moment), model.anchors(moment)
    require(isinstance(pose, BodyPose), f"pose is a {type(pose).__name__}")
    require(anchors.shape == (5, 3), f"anchors have shape {list(anchors.shape)}, expected [5, 3]")
    drawn = subject.draw(entity, 0.4).means
    far = float(torch.cdist(anchors, drawn).amin(1).max())
    require(far < 0.5, f"an anchor is {far:.2f} m from every Gaussian")
    arm = float(model.arm_length())
    require(0.2 < arm < 1.5, f"the arm is {arm:.2f} m long; the tiny body's is 0.66 m")
    parts = model.point_parts()
    good = parts.shape == (40,) and bool(((parts >= 0) & (parts < len(PART_NAMES))).all())
    require(good, "point_parts is not a number from 0 to 15 for each Gaussian")


@CHECKS.check("D30", provides("face"))
def the_face_is_rows_with_normals(subject: DeformationSubject) -> None:
    """The face is rows of the Gaussians with unit normals."""
    entity = subject.entity(200)
    model = entity.deformation
    require(isinstance(model, ProvidesFace), "it has no face_points")
    assert isinstance(model, ProvidesFace)
    rows, normals = model.face_points()
    inside = bool(((rows >= 0) & (rows < len(entity))).all())
    require(
        inside and len(set(rows.tolist())) == len(rows),
        "face rows are not distinct rows of the Gaussians",
    )
    require_close("length of the normals", normals.norm(dim=-1), torch.ones(len(rows)), atol=1e-4)

"""GroupedAdam: Adam with a learning-rate schedule for each role of a parameter."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, get_args

import torch
from jaxtyping import Bool
from torch import Tensor, nn

from hoigs.core.errors import PluginError, SpecError, did_you_mean
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import RatesSpec, WarmupSpec, rate_names
from hoigs.core.values.tokens import EntityKind
from hoigs.core.values.topology import AxisChange, TopologyChange

if TYPE_CHECKING:
    from hoigs.core.fast.adam import AdamKernel

FIELD_RATES = {
    "means": "means",
    "quats": "rotation",
    "log_scales": "scale",
    "opacity_logits": "opacity",
    "sh": "sh",
}

# rates that are zero during a warm-up: rate -> field of WarmupSpec
WARMUPS = {
    "keyframes": "motion",
    "keyframe_rotation": "motion",
    "pose": "poses",
    "shape": "poses",
    "camera": "cameras",
}
STATE = ("exp_avg", "exp_avg_sq", "step")  # what torch's Adam keeps of a parameter
SETTLE_FROM = 0.8  # share of a schedule after which rates without a `_final` decay by `settle`


@dataclass(frozen=True)
class Schedule:
    """Learning rate of one group, log-linear from `start` to `final`.

    Attributes:
        end: share of the run at which it is `final`, and after which it is zero; the two below are
            shares of that. begin: before which the rate is zero. decay_from: before which it is
            `start`, a warm-up aside.
    """

    start: float
    final: float
    begin: float = 0.0
    decay_from: float = 0.0
    end: float = 1.0

    def at(self, progress: float) -> float:
        """Rate at `progress` in [0, 1] of the run."""
        progress /= self.end
        if progress < self.begin or progress > 1 or self.start == 0:
            return 0.0
        decayed = max(progress - self.decay_from, 0.0) / (1 - self.decay_from)
        return float(self.start * (max(self.final, 1e-12) / self.start) ** decayed)


def entity_extent(entity: Entity, scene_extent: float) -> float:
    """Factor of an entity's position rates, metres: its own radius, or the scene's extent."""
    if entity.kind == "scene" or len(entity) == 0:
        return scene_extent
    means = entity.means.detach()
    return 1.1 * float((means - means.mean(0)).norm(dim=-1).max().clamp_min(1e-3))


def trained_throughout(name: str, entity: Entity | None) -> bool:
    """Whether a parameter is trained to the end: of a scene, or of the cameras."""
    return name.startswith("cameras.") or (entity is not None and entity.kind == "scene")


def rate_of(parameter: str, rates: Mapping[str, str]) -> str:
    """The rate of a module's parameter, by the longest prefix that the module declares."""
    prefixes = [prefix for prefix in rates if parameter.startswith(prefix)]
    return rates[max(prefixes, key=len)] if prefixes else "networks"


def named_rates(model: SceneModel) -> Iterator[tuple[str, nn.Parameter, str, Entity | None]]:
    """Every trainable parameter with its dotted name, its rate's name and its entity."""
    for name in model.entities:
        entity = model.entity(name)
        for path, parameter in entity.named_parameters():
            head, _, tail = path.partition(".")
            module = getattr(entity, head) if tail else None
            rate = FIELD_RATES[path] if module is None else rate_of(tail, module.rates)
            if parameter.requires_grad:
                yield f"entities.{name}.{path}", parameter, rate, entity
    for head, module in (("interaction", model.interaction), ("decoder", model.decoder)):
        for path, parameter in () if module is None else module.named_parameters():
            if parameter.requires_grad:
                yield f"{head}.{path}", parameter, rate_of(path, getattr(module, "rates", {})), None


class GroupedAdam:
    """Adam with a schedule for each parameter of a scene.

    Parameters with equal schedules share a group, as each group costs kernel launches. When the
    number of Gaussians changes the groups stay, and `follow` changes the moments.

    Args:
        scene_extent: metres; see `entity_extent`.
        cameras: its parameters take the rate "camera" and are named "cameras.…".
        steps: of the training. settled: after which people, objects and the interaction are done.

    Raises:
        PluginError: a component declares a rate that `train.rates` does not have.
        SpecError: `rates.by_entity` names an entity that the model does not have.
    """

    def __init__(
        self,
        model: SceneModel,
        rates: RatesSpec,
        warmup: WarmupSpec,
        scene_extent: float,
        cameras: nn.Module | None = None,
        *,
        steps: int = 1,
        settled: int | None = None,
    ) -> None:
        for named in rates.by_entity:
            known = [*model.entities, *get_args(EntityKind)]
            if named not in known:
                raise SpecError(
                    f'train.rates.by_entity: there is no entity or kind "{named}"'
                    f"{did_you_mean(named, known)} (has: {', '.join(sorted(set(known)))})"
                )
        self.names: dict[str, nn.Parameter] = {}
        self.roles: list[str] = []  # the rate's name for each parameter, in the order of `names`
        self.schedules: list[Schedule] = []  # one for each parameter, in the same order
        views = [] if cameras is None else cameras.named_parameters(prefix="cameras")
        trained = chain(named_rates(model), ((name, p, "camera", None) for name, p in views))
        for name, parameter, rate, entity in trained:
            own = rates if entity is None else rates.of(name.split(".")[1], entity.kind)
            start = getattr(own, rate, None)
            if start is None:
                rates_known = ", ".join(rate_names())
                raise PluginError(
                    f"{name} declares the rate {rate!r}; train.rates has {rates_known}"
                )
            final = getattr(own, f"{rate}_final", None)
            settles = final is None and own.settle < 1
            if final is None:
                final = start * own.settle
            if rate in own.by_extent and entity is not None:
                extent = entity_extent(entity, scene_extent)
                start, final = start * extent, final * extent
            lasts = steps if settled is None or trained_throughout(name, entity) else settled
            if rate == "means" and own.means_steps is not None:
                slower = min(1.0, own.means_steps / lasts)
                start, final = start * slower, final * slower
            begin = getattr(warmup, WARMUPS[rate]) if rate in WARMUPS else 0.0
            # fused Adam on a CPU treats memory as dense, and would miss elements of a view
            parameter.data = parameter.data.contiguous()
            self.names[name] = parameter
            self.roles.append(rate)
            decay_from = SETTLE_FROM if settles else 0.0
            self.schedules.append(Schedule(start, final, begin, decay_from, lasts / steps))
        groups: dict[Schedule, list[nn.Parameter]] = {}
        for parameter, schedule in zip(self.names.values(), self.schedules, strict=True):
            groups.setdefault(schedule, []).append(parameter)
        # eps as in 3DGS: gradients of single Gaussians are tiny, the default would dominate them
        self.adam = torch.optim.Adam(
            [{"params": members, "lr": s.start, "schedule": s} for s, members in groups.items()],
            lr=1e-3, eps=1e-15, fused=True,
        )  # fmt: skip
        self._kernel: AdamKernel | None = None
        self.sh_rest = rates.sh_rest
        self.progress = 0.0

    def set_progress(self, progress: float) -> None:
        self.progress = progress
        for group in self.adam.param_groups:
            group["lr"] = group["schedule"].at(progress)

    def learning_rates(self) -> dict[str, float]:
        """Present learning rate of each parameter, by name."""
        now = {group["schedule"]: float(group["lr"]) for group in self.adam.param_groups}
        return {name: now[s] for name, s in zip(self.names, self.schedules, strict=True)}

    def schedule_of(self, name: str) -> Schedule:
        """The schedule of a parameter, by its name."""
        return self.schedules[list(self.names).index(name)]

    def position_rate(self, entity: str) -> float:
        """Present learning rate of an entity's positions, metres a step.

        That of its canonical means, or of the keyframes of a deformation that owns the means; 0 if
        neither is trained.
        """
        prefix, keyed = f"entities.{entity}.", [0.0]
        for name, role, schedule in zip(self.names, self.roles, self.schedules, strict=True):
            if name == f"{prefix}means":
                return schedule.at(self.progress)
            if name.startswith(prefix) and role == "keyframes":
                keyed.append(schedule.at(self.progress))
        return max(keyed)

    def step(self, sh_degree: int | None = None, finite: Bool[Tensor, ""] | None = None) -> None:
        """One update of all parameters.

        Args:
            sh_degree: spherical harmonics above it get no gradient; None trains all.
            finite: on the device; where it is False nothing changes, and nobody waits to know.
        """
        colors = [p for p, r in zip(self.names.values(), self.roles, strict=True) if r == "sh"]
        if sh_degree is not None:
            for parameter in colors:
                if parameter.grad is not None:
                    parameter.grad[:, (sh_degree + 1) ** 2 :] = 0
        slowed = [p for p in colors if p.shape[1] > 1] if self.sh_rest != 1 else []
        before = [parameter.detach()[:, 1:].clone() for parameter in slowed]
        if finite is None:
            self.adam.step()
        else:
            self._step_where(finite)
        for parameter, old in zip(slowed, before, strict=True):  # Adam's step is linear in its rate
            parameter.data[:, 1:].lerp_(old, 1 - self.sh_rest)

    @torch.no_grad()
    def _step_where(self, finite: Bool[Tensor, ""]) -> None:
        """`self.adam.step()` by one kernel, and only where gradients were found to be finite."""
        if self._kernel is None:
            from hoigs.core.fast.adam import AdamKernel  # loads Warp

            self._kernel = AdamKernel(self.adam.defaults["betas"], self.adam.defaults["eps"])
        stepped, rates = [], []
        for group in self.adam.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.adam.state[parameter]
                if not state:
                    state["step"] = torch.zeros((), device=parameter.device)
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                stepped.append((parameter, parameter.grad, *map(state.get, STATE)))
                rates.append(float(group["lr"]))
        self._kernel(stepped, rates, finite)

    def zero_grad(self) -> None:
        self.adam.zero_grad(set_to_none=True)

    @torch.no_grad()
    def follow(self, parameter: nn.Parameter, change: TopologyChange | AxisChange) -> None:
        """Change the moments of a parameter like its entries; those of fresh entries are zero."""
        if isinstance(change, TopologyChange):
            change = AxisChange(0, change.source, change.fresh)
        state = self.adam.state.get(parameter, {})
        for key in ("exp_avg", "exp_avg_sq"):
            if key in state:
                state[key] = change.follow(state[key])

    @torch.no_grad()
    def forget(self, parameter: nn.Parameter) -> None:
        """Zero the moments of a parameter whose values were reset."""
        for key in ("exp_avg", "exp_avg_sq"):
            if key in self.adam.state.get(parameter, {}):
                self.adam.state[parameter][key].zero_()

    def tensors(self) -> dict[str, torch.Tensor]:
        """Moments and step counts by parameter name, for a checkpoint."""
        return {
            f"{name}.{key}": value
            for name, parameter in self.names.items()
            for key, value in self.adam.state.get(parameter, {}).items()
        }

    def load_tensors(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restore what `tensors` gave, onto the devices of the parameters.

        Raises:
            ValueError: moments have another shape than their parameter.
        """
        for name, parameter in self.names.items():
            state = {
                key: tensors[f"{name}.{key}"].to(parameter.device, copy=True)
                for key in ("step", "exp_avg", "exp_avg_sq")
                if f"{name}.{key}" in tensors
            }
            for key, value in state.items():
                if key != "step" and value.shape != parameter.shape:
                    raise ValueError(
                        f"{key} of {name} has shape {list(value.shape)}, expected "
                        f"{list(parameter.shape)}"
                    )
            if state:
                self.adam.state[parameter] = state

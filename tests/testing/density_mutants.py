"""Density controls with one mistake each."""

from __future__ import annotations

import random

import torch

from hoigs.core.config import ComponentConfig
from hoigs.core.density import DensityControl, Refinement, step_generator
from hoigs.core.topology import TopologyChange


class RightDensityConfig(ComponentConfig):
    pass


class RightDensity(DensityControl):
    """Every hundred steps, children beside those that ask for them, up to a cap."""

    cap = 80
    seed = 0

    def asking(self, statistics):
        return statistics.mean_gradient > 2e-4

    def room(self, rest):
        return max(0, self.cap - len(rest))

    def refine(self, rest, current, statistics, *, step, total_steps, extent):
        if step % 100 or len(rest) == 0:
            return None
        count = len(rest)
        chosen = self.asking(statistics).nonzero().squeeze(1)[: self.room(rest)]
        source = torch.cat((torch.arange(count), chosen))
        fresh = torch.arange(len(source)) >= count
        generator = step_generator(self.seed, step, rest.means.device)
        offsets = 0.01 * torch.randn(len(source), 3, generator=generator) * fresh[:, None]
        new = rest[source]
        new = new.replace(means=new.means + offsets)
        return Refinement(TopologyChange(source, fresh, offsets), new)

    def perturb(self, rest, *, step, total_steps, rate):
        generator = step_generator(1, step, rest.means.device)
        return rate * torch.randn(len(rest), 3, generator=generator)

    def regularizers(self, current):
        return {"opacity": current.opacities.mean()} if len(current) else {}


class Changed(RightDensity):
    """`amend` alters the decision."""

    def amend(self, decision, step):
        return decision

    def refine(self, rest, current, statistics, *, step, total_steps, extent):
        found = super().refine(
            rest, current, statistics, step=step, total_steps=total_steps, extent=extent
        )
        return None if found is None else self.amend(found, step)


class CountsFromTheEnd(Changed):
    def amend(self, decision, step):
        change = decision.change
        count = int((~change.fresh).sum())  # no row goes
        source = change.source - count * change.fresh
        return Refinement(TopologyChange(source, change.fresh, change.offsets), decision.rest)


class NoCap(RightDensity):
    def room(self, rest):
        return 10


class ShrinksAll(Changed):
    def amend(self, decision, step):
        rest = decision.rest
        return Refinement(decision.change, rest.replace(log_scales=rest.log_scales - 0.1))


class HidesOffsets(Changed):
    def amend(self, decision, step):
        change = decision.change
        hidden = TopologyChange(change.source, change.fresh, 0 * change.offsets)
        return Refinement(hidden, decision.rest)


class SpreadOfOne(Changed):
    def amend(self, decision, step):
        rest = decision.rest
        same = rest.log_scales + 0.0 * rest.log_scales.std(0)
        return Refinement(decision.change, rest.replace(log_scales=same))


class NeedsOneRow(RightDensity):
    def refine(self, rest, *args, **kwargs):
        rest.means.amax()
        return super().refine(rest, *args, **kwargs)


class ResetsToNothing(Changed):
    def amend(self, decision, step):
        ceiling = 0.0 if step == 300 else None
        return Refinement(decision.change, decision.rest, ceiling)


class OwnDice(RightDensity):
    def __init__(self) -> None:
        self.seed = random.randrange(2**31)


class RemembersTheCloud(Changed):
    last = None
    met = 0

    def refine(self, rest, *args, **kwargs):
        self.met += self.last is not None and self.last is not rest
        self.last = rest
        self.seed = int(self.met > 0)
        return super().refine(rest, *args, **kwargs)


class ForgetsRadii(RightDensity):
    def asking(self, statistics):
        statistics.max_radius.zero_()
        return super().asking(statistics)


class NeverStill(RightDensity):
    def perturb(self, rest, *, step, total_steps, rate):
        return super().perturb(rest, step=step, total_steps=total_steps, rate=rate + 1e-6)


class MeanOfNone(RightDensity):
    def regularizers(self, current):
        return {"opacity": current.opacities.mean()}


class SecretlyAbsolute(RightDensity):
    def asking(self, statistics):
        return statistics.mean_absolute_gradient > 6e-4


MUTANTS = {
    "N01": CountsFromTheEnd,
    "N02": NoCap,
    "N03": ShrinksAll,
    "N04": HidesOffsets,
    "N05": SpreadOfOne,
    "N06": NeedsOneRow,
    "N07": ResetsToNothing,
    "N08": OwnDice,
    "N09": RemembersTheCloud,
    "N10": ForgetsRadii,
    "N11": NeverStill,
    "N12": MeanOfNone,
    "N13": SecretlyAbsolute,
}

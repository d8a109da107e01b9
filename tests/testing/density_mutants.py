"""Density controls with one mistake each."""

from __future__ import annotations

import random

import torch

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.density import DensityControl, Refinement, step_generator
from hoigs.core.values.topology import TopologyChange


class RightDensityConfig(ComponentConfig):
    pass


class RightDensity(DensityControl):
    """Correct: every hundred steps it clones, with offsets, up to a cap."""

    cap = 80
    seed = 0

    def above(self, statistics):
        return statistics.mean_gradient > 2e-4

    def room(self, canonical):
        return max(0, self.cap - len(canonical))

    def refine(self, canonical, current, statistics, *, step, total_steps, extent):
        if step % 100 or len(canonical) == 0:
            return None
        count = len(canonical)
        chosen = self.above(statistics).nonzero().squeeze(1)[: self.room(canonical)]
        source = torch.cat((torch.arange(count), chosen))
        fresh = torch.arange(len(source)) >= count
        generator = step_generator(self.seed, step, canonical.means.device)
        offsets = 0.01 * torch.randn(len(source), 3, generator=generator) * fresh[:, None]
        new = canonical[source]
        new = new.replace(means=new.means + offsets)
        return Refinement(TopologyChange(source, fresh, offsets), new)

    def perturb(self, canonical, *, step, total_steps, rate):
        generator = step_generator(1, step, canonical.means.device)
        return rate * torch.randn(len(canonical), 3, generator=generator)

    def regularizers(self, current):
        return {"opacity": current.opacities.mean()} if len(current) else {}


class Changed(RightDensity):
    """`amend` alters the decision."""

    def amend(self, decision, step):
        return decision

    def refine(self, canonical, current, statistics, *, step, total_steps, extent):
        found = super().refine(
            canonical, current, statistics, step=step, total_steps=total_steps, extent=extent
        )
        return None if found is None else self.amend(found, step)


class CountsFromTheEnd(Changed):
    def amend(self, decision, step):
        change = decision.change
        count = int((~change.fresh).sum())  # no row goes
        source = change.source - count * change.fresh
        return Refinement(TopologyChange(source, change.fresh, change.offsets), decision.canonical)


class NoCap(RightDensity):
    def room(self, canonical):
        return 10


class ShrinksAll(Changed):
    def amend(self, decision, step):
        canonical = decision.canonical
        return Refinement(decision.change, canonical.replace(log_scales=canonical.log_scales - 0.1))


class HidesOffsets(Changed):
    def amend(self, decision, step):
        change = decision.change
        hidden = TopologyChange(change.source, change.fresh, 0 * change.offsets)
        return Refinement(hidden, decision.canonical)


class SpreadOfOne(Changed):
    def amend(self, decision, step):
        canonical = decision.canonical
        same = canonical.log_scales + 0.0 * canonical.log_scales.std(0)
        return Refinement(decision.change, canonical.replace(log_scales=same))


class NeedsOneRow(RightDensity):
    def refine(self, canonical, *args, **kwargs):
        canonical.means.amax()
        return super().refine(canonical, *args, **kwargs)


class ResetsToNothing(Changed):
    def amend(self, decision, step):
        ceiling = 0.0 if step == 300 else None
        return Refinement(decision.change, decision.canonical, ceiling)


class OwnDice(RightDensity):
    def __init__(self) -> None:
        self.seed = random.randrange(2**31)


class RemembersTheCloud(Changed):
    last = None
    met = 0

    def refine(self, canonical, *args, **kwargs):
        self.met += self.last is not None and self.last is not canonical
        self.last = canonical
        self.seed = int(self.met > 0)
        return super().refine(canonical, *args, **kwargs)


class ForgetsRadii(RightDensity):
    def above(self, statistics):
        statistics.max_radius.zero_()
        return super().above(statistics)


class NeverStill(RightDensity):
    def perturb(self, canonical, *, step, total_steps, rate):
        return super().perturb(canonical, step=step, total_steps=total_steps, rate=rate + 1e-6)


class MeanOfNone(RightDensity):
    def regularizers(self, current):
        return {"opacity": current.opacities.mean()}


class SecretlyAbsolute(RightDensity):
    def above(self, statistics):
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

"""F53, F55: errors of published code, which hoigs reproduces only by setting."""

from __future__ import annotations

import torch

from hoigs.core.model.entity import Entity
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.plugins.deformation.zoo.ex4dgs import log_presence
from hoigs.studies.stress.case import CheckResult
from hoigs.studies.stress.checks.toy import component


def opacity_over_time() -> CheckResult:
    """Opacity of Ex4DGS (Lee et al. 2024) about its first centre: corrected, and as published."""
    centers, widths = torch.tensor([[2.0, 5.0]]), torch.zeros(1, 2)
    steps = {}
    for jump in (False, True):
        times = torch.linspace(1.5, 5.5, 4001).tolist()
        values = torch.cat([log_presence(centers, widths, t, 0.1, jump=jump).exp() for t in times])
        steps[jump] = float((values[1:] - values[:-1]).abs().max())
    return CheckResult(
        steps[False] < 2e-3 and steps[True] > 0.9,
        f"largest step in a thousandth of a frame: {steps[False]:.1g}; with `opacity_jump` "
        f"{steps[True]:.2f}",
    )


def penalty_of_the_table() -> CheckResult:
    """The table smoothness of E-D3DGS (Bae et al. 2024) on a table with one odd row."""
    found = {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for smoothing in ("neighbours", "last-row"):
            for odd in (4, 8):
                model = component(
                    "deformation:embedded", embedding=2, table=3, rows=9, coarse_rows=9, width=8,
                    neighbours=1, table_smoothness=smoothing,
                )  # fmt: skip
                entity = Entity(Gaussians.from_points(torch.eye(3)), model).train()
                with torch.no_grad():
                    model.time_table.zero_()
                    model.time_table[odd] = 1.0
                entity(Moment(0.5))
                found[smoothing, odd] = float(entity.regularizers()["table_smoothness"].detach())
    # second differences: 1, -2, 1 about an odd middle row, 1 before an odd last one
    corrected = abs(found["neighbours", 4] / found["neighbours", 8] - 6) < 1e-4
    # against the last row, an odd last row is off from all others, an odd middle one from it alone
    published = found["last-row", 8] > 4 * found["last-row", 4] > 0
    words = ", ".join(f"{s} row {o}: {v:.3g}" for (s, o), v in found.items())
    return CheckResult(corrected and published, words)

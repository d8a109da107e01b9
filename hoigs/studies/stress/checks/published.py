"""F53, F55: slips of published code that are reproduced where asked for, and mended elsewhere."""

from __future__ import annotations

import torch

from hoigs.core.entity import Entity
from hoigs.core.gaussians import Gaussians
from hoigs.core.moment import Moment
from hoigs.plugins.deformation.embedded import Embedded
from hoigs.plugins.deformation.temporal_opacity import log_presence
from hoigs.studies.stress.finding import Finding


def opacity_over_time() -> Finding:
    """Ex4DGS's opacity around its first centre: mended, and as its code has it."""
    centers, widths = torch.tensor([[2.0, 5.0]]), torch.zeros(1, 2)
    steps = {}
    for jump in (False, True):
        times = torch.linspace(1.5, 5.5, 4001).tolist()
        values = torch.cat([log_presence(centers, widths, t, 0.1, jump=jump).exp() for t in times])
        steps[jump] = float((values[1:] - values[:-1]).abs().max())
    return Finding(
        steps[False] < 2e-3 and steps[True] > 0.9,
        f"largest step in a thousandth of a frame: {steps[False]:.1g}; with `opacity_jump` "
        f"{steps[True]:.2f}",
    )


def penalty_of_the_table() -> Finding:
    """E-D3DGS's smoothness of a table over time that is constant but for one row."""
    found = {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for smoothing in ("neighbours", "last-row"):
            for odd in (4, 8):
                model = Embedded(2, 3, 9, 9, width=8, neighbours=1, table_smoothness=smoothing)
                entity = Entity(Gaussians.from_points(torch.eye(3)), model).train()
                with torch.no_grad():
                    model.time_table.zero_()
                    model.time_table[odd] = 1.0
                entity(Moment(0.5))
                found[smoothing, odd] = float(entity.regularizers()["table_smoothness"].detach())
    # second differences: 1, -2, 1 about an odd middle row, 1 before an odd last one
    mended = abs(found["neighbours", 4] / found["neighbours", 8] - 6) < 1e-4
    # against the last row, an odd last row is off from all others, an odd middle one from it alone
    slip = found["last-row", 8] > 4 * found["last-row", 4] > 0
    words = ", ".join(f"{s} row {o}: {v:.3g}" for (s, o), v in found.items())
    return Finding(mended and slip, words)

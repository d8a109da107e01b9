"""Verdicts for tests of what is drawn and written: nobody trained anything."""

from __future__ import annotations

import random

from hoigs.evaluation.protocol import NotComputed, Value
from hoigs.studies.stress.case import Case, all_cases
from hoigs.studies.stress.measures import MEASURES
from hoigs.studies.stress.verdict import Seed, Table, Verdict, level_of, make_table, verdict_of

MACHINE = "Xeon A, 2 cores; torch 2.13.0, warp 1.19.0"
PROTOCOL = ("6 frames of split 'test' from training cameras.", "96x96, float pixels.")
SPECS = ("hoigs", "4dgs@matched", "d3dgs@matched", "ex4dgs@matched", "static-3dgs")


def values(level: int, strength: float, noise: float) -> dict[str, Value]:
    """Scores that fall as it gets harder, faster for the weak."""
    fall = level**1.5 / strength
    found: dict[str, Value] = {
        name: 26 - fall + noise if m.better == "higher" else 0.02 * (1 + fall)
        for name, m in MEASURES.items()
    }
    found |= {"gaussians": 4000.0 * (1 + 0.1 * fall), "iou_human": NotComputed("made up")}
    return found | {"iou_object": 0.9 - 0.05 * fall}


def knob_verdict(case: Case, spec: str, seeds: int, strength: float) -> Verdict:
    """A chain of made-up levels, each seed until it breaks."""
    noise, found = random.Random(f"{case.id} {spec}"), []
    for seed in range(seeds):
        first, levels = values(0, strength, 0.0), []
        for i, value in enumerate(case.sweep.values):
            now = values(i, strength, noise.gauss(0, 0.1) if i else 0.0)
            levels.append(
                level_of(case.sweep, value, now, first, f"runs/{case.id}/{spec}-{seed}-{i}")
            )
            if not levels[-1].stands:
                break
        found.append(Seed(seed, tuple(levels)))
    return verdict_of(case, spec, strength < 1, found, machines=(MACHINE,), protocol=PROTOCOL)


def table(seeds: int = 3, cases: tuple[Case, ...] | None = None) -> Table:
    """Every case, with verdicts of all kinds."""
    chosen = all_cases() if cases is None else cases
    found = []
    for i, case in enumerate(chosen):
        for j, spec in enumerate(SPECS):
            if (i + j) % 7 == 6:
                found.append(Verdict(case.id, spec, "not applicable", "has not: a body"))
            else:
                found.append(knob_verdict(case, spec, seeds, (4.0, 2.0, 1.0, 0.5, 8.0)[j]))
    return make_table(chosen, {s: s for s in SPECS}, found, {"date": "2030-01-01"})

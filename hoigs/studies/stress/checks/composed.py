"""F08 to F10, F13, F14, F29, F48, F54, F56: checks of a composed model, after a few steps."""

from __future__ import annotations

import resource
from dataclasses import replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.studies.stress.bench import Bench, rate_of, tiny_clip
from hoigs.studies.stress.case import CheckResult
from hoigs.training.objective import JointObjective
from hoigs.training.trainer import Trainer

GROWTH_MB = 1000.0


@torch.no_grad()
def _means(bench: Bench, time: float) -> Float[Tensor, "N 3"]:
    return bench.model(bench.at(time)).joined().means


def _step(bench: Bench, a: float, b: float) -> float:
    """Mean displacement of the Gaussians that move, metres."""
    way = (_means(bench, a) - _means(bench, b)).norm(dim=-1)
    moving = way > 1e-9
    return float(way[moving].mean()) if moving.any() else 0.0


def before_the_first_frame(bench: Bench) -> CheckResult:
    """Frame 0 is a test frame: the displacement from it to the first training frame."""
    clip = bench.clip
    split = {"train": list(range(1, len(clip))), "test": [0]}
    bench = bench.anew(replace(clip, split=split))
    bench.trained()
    times = [m.time for m in clip.moments]
    steps = sorted(_step(bench, a, b) for a, b in pairwise(times[1:]))
    first, typical = _step(bench, times[0], times[1]), steps[len(steps) // 2]
    finite = bool(torch.isfinite(_means(bench, 0.0)).all())
    return CheckResult(
        finite and first <= 2 * typical + 1e-3,
        f"{1000 * first:.1f} mm to the frame before, {1000 * typical:.1f} mm typically",
    )


def beyond_the_last_frame(bench: Bench) -> CheckResult:
    """Times of 1.2 and -0.2: finite values; reports how the model extrapolates."""
    bench.trained()
    words, finite = [], True
    for end, beyond in ((1.0, 1.2), (0.0, -0.2)):
        state = bench.model(bench.at(beyond)).joined().detach()
        finite &= all(bool(torch.isfinite(v).all()) for v in vars(state).values())
        way, step = _step(bench, end, beyond), _step(bench, end, abs(end - 0.1))
        word = (
            "held"
            if way < 0.01 * step + 1e-6
            else f"moves on by {way / max(step, 1e-9):.1f} usual steps"
        )
        words.append(f"at {beyond:g} {word}")
    return CheckResult(finite, f"{', '.join(words)}; finite: {finite}")


def unused_rows(bench: Bench) -> CheckResult:
    """Rows of time planes that no time of the clip reads."""
    model = bench.anew().shaken()
    planes = {}
    for name in model.entities:
        deformation = model.entity(name).deformation
        for path, parameter in deformation.named_parameters():
            if rate_of(path, deformation.rates) == "planes" and "time" in path:
                planes[f"{name}.{path}"] = parameter
    touched = {name: torch.zeros(p.shape[1], dtype=torch.bool) for name, p in planes.items()}
    rows = max(p.shape[1] for p in planes.values())
    for time in torch.linspace(0, 1, 2 * rows + 1).tolist():
        model.zero_grad(set_to_none=True)
        state = model(bench.at(time)).joined()
        sum(v.sin().sum() for v in vars(state).values()).backward()
        for name, parameter in planes.items():
            if parameter.grad is not None:
                touched[name] |= parameter.grad.abs().sum((0, 2, 3)) > 0
    unused = {name: int((~read).sum()) for name, read in touched.items()}
    words = ", ".join(f"{unused[n]} of {len(touched[n])} rows of {n}" for n in planes)
    return CheckResult(not any(unused.values()), f"never read: {words}")


def static_camera(bench: Bench) -> CheckResult:
    """A static camera: learning rates, values and counts after a few steps."""
    bench = bench.anew(tiny_clip("camera.path=static"))
    trainer = bench.trained()
    rates = {name: trainer.optimizer.position_rate(name) for name in bench.model.entities}
    trained = {n: r for n, r in rates.items() if bench.model.entity(n).means.requires_grad}
    finite = all(bool(torch.isfinite(p).all()) for p in bench.model.parameters())
    counts, caps = bench.model.count(), {n: c.cap for n, c in bench.density.items()}
    bounded = all(cap is None or counts[n] <= cap for n, cap in caps.items())
    extent = bench.clip.extent()
    passed = finite and bounded and extent > 0 and all(r > 0 for r in trained.values())
    return CheckResult(
        passed and not trainer.guard.skipped,
        f"extent {extent:.2f} m, position rates "
        f"{', '.join(f'{n} {r:.1g}' for n, r in trained.items()) or 'none'}, counts {counts}; "
        f"finite: {finite}",
    )


def large_first_splats(bench: Bench) -> CheckResult:
    """All initial scales times 100: bounded memory, finite values."""
    bench = bench.anew()
    with torch.no_grad():
        for name in bench.model.entities:
            bench.model.entity(name).log_scales.add_(torch.log(torch.tensor(100.0)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    trainer = bench.trained()
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    finite = all(bool(torch.isfinite(p).all()) for p in bench.model.parameters())
    return CheckResult(
        finite and grown < GROWTH_MB and not trainer.guard.skipped,
        f"peak memory grew by {grown:.0f} MB in {trainer.step} steps; finite: {finite}",
    )


def empty_and_full_masks(bench: Bench) -> CheckResult:
    """A frame whose masks are all empty, and one where all are full."""
    bench = bench.anew()
    trainer = Trainer(bench.model, bench.clip, bench.spec.train, density=bench.density)
    objective: JointObjective = trainer.objective
    frame, words, passed = bench.clip[bench.clip.split["train"][2]], [], True
    for name, fill in (("empty", False), ("full", True)):
        masks = {n: torch.full_like(m, fill) for n, m in frame.masks.items()}
        result = objective(replace(frame, masks=masks), frame.camera, torch.Generator())
        own = [t for t in result.terms if t.partition("/")[0] in ("human", "object")]
        result.total.backward()
        grads = [p.grad for p in bench.model.parameters() if p.grad is not None]
        finite = bool(torch.isfinite(result.total.detach())) and all(
            bool(torch.isfinite(g).all()) for g in grads
        )
        passed &= finite and (bool(own) == fill)
        words.append(f"{name}: {len(own)} masked terms, finite: {finite}")
    return CheckResult(passed, "; ".join(words))


def motion_rate(bench: Bench) -> CheckResult:
    """The schedule of the learning rate of keyframes."""
    bench = bench.anew()
    optimizer = Trainer(bench.model, bench.clip, bench.spec.train, density=bench.density).optimizer
    rates = {
        (schedule.at(0.3), schedule.at(1.0))
        for role, schedule in zip(optimizer.roles, optimizer.schedules, strict=True)
        if role == "keyframes"
    }
    decays = all(late < early for early, late in rates)
    shown = ", ".join(f"{early:.2g} to {late:.2g}" for early, late in sorted(rates))
    return CheckResult(decays and bool(rates), f"from a third of the run to its end: {shown}")


def two_forwards(bench: Bench) -> CheckResult:
    """The same moment evaluated twice, with another one between."""
    model = bench.anew().shaken().eval()
    moment = bench.at(0.3)
    with torch.no_grad():
        first = model(moment).joined()
        model(bench.at(0.8))
        second = model(moment).joined()
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    off = max(float((a - b).abs().max()) for a, b in pairs)
    return CheckResult(off == 0 and moment.time == 0.3, f"off by {off:g}; time {moment.time:g}")

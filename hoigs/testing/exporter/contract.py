"""X06 to X10: determinism, unmodified inputs, progress, and omissions."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.model.exporter import ExportRequest
from hoigs.testing.compare import require
from hoigs.testing.exporter.subject import CHECKS, ExporterSubject, contents, workplace
from hoigs.testing.material.clip import HUMAN, OBJECT


@CHECKS.check("X06")
def output_is_deterministic(subject: ExporterSubject) -> None:
    """The same scene, exported twice under two names, gives the same bytes."""
    with workplace() as place:
        for name in ("one", "two"):
            subject.export(place / name)
        one, two = contents(place / "one"), contents(place / "two")
        other = sorted(n for n in one | two if one.get(n) != two.get(n))
        require(not other, f"exported twice, {other} differ")


def _inputs(request: ExportRequest) -> dict[str, Tensor]:
    clip, scene = request.clip, request.scene
    found = {f"scene.{n}": x for n, x in scene.state_dict().items()}
    found |= {f"clip.{n}": getattr(clip, n) for n in ("points", "point_colors")}
    for moment in request.moments:
        for name, pose in moment.poses.items():
            found |= {f"pose of {name} at {moment.time}: {n}": x for n, x in vars(pose).items()}
    found["torch's random state"] = torch.get_rng_state()
    return {name: x.clone() for name, x in found.items() if isinstance(x, Tensor)}


@CHECKS.check("X07")
def inputs_are_not_modified(subject: ExporterSubject) -> None:
    """Parameters, modes, clip, poses and torch's random state are as before."""
    for training in (True, False):
        request = subject.request()
        request.scene.train(training)
        before = _inputs(request)
        with workplace() as place:
            subject.export(place / "scene", request)
        after = _inputs(request)
        changed = sorted(n for n in before if not torch.equal(before[n], after[n]))
        require(not changed, f"exporting changed {changed}")
        modes = {module.training for module in request.scene.modules()}
        require(modes == {training}, f"exporting changed the scene's mode from {training}")
        gradients = [n for n, p in request.scene.named_parameters() if p.grad is not None]
        require(not gradients, f"exporting left gradients on {gradients}")


@CHECKS.check("X08")
def progress_never_falls(subject: ExporterSubject) -> None:
    """Progress lies in [0, 1], never falls and ends at 1."""
    calls: list[float] = []
    with workplace() as place:
        subject.export(place / "scene", progress=lambda done, _: calls.append(done))
    require(calls and calls[-1] == 1, f"progress ends at {calls[-1:]}, expected 1")
    require(calls == sorted(calls) and calls[0] >= 0, f"progress goes {calls}")


@CHECKS.check("X09")
def omissions_have_reasons(subject: ExporterSubject) -> str:
    """What the format cannot hold is reported by name, each with a reason."""
    with workplace() as place:
        omitted = subject.export(place / "scene").omitted
    bare = [what for what, why in omitted.items() if not (what.strip() and why.strip())]
    require(not bare, f"omitted without a reason: {bare}")
    return "; ".join(f"{what}: {why}" for what, why in omitted.items())


@CHECKS.check("X10")
def only_what_is_requested(subject: ExporterSubject) -> None:
    """When one entity is exported, changing another changes no byte; changing it does."""
    exporter = subject.exporter()
    mine, other = (OBJECT, HUMAN) if "object" in exporter.kinds else (HUMAN, OBJECT)
    with workplace() as place:
        for name, changed in (("plain", None), ("other", other), ("own", mine)):
            request = subject.request(mine)
            if changed is not None:
                with torch.no_grad():
                    request.scene.entity(changed).means.add_(torch.tensor((0.25, 0.0, 0.0)))
            subject.export(place / name, request)
        plain, others, own = (contents(place / name) for name in ("plain", "other", "own"))
        require(plain == others, f"only {mine} was requested, but {other} is in the files too")
        if exporter.reads_gaussians:
            require(plain != own, f"moving {mine} changes no byte: it is not in the files")
        else:
            require(plain == own, f"reads_gaussians is False, but moving {mine} changes the files")

"""What a chart runs: specs and their variants x rasterizers x budgets x clips x seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hoigs.studies.jobs.clip_folders import ClipFolders
from hoigs.studies.jobs.job import Job, make_job
from hoigs.studies.jobs.rows import Row

PREVIEWS = 8  # points of a curve


@dataclass(frozen=True)
class ChartStudy:
    """What to run.

    Attributes:
        clips: folders or "builtin:NAME". variants: of `jobs.variants.parse_variants`.
        rasterizers: names or keys; empty takes each spec's own.
        budgets: steps; empty takes each spec's own. seeds: how many, from 0.
        out, settings, device, lpips_weights, plugins: as for `tables.Study`.
    """

    clips: Sequence[str]
    variants: Sequence[Row]
    out: Path
    rasterizers: Sequence[str] = ()
    budgets: Sequence[int] = ()
    seeds: int = 1
    settings: tuple[str, ...] = ()
    device: str = "cpu"
    lpips_weights: Path | None = None
    plugins: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Planned:
    """One cell of the plan. steps, rasterizer: of its resolved spec."""

    variant: Row
    rasterizer: str
    steps: int
    clip: str
    seed: int
    job: Job


def plan(study: ChartStudy) -> list[Planned]:
    """Every cell, variant by variant. Built-in clips are generated here, once.

    Raises:
        HoigsError: a clip, spec, rasterizer or setting that does not exist; nothing has been run.
    """
    folders = ClipFolders()
    for clip in study.clips:
        folders.get(clip)
    rasterizers: Sequence[str | None] = study.rasterizers or [None]
    budgets: Sequence[int | None] = study.budgets or [None]
    return [
        _planned(study, variant, rasterizer, budget, clip, seed, folders)
        for clip in study.clips
        for variant in study.variants
        for rasterizer in rasterizers
        for budget in budgets
        for seed in range(study.seeds)
    ]


def _planned(
    study: ChartStudy,
    variant: Row,
    rasterizer: str | None,
    budget: int | None,
    clip: str,
    seed: int,
    folders: ClipFolders,
) -> Planned:
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.spec.schema import Spec

    registry = default_registry(list(study.plugins))
    settings = [*study.settings, *variant.settings]  # a variant overrides the study
    if rasterizer is not None:
        key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
        settings.append(f"rasterizer.use={key}")
    if budget is not None:
        settings.append(f"train.steps={budget}")
    assert variant.spec is not None
    own = Spec.load(variant.spec, overrides=settings, registry=registry)
    # a few previews of any budget make its curve; --set train.preview_every takes precedence
    previews = f"train.preview_every={max(1, own.train.steps // PREVIEWS)}"
    settings = [previews, *settings, f"train.seed={seed}"]
    folder, label, digest = folders.get(clip)
    job = make_job(
        study.out, folder, label, digest, variant.spec, settings, device=study.device,
        lpips_weights=str(study.lpips_weights) if study.lpips_weights else None,
        plugins=tuple(map(str, study.plugins)),
    )  # fmt: skip
    name = own.rasterizer.use.removeprefix("rasterizer:")
    return Planned(variant, name, own.train.steps, label, seed, job)

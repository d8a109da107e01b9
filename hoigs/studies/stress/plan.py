"""The trainings of a stress study: for each sweep, spec and seed a chain of harder values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.spec.schema import Spec
from hoigs.studies.jobs.clip_folders import ClipFolders
from hoigs.studies.jobs.job import make_job
from hoigs.studies.jobs.rows import Row
from hoigs.studies.stress.capability import Capability
from hoigs.studies.stress.case import Case, Sweep
from hoigs.studies.stress.job import StressJob
from hoigs.studies.stress.sizes import modelled, small_settings

# settings of every clip, which those of the sweep override
BASE = (
    "width=96&frames=24&fps=6&edge_samples=4&held_out_views=4&test_frames=6&scene_points=5000"
    "&object_points=1000"
)


@dataclass(frozen=True)
class StressStudy:
    """A study to run.

    Attributes:
        cases: chosen. specs: of `jobs.variants.parse_variants`. seeds: how many, from 0.
        steps, points: of every training; Gaussians at its start.
        base: settings of every clip. whole: run every value even after a seed has failed one.
        settings: overrides of every spec. out, device, plugins: as for other studies.
    """

    cases: Sequence[Case]
    specs: Sequence[Row]
    out: Path
    seeds: int = 3
    steps: int = 300
    points: int = 4000
    base: str = BASE
    whole: bool = False
    settings: tuple[str, ...] = ()
    device: str = "cpu"
    plugins: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Chain:
    """The trainings of one case, spec and seed, from the easiest value to the hardest."""

    case: Case
    spec: Row
    seed: int
    jobs: tuple[StressJob, ...]

    @property
    def sweep(self) -> Sweep:
        assert self.case.sweep is not None
        return self.case.sweep


def clip_names(sweep: Sweep, base: str) -> list[str]:
    """The built-in clip of each value of a sweep; one clip if the sweep varies the spec."""
    start, _, own = sweep.clip.partition("?")
    found = []
    for value in sweep.values:
        varied = [setting.replace("{}", f"{value:g}") for setting in sweep.sets]
        found.append(f"builtin:{start}?" + "&".join([base, *filter(None, [own]), *varied]))
    return found


def plan_chains(
    study: StressStudy, capabilities: Mapping[str, frozenset[Capability]]
) -> list[Chain]:
    """Every chain whose case concerns its spec; built-in clips are generated unless cached.

    Args:
        capabilities: of each spec, by label.
    """
    from hoigs.core.registry.registry import default_registry

    folders, registry = ClipFolders(), default_registry(list(study.plugins))
    own = {
        row.label: Spec.load(
            str(row.spec), overrides=[*study.settings, *row.settings], registry=registry
        )
        for row in study.specs
    }
    return [
        _chain(study, case, row, own[row.label], seed, folders)
        for case in study.cases
        if case.sweep is not None
        for row in study.specs
        if set(case.concerns) <= capabilities[row.label]
        for seed in range(study.seeds)
    ]


def _chain(
    study: StressStudy, case: Case, row: Row, spec: Spec, seed: int, folders: ClipFolders
) -> Chain:
    sweep = case.sweep
    assert sweep is not None and row.spec is not None
    given = [*study.settings, *row.settings]
    small = small_settings(spec, study.points, study.steps)
    names = clip_names(sweep, study.base)
    first = folders.get(names[0])[0]
    jobs = []
    for name, value in zip(names, sweep.values, strict=True):
        folder, _, digest = folders.get(name)
        scoring = str(first) if sweep.scored_on == "first" and folder != first else ""
        # by content of the clip: cases that share their first clip share its training
        key = folder.name.removeprefix("builtin-")[:8]
        label = f"{sweep.clip.partition('?')[0]}-{key}" + ("-judged" if scoring else "")
        settings = [*small, *given, *block_settings(spec, sweep, value), f"train.seed={seed}"]
        job = make_job(
            study.out, folder, label, digest, row.spec, settings, kind=StressJob,
            device=study.device, plugins=tuple(map(str, study.plugins)), scoring_clip=scoring,
            allow_faults=sweep.faults,
        )  # fmt: skip
        assert isinstance(job, StressJob)
        jobs.append(job)
    return Chain(case, row, seed, tuple(jobs))


def block_settings(spec: Spec, sweep: Sweep, value: float) -> list[str]:
    """Overrides by a sweep of the spec, in each component of a model block with such a setting."""
    found = []
    for name, _ in modelled(spec):
        for place, template in sweep.blocks.items():
            part, _, key = place.partition(".")
            if key in getattr(spec.model[name], part).settings:
                found.append(f"model.{name}.{place}={template.replace('{}', f'{value:g}')}")
    return found

"""What a stress study runs: for each case with a knob, spec and seed a chain of harder clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.spec import Spec
from hoigs.studies.clip_folders import ClipFolders
from hoigs.studies.job import make_job
from hoigs.studies.stress.capability import Capability
from hoigs.studies.stress.case import Case, Knob
from hoigs.studies.stress.job import StressJob
from hoigs.studies.stress.sizes import modelled, small_settings
from hoigs.studies.table_sets import Row

# of every stressed clip, under what its knob says
BASE = (
    "width=96&frames=24&fps=6&edge_samples=4&held_out_views=4&test_frames=6&scene_points=5000"
    "&object_points=1000"
)


@dataclass(frozen=True)
class StressStudy:
    """What to run.

    Attributes:
        cases: chosen. specs: of `chart_plan.parse_variants`. seeds: how many, from 0.
        steps, points: of every training; Gaussians at its start.
        base: settings of every clip. whole: run every value even where a seed has broken.
        settings: laid over every spec. out, device, plugins: as for other studies.
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
    def knob(self) -> Knob:
        assert self.case.knob is not None
        return self.case.knob


def clip_names(knob: Knob, base: str) -> list[str]:
    """The built-in clip of each value of a knob; the same one where the clip is not what turns."""
    start, _, own = knob.clip.partition("?")
    found = []
    for value in knob.values:
        turned = [setting.replace("{}", f"{value:g}") for setting in knob.sets]
        found.append(f"builtin:{start}?" + "&".join([base, *filter(None, [own]), *turned]))
    return found


def plan_chains(
    study: StressStudy, capabilities: Mapping[str, frozenset[Capability]]
) -> list[Chain]:
    """Every chain whose case concerns its spec; built-in clips are generated unless cached.

    Args:
        capabilities: of each spec, by label.
    """
    from hoigs.core.registry import default_registry

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
        if case.knob is not None
        for row in study.specs
        if set(case.concerns) <= capabilities[row.label]
        for seed in range(study.seeds)
    ]


def _chain(
    study: StressStudy, case: Case, row: Row, spec: Spec, seed: int, folders: ClipFolders
) -> Chain:
    knob = case.knob
    assert knob is not None and row.spec is not None
    laid = [*study.settings, *row.settings]
    small = small_settings(spec, study.points, study.steps)
    names = clip_names(knob, study.base)
    first = folders.get(names[0])[0]
    jobs = []
    for name, value in zip(names, knob.values, strict=True):
        folder, _, digest = folders.get(name)
        judge = str(first) if knob.judged == "first" and folder != first else ""
        # by what the clip is: the easiest value of many cases is one clip, trained on once
        key = folder.name.removeprefix("builtin-")[:8]
        label = f"{knob.clip.partition('?')[0]}-{key}" + ("-judged" if judge else "")
        settings = [*small, *laid, *turned_blocks(spec, knob, value), f"train.seed={seed}"]
        job = make_job(
            study.out, folder, label, digest, row.spec, settings, kind=StressJob,
            device=study.device, plugins=tuple(map(str, study.plugins)), judge=judge,
            allow_faults=knob.faults,
        )  # fmt: skip
        assert isinstance(job, StressJob)
        jobs.append(job)
    return Chain(case, row, seed, tuple(jobs))


def turned_blocks(spec: Spec, knob: Knob, value: float) -> list[str]:
    """What a knob of the spec sets: in each component of a model block that has such a setting."""
    found = []
    for name, _ in modelled(spec):
        for place, template in knob.blocks.items():
            part, _, key = place.partition(".")
            if key in getattr(spec.model[name], part).settings:
                found.append(f"model.{name}.{place}={template.replace('{}', f'{value:g}')}")
    return found

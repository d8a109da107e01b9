"""What a chart runs: specs and their variants x rasterizers x budgets x clips x seeds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.studies.clip_folders import ClipFolders
from hoigs.studies.job import Job, make_job
from hoigs.studies.table_sets import Row

KEY = re.compile(r"\+(?=[A-Za-z_][\w.-]*=)")
PREVIEWS = 8  # points of a curve


@dataclass(frozen=True)
class ChartStudy:
    """What to run.

    Attributes:
        clips: folders or "builtin:NAME". variants: of `parse_variants`.
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


def parse_variants(text: str) -> list[Row]:
    """`--specs`: specs with commas between, each `[LABEL=]SPEC[+KEY=VALUE…]`.

    "hoigs,mine.yaml,hoigs+model.object.deformation.use=deformation:acme-bounce" are three.

    Raises:
        HoigsError: none is named, or two have the same label.
    """
    variants = [_variant(part.strip()) for part in _split(text) if part.strip()]
    if not variants:
        raise HoigsError("--specs names no spec; give some: --specs hoigs,4dgs@matched,mine.yaml")
    labels = [v.label for v in variants]
    for variant in variants:
        if labels.count(variant.label) > 1:
            raise HoigsError(
                f'two specs are called "{variant.label}" in --specs; name them: '
                f"first={definition(variant)}"
            )
    return variants


def definition(row: Row) -> str:
    """A variant as `--specs` has it, without its label."""
    return "+".join([str(row.spec), *row.settings])


def _variant(text: str) -> Row:
    head, *settings = KEY.split(text)
    label, named, spec = head.rpartition("=")
    if not spec.strip() or (named and not label.strip()):
        raise HoigsError(f'--specs: "{text}" is no [LABEL=]SPEC[+KEY=VALUE…]')
    spec = spec.strip()
    return Row(label.strip() or _label(spec, settings), spec, tuple(s.strip() for s in settings))


def _label(spec: str, settings: Sequence[str]) -> str:
    """ "hoigs + acme-bounce" of what swaps a component, "hoigs + cap=500" of another setting."""
    name = Path(spec).stem if spec.partition("@")[0].endswith((".yaml", ".yml", ".toml")) else spec
    words = [name]
    for setting in settings:
        key, _, value = setting.partition("=")
        last = key.rpartition(".")[2]
        words.append(value.strip().rpartition(":")[2] if last == "use" else f"{last}={value}")
    return " + ".join(words)


def _split(text: str) -> list[str]:
    """At commas that no bracket encloses: `a,b+entities=[human,object]` are two."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{(") - (letter in "]})")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


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
    from hoigs.core.registry import default_registry
    from hoigs.core.spec import Spec

    registry = default_registry(list(study.plugins))
    settings = [*study.settings, *variant.settings]  # what one spec says wins
    if rasterizer is not None:
        key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
        settings.append(f"rasterizer.use={key}")
    if budget is not None:
        settings.append(f"train.steps={budget}")
    assert variant.spec is not None
    own = Spec.load(variant.spec, overrides=settings, registry=registry)
    # a few previews of any budget make its curve; --set train.preview_every wins
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

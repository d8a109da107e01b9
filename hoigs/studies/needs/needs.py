"""needs: how much of a spec a clip needs, as a spec and a page with the reasons."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.system.random_state import callers_random_state
from hoigs.runs.choices import pick_device, with_rasterizer
from hoigs.runs.clip_source import clip_name, read_clip
from hoigs.studies.needs.report import require_new, write_needs
from hoigs.studies.needs.result import Needs, Settings
from hoigs.studies.needs.search import Search
from hoigs.studies.needs.search_space import CRITERIA, load_search_spaces
from hoigs.training.train import Report, silent


def needs_folder(clip: Path | str) -> Path:
    """Where `needs` writes by default."""
    return Path("runs") / f"needs-{clip_name(clip)}"


@callers_random_state()
def needs(
    clip: Path | str,
    spec: str | Path = "hoigs",
    *,
    out: Path | str | None = None,
    criterion: str = "one-se",
    least: float = 0.1,
    share: float = 0.05,
    search_spaces: Path | str | None = None,
    overrides: Sequence[str] = (),
    rasterizer: str | None = None,
    device: str = "auto",
    overwrite: bool = False,
    allow_faults: bool = False,
    plugins: Sequence[Path | str] = (),
    report: Report = silent,
) -> Needs:
    """Find how much of a spec a clip needs, on training frames that are held back.

    Writes spec.yaml, needs.md, needs.json, needs.png and needs.svg.

    Args:
        clip: a clip folder, or "builtin:NAME". spec: a name or a file, to be reduced.
        out: folder of the answer; by default runs/needs-CLIP.
        criterion: "one-se", the cheapest candidate within one standard error of the best, or "bic".
        least: gains below this are ignored, dB.
        share: of the training frames that is held back; at least 3 are.
        search_spaces: a YAML file of search spaces in place of hoigs's own.
        overrides, rasterizer, device, allow_faults, plugins: as for `train`.
        overwrite: replace the answer in `out`.
        report: called with a line for each result.

    Raises:
        HoigsError: anything wrong with the input.
    """
    rule = next((c for c in CRITERIA if c == criterion), None)
    if rule is None:
        near = did_you_mean(criterion, CRITERIA)
        raise HoigsError(f"criterion {criterion}: expected {' or '.join(CRITERIA)}{near}")
    if not 0 <= share < 0.5:
        raise HoigsError(f"share {share}: expected a share of the training frames below 0.5")
    if least < 0:
        raise HoigsError(f"least {least}: expected 0 dB or more")
    folder = Path(out) if out is not None else needs_folder(clip)
    device, given = pick_device(device), with_rasterizer(overrides, rasterizer)
    require_new(folder, overwrite, [clip, spec, *([search_spaces] if search_spaces else [])])
    registry = default_registry(plugin_files=plugins)
    width = Spec.load(spec, overrides=given, registry=registry).train.width
    source = read_clip(clip, registry, width, allow_faults=allow_faults)
    report(f"what {source.name} needs of {spec}:")
    search = Search(
        source,
        str(spec),
        load_search_spaces(None if search_spaces is None else Path(search_spaces)),
        given,
        Settings(rule, least, share),
        registry,
        device,
        lambda line: report(f"  {line}"),
    )
    found = search.run()
    for path in write_needs(found, folder, given=given, registry=registry):
        report(f"wrote {path}")
    return found

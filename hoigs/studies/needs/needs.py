"""needs: how much of a spec a clip needs, as a spec and a page with the reasons."""

from __future__ import annotations

from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.core.options import verb
from hoigs.core.registry.registry import default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.system.random_state import callers_random_state
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import clip_name, read_clip
from hoigs.studies.needs.options import NeedsOptions
from hoigs.studies.needs.report import require_new, write_needs
from hoigs.studies.needs.result import QUICK, QUICK_STEPS, TOTAL, Needs, Settings
from hoigs.studies.needs.search import Search
from hoigs.studies.needs.search_space import load_search_spaces
from hoigs.training.train import Report, silent


def needs_folder(clip: Path | str) -> Path:
    """Where `needs` writes by default."""
    return Path("runs") / f"needs-{clip_name(clip)}"


@callers_random_state()
@verb(NeedsOptions, "spec")
def needs(clip: Path | str, *, options: NeedsOptions, report: Report = silent) -> Needs:
    """Find how much of a spec a clip needs, on training frames that are held back.

    Writes spec.yaml, needs.md, needs.json, needs.png and needs.svg.

    Args:
        clip: a clip folder, or "builtin:NAME".
        report: called with a line for each result.

    Raises:
        HoigsError: anything wrong with the input.
    """
    share, search_spaces = options.share, options.search_spaces
    if not 0 <= share < 0.5:
        raise HoigsError(f"share {share}: expected a share of the training frames below 0.5")
    spec, given = options.spec, options.spec_settings()
    folder = Path(options.out) if options.out is not None else needs_folder(clip)
    device = pick_device(options.device)
    inputs = [clip, spec, *([search_spaces] if search_spaces else [])]
    require_new(folder, options.overwrite, inputs)
    registry = default_registry(plugin_files=options.plugins)
    width = Spec.load(spec, overrides=given, registry=registry).train.width
    source = read_clip(clip, registry, width, allow_faults=options.allow_faults)
    report(f"what {source.name} needs of {spec}:")
    search = Search(
        source,
        str(spec),
        load_search_spaces(None if search_spaces is None else Path(search_spaces)),
        given,
        Settings(
            options.least,
            share,
            budget=TOTAL if options.smallest else QUICK,
            search_steps=None if options.smallest else QUICK_STEPS,
            smallest=options.smallest,
        ),
        registry,
        device,
        lambda line: report(f"  {line}"),
    )
    found = search.run()
    for path in write_needs(found, folder, given=given, registry=registry):
        report(f"wrote {path}")
    return found

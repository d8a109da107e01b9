"""Defaults of a run: its folder, and what a resumed run keeps (spec, clip and reader)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError, SpecError
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.loader import load_yaml
from hoigs.core.spec.schema import Spec, with_present_names
from hoigs.runs.clip_source import (
    ReaderChoice,
    choose_reader,
    clip_folder,
    clip_name,
    recorded_folder,
    recorded_reader,
    require_folder,
)
from hoigs.runs.run_folder import RunFolder

DEFAULT_SPEC = "hoigs"
NO_CLIP = "name a clip, a folder or builtin:NAME"


def default_out(clip: Path | str | None, name: str) -> Path:
    """The run folder runs/CLIP-SPEC.

    Raises:
        HoigsError: `clip` is None, or clip and spec do not make the name of a single folder.
    """
    if clip is None:
        raise HoigsError(f"{NO_CLIP}, or the run to resume: `hoigs train --resume --out RUN`")
    folder = f"{clip_name(clip)}-{name}"
    if "\0" in folder or Path(folder).name != folder:
        raise HoigsError(
            f"{folder!r} (clip and spec) cannot be the name of a folder in runs/; "
            "name the run folder: --out RUN"
        )
    return Path("runs") / folder


def own_spec(path: Path) -> Path:
    """The spec of the run at `path`."""
    run = RunFolder(path)
    run.require()
    return run.spec


def load_spec(source: Path | str, overrides: Sequence[str], registry: Registry) -> Spec:
    """`Spec.load`; of a run's spec an error names the plugin files that it was trained with.

    Raises:
        SpecError: as `Spec.load`.
    """
    try:
        return Spec.load(source, overrides=overrides, registry=registry)
    except SpecError as error:
        run = RunFolder(Path(source).parent)
        if Path(source) != run.spec or not run.provenance.is_file():
            raise
        parts = run.read_provenance().get("components", {}).values()
        dists = {str(part.get("dist")) for part in parts if isinstance(part, dict)}
        loaded = {plugin.dist for plugin in registry.manager.plugins}
        files = sorted(dist for dist in dists - loaded if dist.endswith(".py"))
        if not files:
            raise
        given = " ".join(f"--plugin {file}" for file in files)
        raise SpecError(
            f"{error}\nthis run was trained with {given}: give it again, or install the plugin"
        ) from error


def changes_of(stored: Path, spec: Spec) -> list[str]:
    """Settings of `spec` that differ from a run's spec.yaml (`stored`): "train.steps: 10 -> 20"."""
    old = _leaves(with_present_names(load_yaml(stored.read_text(), str(stored))).data)
    new = _leaves(spec.model_dump(mode="json"))
    return [
        f"{key}: {old.get(key, 'absent')} -> {new.get(key, 'absent')}"
        for key in dict.fromkeys([*old, *new])
        if old.get(key) != new.get(key) or (key in old) != (key in new)
    ]


def _leaves(tree: Any, place: str = "") -> dict[str, Any]:
    """The values of nested mappings by dotted name."""
    if not isinstance(tree, dict) or not tree:
        return {place: tree}
    return {
        name: value
        for key, branch in tree.items()
        for name, value in _leaves(branch, f"{place}.{key}" if place else str(key)).items()
    }


def clip_and_reader(
    clip: Path | str | None,
    run: RunFolder,
    earlier: dict[str, Any],
    registry: Registry,
    reader: str | None,
    reader_settings: Sequence[str],
) -> tuple[Path, ReaderChoice]:
    """The clip's folder and its reader: as given, else those of the provenance `earlier`.

    Raises:
        HoigsError: no clip is given or recorded, it is not there, or no reader fits.
    """
    if clip is None and not earlier:
        raise HoigsError(f"{NO_CLIP}: `hoigs train builtin:carry`")
    record = earlier.get("clip", {})
    if clip is None:
        folder = recorded_folder(run.path, earlier, registry)
        same = True
    else:
        folder = clip_folder(clip, registry)
        same = bool(earlier) and (run.path / record["path"]).resolve() == folder.resolve()
    require_folder(folder)
    if same and record.get("reader") and reader is None and not reader_settings:
        return folder, recorded_reader(record["reader"], run.path, folder, registry)
    return folder, choose_reader(folder, registry, reader, reader_settings)

"""What a run keeps when it goes on: its spec, its clip and what read that."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.registry import Registry
from hoigs.core.spec import Spec
from hoigs.core.spec_loader import load_yaml
from hoigs.training.clip_source import clip_folder, clip_name, require_folder
from hoigs.training.reader_choice import ReaderChoice, choose_reader, recorded_reader
from hoigs.training.run_folder import RunFolder

DEFAULT_SPEC = "hoigs"
NO_CLIP = "name a clip, a folder or builtin:NAME"


def default_out(clip: Path | str | None, name: str) -> Path:
    if clip is None:
        raise HoigsError(f"{NO_CLIP}, or the run to go on with: `hoigs train --resume --out RUN`")
    return Path("runs") / f"{clip_name(clip)}-{name}"


def own_spec(path: Path) -> Path:
    """The spec of the run at `path`."""
    run = RunFolder(path)
    run.require()
    return run.spec


def changes_of(stored: Path, spec: Spec) -> list[str]:
    """Settings of `spec` that are not those of a run's spec.yaml."""
    old = _leaves(load_yaml(stored.read_text(), str(stored)).data)
    new = _leaves(spec.model_dump(mode="json"))
    return [
        f"{key}: {old.get(key, 'absent')} -> {new.get(key, 'absent')}"
        for key in dict.fromkeys([*old, *new])
        if old.get(key) != new.get(key) or (key in old) != (key in new)
    ]


def _leaves(tree: Any, place: str = "") -> dict[str, Any]:
    """Values of nested mappings by dotted name."""
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
    begun: dict[str, Any],
    registry: Registry,
    reader: str | None,
    reader_settings: Sequence[str],
) -> tuple[Path, ReaderChoice]:
    """The clip's folder and what reads it: as given, else those in the provenance `begun`."""
    if clip is None and not begun:
        raise HoigsError(f"{NO_CLIP}: `hoigs train builtin:carry`")
    record = begun.get("clip", {})
    own = run.path / record["path"] if begun else None
    folder = own if clip is None else clip_folder(clip, registry)
    assert folder is not None
    if clip is None and not folder.is_dir():
        raise HoigsError(f"{folder}: the clip of this run is not there; name it: hoigs train CLIP")
    require_folder(folder)
    same = own is not None and own.resolve() == folder.resolve()
    if same and record.get("reader") and reader is None and not reader_settings:
        return folder, recorded_reader(record["reader"], run.path, folder, registry)
    return folder, choose_reader(folder, registry, reader, reader_settings)

"""export: a trained run to files that other programs read."""

from __future__ import annotations

import glob
import os
import shutil
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.model.compose import compose_bodies
from hoigs.core.model.exporter import SHEET, Exported, Exporter, ExportRequest
from hoigs.core.model.standing import in_known_world
from hoigs.core.options import verb
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.reporting import Progress, default_progress
from hoigs.core.system.files import named
from hoigs.core.system.folder_lock import FolderLock
from hoigs.core.values.between import frame_numbers, moment_between
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import Moment
from hoigs.runs.choices import parse_settings, validated
from hoigs.viewing.options import ExportOptions

KIND = "exporter"
ZIP = ".zip"


@verb(ExportOptions)
def export(
    run: Path | str, *, options: ExportOptions, progress: Progress | None = None
) -> Exported:
    """Write a run to the files of another program.

    A format of one moment takes `start`. Moments between frames are computed by the model, not
    blended.

    Args:
        run: a run folder, as `hoigs.train` makes it.
        progress: called with the share done, in [0, 1], and the work.

    Raises:
        HoigsError: no such format, run or entity; `out` exists; a setting or a frame is wrong;
            the format cannot hold what was chosen; or the disk is full. Nothing is left behind.
    """
    run = Path(run)
    registry = default_registry(plugin_files=options.plugins)
    exporter, name = make_exporter(options.format, options.overrides, registry)
    target = named(Path(options.out)) if options.out is not None else run / "exports" / name
    refuse_existing(target)
    loaded = options.open(run, pixels=False)
    known = loaded.model.names()
    for entity in options.entities:
        if entity not in known:
            hint = did_you_mean(entity, known)
            raise HoigsError(f'no entity "{entity}"{hint}; this run has {", ".join(known)}')
    bodies = compose_bodies(loaded.spec, loaded.clip, registry)
    clip = in_known_world(loaded.clip, bodies)
    moments, rate = export_moments(clip, options.start, options.end, options.fps, options.slow)
    chosen = moments if exporter.moving else moments[:1]
    device = loaded.model.device
    request = ExportRequest(
        loaded.model,
        clip,
        tuple(m.to(device) for m in chosen),
        options.entities,
        bodies={n: b.to(device) for n, b in bodies.items()},
        fps=rate,
    )
    if not any(request.of_kind(kind) for kind in exporter.kinds):
        held = " and ".join(sorted(exporter.kinds))
        there = ", ".join(f"{n} ({loaded.model.entity(n).kind})" for n in request.entities)
        raise HoigsError(f"--format {name} exports entities of kind {held}; it was given {there}")
    try:
        with FolderLock(target, "hoigs export"):
            refuse_existing(target)  # another process may have written it meanwhile
            _remove_unfinished(target)
            return write_to(exporter, request, target, progress or default_progress())
    except OSError as error:
        raise HoigsError(f"{target} cannot be written: {error.strerror or error}") from error


def make_exporter(format: str, settings: Sequence[str], registry: Registry) -> tuple[Exporter, str]:
    """The exporter of a name, with its settings, and the name.

    Raises:
        PluginError, HoigsError: there is none of this name, its extra is missing, or a setting is
            wrong.
    """
    key = format if format.startswith(f"{KIND}:") else f"{KIND}:{format}"
    offered = {o.key.partition(":")[2] for o in registry.manager.offers if o.key.startswith(KIND)}
    if key.partition("@")[0].partition(":")[2] not in offered:
        hint = did_you_mean(key.partition(":")[2], offered)
        there = f"{hint} there" if hint else "; there"
        raise HoigsError(f'no format "{format}"{there} are {", ".join(sorted(offered))}')
    config = validated(registry.config_class(key), parse_settings(settings, "--set"), key)
    made: Exporter = registry.concrete(key)(config)
    return made, key.partition(":")[2]


def export_moments(
    clip: Clip, start: float | None, end: float | None, fps: float | None, slow: float
) -> tuple[list[Moment], float]:
    """The moments of `frame_numbers`, and how many a second there are; errors as it has them."""
    frames, rate = frame_numbers(clip, start, end, fps, slow)
    return [moment_between(clip, frame) for frame in frames], rate


def refuse_existing(target: Path) -> None:
    """Raise where something is already.

    Raises:
        HoigsError: `target` exists, or the sheet beside it does.
    """
    for path in (target, _sheet_of(target)):
        if path.exists() or path.is_symlink():
            raise HoigsError(f"{path} exists and is not replaced; name another --out")


def _remove_unfinished(target: Path) -> None:
    """Remove what killed exports to `target` left beside it; only the holder of its lock may."""
    for kind in ("part", "folder"):
        for path in target.parent.glob(f".{glob.escape(target.name)}.*.{kind}"):
            shutil.rmtree(path, ignore_errors=True)


def write_to(
    exporter: Exporter, request: ExportRequest, target: Path, progress: Progress
) -> Exported:
    """Export to a folder, or where `target` ends as the format's files do, to that file.

    A zip holds the folder, with its sheet.

    Raises:
        HoigsError: `target` ends as files of other formats do, or it is one file, and the export
            has several; or as `Exporter.export`.
    """
    suffixes = (*exporter.suffixes, ZIP)
    if not target.name.lower().endswith(suffixes):
        if target.suffix and exporter.suffixes:
            ends = ", ".join(suffixes)
            raise HoigsError(f"{target}: files of this format end with {ends}, or name a folder")
        return exporter.export(request, target, progress)
    folder = target.with_name(f".{target.name}.{os.getpid()}.folder")
    try:
        done = exporter.export(request, folder, progress)
        if target.suffix.lower() == ZIP:
            write_zip(folder, folder / ZIP)
            files = [ZIP]
        else:
            files = [name for name in done.files if name != SHEET]
        if len(files) != 1:
            raise HoigsError(
                f"{target}: the export has {len(files)} files; name a folder, "
                f"{target.stem}.zip, or one of the entities with --entities"
            )
        (folder / SHEET).rename(_sheet_of(target))
        (folder / files[0]).rename(target)
    except BaseException:
        if not target.exists():
            _sheet_of(target).unlink(missing_ok=True)
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    sizes = {p.name: p.stat().st_size for p in (target, _sheet_of(target))}
    return replace(done, folder=target.parent, files=sizes)


def write_zip(folder: Path, path: Path) -> None:
    """All files of a folder, without dates: the same files give the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(p for p in folder.rglob("*") if p.is_file() and p != path):
            name = zipfile.ZipInfo(file.relative_to(folder).as_posix())
            archive.writestr(name, file.read_bytes())


def _sheet_of(target: Path) -> Path:
    return target.with_name(f"{target.name}.json")

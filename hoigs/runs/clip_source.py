"""A clip argument: the folder that it means, its short name, and the clip read from it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.model.standing import in_known_world
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.storage.fetch import local_path
from hoigs.core.values.clip import Clip
from hoigs.runs.reader_choice import ReaderChoice, choose_reader
from hoigs.synthesis.builtin import builtin_clip, generator_version
from hoigs.synthesis.config import SceneConfig
from hoigs.synthesis.named import PREFIX, is_named, named_clip

NAME_IT = "name one with --clip (`hoigs train` takes it as its argument)"


def clip_folder(clip: str | Path, registry: Registry | None = None) -> Path:
    """The folder of a clip argument; a built-in clip is generated unless it is cached.

    Args:
        clip: a folder, or "builtin:NAME" (`hoigs.synthesis.named`), or a URL, of which there is a
            local copy then (`hoigs.core.storage`).

    Raises:
        ClipError: there is no built-in clip of that name, or the argument is empty. Whether a
            folder exists is not checked.
    """
    _refuse_empty(clip)
    if is_named(clip):
        return named_clip(str(clip), (registry or default_registry()).get("body:anny")())
    return local_path(clip)


def recorded_folder(run: Path, provenance: Mapping[str, Any], registry: Registry) -> Path:
    """The folder of a run's clip, by its provenance.

    A built-in clip that is not where it was, as beside a copy of the run, is generated or found in
    the cache.

    Raises:
        ClipError: it is not there, or another version of hoigs generated it.
    """
    folder = (run / provenance["clip"]["path"]).resolve()
    if folder.is_dir():
        return folder
    missing = f"{folder}: the clip of this run is not there"
    made = provenance.get("clip_provenance", {})
    try:
        config = SceneConfig.model_validate(made["config"])
    except (KeyError, ValidationError):  # no built-in clip
        raise ClipError(f"{missing}; {NAME_IT}") from None
    other = f"{missing}, and another version of hoigs generated it; {NAME_IT}"
    if made.get("generator") != f"hoigs.synthesis {generator_version()}":
        raise ClipError(other)
    again = builtin_clip(registry.get("body:anny")(), config)
    if again.name != folder.name:
        raise ClipError(other)
    return again


def clip_name(clip: str | Path) -> str:
    """A short name for run folders: "carry" of "builtin:carry", else the folder's name.

    Raises:
        ClipError: the argument is empty.
    """
    _refuse_empty(clip)
    if is_named(clip):
        short, _, query = str(clip).removeprefix(PREFIX).partition("?")
        return "-".join([short, *filter(None, query.replace("=", "-").split("&"))])
    return Path(clip).resolve().name


def _refuse_empty(clip: str | Path) -> None:
    if clip == "":  # as a path it would be the current folder
        raise ClipError("the clip is an empty string; name a folder or builtin:NAME")


def require_folder(folder: Path) -> None:
    """Raise ClipError unless the folder exists."""
    if folder.is_file():
        raise ClipError(
            f"{folder}: is a file, expected a clip folder; if it is a video, "
            f"`hoigs prepare {folder} --out clips/{folder.stem}` makes a clip of it"
        )
    if not folder.is_dir():
        raise ClipError(f"{folder}: no such folder; `hoigs prepare VIDEO --out {folder}` makes one")


def read_clip(
    folder: Path | str,
    registry: Registry | None = None,
    width: int | None = None,
    *,
    allow_faults: bool = False,
    reader: ReaderChoice | None = None,
) -> Clip:
    """Read the clip in `folder`.

    Args:
        folder: a folder in any layout that an installed reader recognises, or "builtin:NAME".
        registry: of readers; by default the installed ones.
        width: shrink wider frames to this image width, aspect kept; None keeps all sizes.
        allow_faults: accept defects that training can tolerate (`ClipReader.allow_faults`).
        reader: from `choose_reader`; by default the one that recognises the folder.

    Raises:
        ClipError: no reader or several recognise the folder, or the clip is incomplete.
    """
    registry = registry or default_registry()
    folder = clip_folder(folder, registry)
    require_folder(folder)
    choice = reader or choose_reader(folder, registry)
    choice.reader.allow_faults = allow_faults
    clip = _in_known_world(choice.reader.read(folder), registry)
    if width is None or width >= clip.cameras[0].width:
        return clip
    return clip.resized(width)


def _in_known_world(clip: Clip, registry: Registry) -> Clip:
    """The clip with up and floor from the people in it, where its data do not say.

    Bodies that need settings, as a path to their file, are left out: `hoigs export` has those of
    the run's spec.
    """
    bodies = {}
    for name, track in clip.bodies.items() if clip.world.is_guess else ():
        with suppress(HoigsError):  # no such body here; who trains is told
            config = registry.config_class(track.model)
            if not any(field.is_required() for field in config.model_fields.values()):
                context = BuildContext(entity=name, clip=clip, body_track=track)
                bodies[name] = registry.concrete(track.model).from_config(config(), context)
    return in_known_world(clip, bodies)

"""A clip argument: the folder that it means, its short name, and the clip read from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.model.standing import in_known_world
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.system.files import did_you_mean_beside
from hoigs.core.system.urls import local_path
from hoigs.core.values.clip import Clip
from hoigs.runs.choices import parse_settings, validated
from hoigs.synthesis.builtin import builtin_clip, generator_version
from hoigs.synthesis.config import SceneConfig
from hoigs.synthesis.named import PREFIX, is_named, named_clip

# Choice of a clip reader: the one that recognises the folder's layout, or the one named.

KIND = "reader"


@dataclass(frozen=True)
class ReaderChoice:
    """A reader with its registry key ("reader:hosnerf") and its settings."""

    key: str
    reader: ClipReader
    config: ComponentConfig

    def record(self, relative: Callable[[Path], str]) -> dict[str, Any]:
        """Key and given settings for a run's provenance.

        Args:
            relative: makes a path relative to the run, so that both can be moved together.
        """
        given = {name: getattr(self.config, name) for name in sorted(self.config.model_fields_set)}
        settings = {
            name: relative(value) if isinstance(value, Path) else value
            for name, value in given.items()
        }
        return {"use": self.key, "settings": settings}


def choose_reader(
    folder: Path,
    registry: Registry,
    name: str | None = None,
    settings: Sequence[str] | Mapping[str, Any] = (),
) -> ReaderChoice:
    """The reader for a folder.

    Args:
        name: "hosnerf" or "reader:hosnerf"; None takes the reader that recognises the folder.
        settings: "key=value" as on the command line, or a mapping.

    Raises:
        ClipError: no reader or several recognise the folder, or a setting is wrong.
        PluginError: no reader has this name.
    """
    key = _detected(folder, registry) if name is None else name
    key = key if ":" in key else f"{KIND}:{key}"
    reader = registry.concrete(key)  # raises for an unknown name
    if not issubclass(reader, ClipReader):
        raise ClipError(f"--reader {name}: {key} is no reader; readers: {_known(registry)}")
    if isinstance(settings, Mapping):
        values = dict(settings)
    else:
        values = parse_settings(settings, "--reader-set", ClipError)
    config = validated(registry.config_class(key), values, key, ClipError)
    return ReaderChoice(key, reader.from_config(config, BuildContext()), config)


def recorded_reader(
    record: Mapping[str, Any], run: Path, folder: Path, registry: Registry
) -> ReaderChoice:
    """The reader that a run was trained with, from `ReaderChoice.record`."""
    key, settings = record["use"], dict(record["settings"])
    config = validated(registry.config_class(key), settings, key, ClipError)
    for name in config.model_fields_set:
        value = getattr(config, name)
        if isinstance(value, Path):
            settings[name] = run / value
    return choose_reader(folder, registry, key, settings)


def _detected(folder: Path, registry: Registry) -> str:
    readers = {key: registry.get(key) for key in registry.keys(KIND)}
    found = [key for key, reader in readers.items() if reader().matches(folder)]
    special = [key for key in found if not readers[key].general]
    if len(found) == 1 or len(special) == 1:
        return (special or found)[0]
    if found:
        names = " and ".join(special or found)
        raise ClipError(
            f"{folder}: {names} recognise this layout; choose one with --reader "
            + " or --reader ".join(k.partition(":")[2] for k in special or found)
        )
    raise ClipError(
        f"{folder}: no reader of {', '.join(readers)} recognises this layout "
        "(docs/reference/readers.md lists what each expects); a clip folder has clip.json "
        "(docs/reference/clip.md), and `hoigs prepare` makes one from a video; with --reader NAME "
        "the error names what is absent"
    )


def _known(registry: Registry) -> str:
    return ", ".join(k.partition(":")[2] for k in registry.keys(KIND))


NAME_IT = "name one with --clip (`hoigs train` takes it as its argument)"


def clip_folder(clip: str | Path, registry: Registry | None = None) -> Path:
    """The folder of a clip argument; a built-in clip is generated unless it is cached.

    Args:
        clip: a folder, or "builtin:NAME" (`hoigs.synthesis.named`), or a URL, of which there is a
            local copy then (`hoigs.core.system.urls`).

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
        raise ClipError(
            f"{folder}: no such folder{did_you_mean_beside(folder, 'clip.json')} "
            f"`hoigs prepare VIDEO --out {folder}` makes one"
        )


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

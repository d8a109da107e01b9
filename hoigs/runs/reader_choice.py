"""Choice of a clip reader: the one that recognises the folder's layout, or the one named."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import ClipError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.registry.registry import Registry
from hoigs.runs.given_settings import parse_settings, validated

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

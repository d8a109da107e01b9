"""my.prompts.json beside my.mp4: the clicks of `hoigs annotate`, as options of `hoigs prepare`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.core.errors import SpecError
from hoigs.core.files.json_file import parse_json
from hoigs.core.files.whole_files import named
from hoigs.preparation.options.prepare_options import PrepareOptions
from hoigs.preparation.options.prompts import named_objects, named_people, split_name

ENDING = ".prompts.json"
VERSION = 1


@dataclass(frozen=True)
class StoredPrompts:
    """What was clicked.

    Attributes:
        object: what would follow `--object`, once for each time. person: likewise of the person.
    """

    object: tuple[str, ...] = ()
    person: tuple[str, ...] = ()


def prompt_file(video: Path) -> Path:
    """Where the clicks in a video, or a folder of frames, are kept."""
    video = named(video)
    return video.with_name((video.name if video.is_dir() else video.stem) + ENDING)


def read_prompts(video: Path) -> StoredPrompts | None:
    """The clicks that are stored beside a video; None if there are none.

    Raises:
        SpecError: the file is damaged, or of a later version.
    """
    path = prompt_file(video)
    try:
        content = parse_json(path)
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise SpecError(f"{path} is not readable as JSON ({error}); {_REMEDY}") from error
    version = content.get("version") if isinstance(content, dict) else None
    if version != VERSION:
        raise SpecError(f"{path}: version {version!r}, expected {VERSION}; {_REMEDY}")
    return StoredPrompts(_texts(content, "object", path), _texts(content, "person", path))


def write_prompts(video: Path, prompts: StoredPrompts) -> Path:
    """Stores clicks beside a video, or removes their file where there are none.

    Raises:
        SpecError: the folder cannot be written.
    """
    path = prompt_file(video)
    content = {
        "made_by": "hoigs annotate; hoigs prepare reads it",
        "version": VERSION,
        "object": list(prompts.object),
        "person": list(prompts.person),
    }
    part = path.with_name(f".{path.name}.part")
    try:
        if prompts == StoredPrompts():
            path.unlink(missing_ok=True)
        else:
            part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            part.replace(path)
    except OSError as error:
        raise SpecError(f"{path} cannot be written: {error.strerror}") from error
    return path


def with_stored(
    options: PrepareOptions, video: Path | None
) -> tuple[PrepareOptions, tuple[str, ...]]:
    """Options with the clicks that are stored beside the video, and sentences that say so.

    Prompts that `options` have come before those of the file.

    Raises:
        SpecError: the file cannot be read.
    """
    stored = None if video is None else read_prompts(video)
    if video is None or stored is None:
        return options, ()
    file = prompt_file(video).name
    prompts, said = options.prompts, []
    explicit = {"object": options.object in prompts or not options.find_object,
                "person": options.human in prompts or not options.find_person}  # fmt: skip
    for kind, texts in (("person", stored.person), ("object", stored.object)):
        if not texts:
            continue
        if explicit[kind]:
            said.append(f"{file} has the {kind}, too, which is not used: your options come first")
            continue
        split = [split_name(text) for text in texts]
        if kind == "person":
            found: dict[str, Any] = named_people(split, options)
            names = [found["human"], *found["further_people"]]
        else:
            found = named_objects(split, options)
            names = [found["object"], *found["further_objects"]]
        options = PrepareOptions.model_validate({**options.model_dump(), **found})
        for name in names:
            frames = ", ".join(
                "first" if at.frame is None else str(at.frame)
                for at in options.prompts[name].places()
            )
            said.append(f"{file}, beside the video: {name} in frame {frames}")
    return options, tuple(said)


_REMEDY = "move it away, or click anew with `hoigs annotate`"


def _texts(content: dict[str, Any], key: str, path: Path) -> tuple[str, ...]:
    found = content.get(key, [])
    if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
        raise SpecError(
            f'{path}: "{key}" is {found!r}; expected a list of texts such as "640,402@0"'
        )
    return tuple(found)

"""`--object`: clicks, boxes and words that say where, or what, an entity is."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.core.errors import SpecError
from hoigs.core.system.files import named, parse_json, require_entity_name
from hoigs.preparation.options import PrepareOptions, Prompt, PromptAt
from hoigs.preparation.video.frames import FrameList

_NUMBER = r"\d+(?:\.\d+)?"
_PLACE = re.compile(rf"\s*([-!]?)\s*({_NUMBER}(?:\s*,\s*{_NUMBER})+)\s*(?:@\s*(\d+))?\s*")
NONE, ALL = "none", "all"
HOW = (
    '"640,402" is a point on it in the first frame used, "640,402@120" in frame 120 of the '
    'video, "-700,380" a point that is not on it, "600,350,700,450" its box x0,y0,x1,y1, '
    '"none" that there is no object; "kettle=640,402" also names it'
)
_NAMED = re.compile(r"\s*([A-Za-z][A-Za-z0-9_.-]*)\s*=(.*)", re.DOTALL)


def split_name(text: str) -> tuple[str, str]:
    """NAME=640,402@0 as its name, "" without one, and the place."""
    named = _NAMED.fullmatch(text)
    return (named[1], named[2]) if named else ("", text)


def parse_prompts(texts: Sequence[str], what: str = "--object") -> Prompt:
    """One prompt from all of an entity's clicks, boxes or words.

    Raises:
        SpecError: a text is neither, two boxes or two descriptions are given, or a frame has
            points beside the entity only.
    """
    by_frame: dict[int | None, PromptAt] = {}
    words = None
    for text in texts:
        found = _PLACE.fullmatch(text)
        if found is None:
            words = _words(text, words, what)
            continue
        sign, numbers = found[1], [float(n) for n in found[2].split(",")]
        frame = None if found[3] is None else int(found[3])
        at = by_frame.get(frame, PromptAt(frame=frame))
        if len(numbers) == 2:
            point = (numbers[0], numbers[1], not sign)
            by_frame[frame] = at.model_copy(update={"points": [*at.points, point]})
        elif len(numbers) == 4 and not sign:
            by_frame[frame] = _boxed(at, numbers, text, what)
        else:
            raise SpecError(f"{what} {text!r} is neither a point nor a box; {HOW}")
    for at in by_frame.values():
        if at.box is None and not any(inside for _, _, inside in at.points) and len(by_frame) == 1:
            raise SpecError(
                f"{what}: only points that are not on it are given; add one that is: {HOW}"
            )
    return _prompt(by_frame.values(), words)


def _prompt(places: Iterable[PromptAt], words: str | None) -> Prompt:
    """One prompt from places in different frames, the earliest first."""
    first, *further = sorted(places, key=lambda at: at.frame or 0) or [PromptAt()]
    return Prompt(
        text=words, points=first.points, box=first.box, frame=first.frame, further=further
    )


def _words(text: str, words: str | None, what: str) -> str:
    if not any(c.isalpha() for c in text) or "@" in text:
        raise SpecError(f"{what} {text!r} is neither a point, a box nor words; {HOW}")
    if words is not None:
        raise SpecError(f"{what} is described twice: {words!r} and {text!r}; give one description")
    return text.strip()


def _boxed(at: PromptAt, numbers: list[float], text: str, what: str) -> PromptAt:
    x0, y0, x1, y1 = numbers
    if at.box is not None:
        raise SpecError(f"{what} {text!r}: {_frame(at)} has a box already; one a frame")
    if x1 <= x0 or y1 <= y0:
        raise SpecError(
            f"{what} {text!r}: a box is x0,y0,x1,y1 with x0 < x1 and y0 < y1, in pixels"
        )
    return at.model_copy(update={"box": (x0, y0, x1, y1)})


def with_prompts(options: PrepareOptions) -> PrepareOptions:
    """Options whose `object` and `person` have become prompts and names of entities.

    The name before a text's "=" is that of its object; texts of one name are places on one object.

    Raises:
        SpecError: a text is wrong, or they name the person.
    """
    texts, update = options.object, {}
    named = [split_name(text) for text in texts]
    if any(place.strip() == NONE for _, place in named):
        if len(texts) > 1 or named[0][0]:
            raise SpecError(
                "--object none says that there is no object: leave the others out, and names"
            )
        update["find_object"] = False
    elif texts:
        update |= named_objects(named, options)
    if options.person:
        update |= _people(options.person, options, update)
    return options.changed(**update, object=(), person=()) if update else options


def _people(
    texts: Sequence[str], options: PrepareOptions, update: dict[str, Any]
) -> dict[str, Any]:
    """Fields of the options that the texts of --person set; `update`: those set before.

    Raises:
        SpecError: a text is wrong.
    """
    named = [split_name(text) for text in texts]
    if any(place.strip() == NONE for _, place in named):
        if len(texts) > 1 or named[0][0]:
            raise SpecError(
                "--person none says that there is nobody: leave the others out, and names"
            )
        if not update.get("find_object", options.find_object):
            raise SpecError("--person none and --object none leave nothing to fit: give one")
        return {"find_person": False}
    if any(place.strip() == ALL for _, place in named):
        if len(texts) > 1 or named[0][0]:
            raise SpecError("--person all takes everybody: leave the others out, and names")
        return {"everybody": True}
    objects = (update.get("object_name", options.object_name), *update.get("further_objects", ()))
    found = named_people(named, options, objects)
    return found | {"prompts": {**update.get("prompts", {}), **found["prompts"]}}


def _by_name(named: Sequence[tuple[str | None, str]], usual: str) -> dict[str, list[str]]:
    """Places by name, in the order of the first of each; `usual`: of those without one."""
    places: dict[str, list[str]] = {}
    for name, place in named:
        places.setdefault(name or usual, []).append(place)
    for name in places:
        try:
            require_entity_name(name)
        except ValueError as error:
            raise SpecError(str(error)) from error
    return places


def named_people(
    named: Sequence[tuple[str | None, str]], options: PrepareOptions, objects: Sequence[str] = ()
) -> dict[str, Any]:
    """Names and prompts, as fields of the options, of people given by (name, place).

    Raises:
        SpecError: a place is wrong, or a person has an object's name.
    """
    places = _by_name(named, options.human_name)
    for name in places:
        if name in objects:
            raise SpecError(f"--person {name}=: {name} is an object's name; give another")
    prompts = {name: parse_prompts(texts, "--person") for name, texts in places.items()}
    first, *further = prompts
    return {
        "human_name": first,
        "further_people": tuple(further),
        "prompts": {**options.prompts, **prompts},
    }


def named_objects(
    named: Sequence[tuple[str | None, str]], options: PrepareOptions
) -> dict[str, Any]:
    """Names and prompts, as fields of the options, of objects given by (name, place).

    Raises:
        SpecError: a place is wrong, or an object has the person's name.
    """
    places = _by_name(named, options.object_name)
    if options.human_name in places:
        raise SpecError(
            f"--object {options.human_name}=: {options.human_name} is the person's name; give the "
            "object another"
        )
    prompts = {name: parse_prompts(texts) for name, texts in places.items()}
    first, *further = prompts
    return {
        "object_name": first,
        "further_objects": tuple(further),
        "prompts": {**options.prompts, **prompts},
    }


def _frame(at: PromptAt) -> str:
    return "the first frame" if at.frame is None else f"frame {at.frame}"


def placed_prompts(prompts: Mapping[str, Prompt], found: FrameList) -> dict[str, Prompt]:
    """Prompts that all have a frame: the first that is used, where none is given.

    Raises:
        SpecError: this frame has two boxes.
    """
    placed = {}
    for name, prompt in prompts.items():
        by_frame: dict[int | None, PromptAt] = {}
        for at in prompt.places():
            frame = found.first if at.frame is None else at.frame
            known = by_frame.get(frame, PromptAt(frame=frame))
            if known.box is not None and at.box is not None:
                raise SpecError(f"the prompt of {name}: frame {frame} has two boxes; one a frame")
            by_frame[frame] = PromptAt(
                frame=frame, points=[*known.points, *at.points], box=known.box or at.box
            )
        placed[name] = _prompt(by_frame.values() or [PromptAt(frame=found.first)], prompt.text)
    return placed


def check_prompts(prompts: Mapping[str, Prompt], found: FrameList) -> None:
    """That clicks and boxes lie in the picture, and in frames that are used.

    Raises:
        SpecError: naming the first that does not.
    """
    width, height = found.native_width, found.native_height
    for name, prompt in prompts.items():
        for at in prompt.places():
            if at.frame is not None and not found.first <= at.frame < found.total:
                raise SpecError(
                    f"the prompt of {name} is in frame {at.frame}; the frames of the video that "
                    f"are used are {found.first} to {found.total - 1} (they are counted from the "
                    "video's first one, whatever --start is)"
                )
            corners = [] if at.box is None else [at.box[:2], at.box[2:]]
            for x, y in [*((x, y) for x, y, _ in at.points), *corners]:
                if not (0 <= x <= width and 0 <= y <= height):
                    raise SpecError(
                        f"the prompt of {name}, {x:g},{y:g} in frame {at.frame}, is outside of the "
                        f"picture, which is {width}x{height} (as displayed, x to the right, y down)"
                    )


# my.prompts.json beside my.mp4: the clicks of `hoigs annotate`, as options of `hoigs prepare`.

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
    explicit = {"object": options.object_name in prompts or not options.find_object,
                "person": options.human_name in prompts or not options.find_person}  # fmt: skip
    for kind, texts in (("person", stored.person), ("object", stored.object)):
        if not texts:
            continue
        if explicit[kind]:
            said.append(f"{file} has the {kind}, too, which is not used: your options come first")
            continue
        split = [split_name(text) for text in texts]
        if kind == "person":
            found: dict[str, Any] = named_people(split, options)
            names = [found["human_name"], *found["further_people"]]
        else:
            found = named_objects(split, options)
            names = [found["object_name"], *found["further_objects"]]
        options = options.changed(**found)
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

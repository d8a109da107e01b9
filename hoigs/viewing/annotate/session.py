"""What the page can do: frames, masks, stored clicks, preparations."""

from __future__ import annotations

import io
import shlex
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from hoigs.core.clip_folder.format import is_clip_folder
from hoigs.core.errors import HoigsError, SpecError
from hoigs.core.interfaces.estimator import FramePrompt, PromptPoint
from hoigs.core.system.files import require_entity_name
from hoigs.preparation.options import PrepareOptions, PromptAt
from hoigs.preparation.prompts import (
    StoredPrompts,
    parse_prompts,
    prompt_file,
    read_prompts,
    split_name,
    with_stored,
    write_prompts,
)
from hoigs.viewing.annotate.jobs import Jobs
from hoigs.viewing.annotate.masks import NAME as PERSON
from hoigs.viewing.annotate.masks import ClickMasks, FoundPeople, TrackedMasks
from hoigs.viewing.annotate.video import ScrubbedVideo

# Clicks as the page has them, and as texts of `--object` and `--person`.

Kind = Literal["object", "person"]
DEFAULT: dict[Kind, str] = {"object": "object", "person": "human"}


class Mark(BaseModel):
    """A click, or a box.

    Attributes:
        x, y: pixels of the video. inside: on the entity, or beside it.
        box: x0, y0, x1, y1, in place of a click.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    frame: int = Field(ge=0)
    x: float = Field(default=0.0, ge=0)
    y: float = Field(default=0.0, ge=0)
    inside: bool = True
    box: tuple[float, float, float, float] | None = None

    def text(self) -> str:
        """As it follows `--object`."""
        if self.box is not None:
            return ",".join(f"{v:g}" for v in self.box) + f"@{self.frame}"
        return f"{'' if self.inside else '-'}{self.x:g},{self.y:g}@{self.frame}"


class Marked(BaseModel):
    """An object or a person with its clicks."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind
    name: str
    marks: tuple[Mark, ...] = ()

    @model_validator(mode="after")
    def _named(self) -> Marked:
        require_entity_name(self.name)
        if not self.name[0].isalpha():
            raise ValueError(f"{self.name!r} is no name: a letter comes first")
        return self

    def prompts(self) -> tuple[FramePrompt, ...]:
        """One a frame, in order."""
        by_frame: dict[int, FramePrompt] = {}
        for mark in self.marks:
            at = by_frame.get(mark.frame, FramePrompt(mark.frame))
            if mark.box is not None:
                by_frame[mark.frame] = FramePrompt(mark.frame, at.points, mark.box)
            else:
                point = PromptPoint(mark.x, mark.y, mark.inside)
                by_frame[mark.frame] = FramePrompt(mark.frame, (*at.points, point), at.box)
        return tuple(by_frame[frame] for frame in sorted(by_frame))


def to_texts(marked: Sequence[Marked]) -> StoredPrompts:
    """The options that say the same."""
    texts: dict[Kind, list[str]] = {"object": [], "person": []}
    for entity in marked:
        name = "" if entity.name == DEFAULT[entity.kind] else f"{entity.name}="
        texts[entity.kind] += [name + mark.text() for mark in entity.marks]
    return StoredPrompts(tuple(texts["object"]), tuple(texts["person"]))


def from_texts(stored: StoredPrompts) -> list[Marked]:
    """The clicks that options say.

    Raises:
        SpecError: a text is no option.
    """
    found: list[Marked] = []
    kinds: tuple[Kind, ...] = ("person", "object")
    for kind in kinds:
        by_name: dict[str, list[str]] = {}
        for text in getattr(stored, kind):
            name, place = split_name(text)
            by_name.setdefault(name or DEFAULT[kind], []).append(place)
        for name, places in by_name.items():
            prompt = parse_prompts(places, f"--{kind}")
            if prompt.text is not None:
                raise SpecError(f"--{kind} {prompt.text!r}: words have no place to show")
            marks = tuple(mark for at in prompt.places() for mark in _marks(at))
            found.append(Marked(kind=kind, name=name, marks=marks))
    return found


def _marks(at: PromptAt) -> list[Mark]:
    frame = at.frame or 0  # a place without one, in a file that was written by hand
    boxes = [] if at.box is None else [Mark(frame=frame, box=at.box)]
    return [*boxes, *(Mark(frame=frame, x=x, y=y, inside=i) for x, y, i in at.points)]


MASK_WIDTH = 640  # pixels of the masks that the page gets, at most
_ENTITIES = TypeAdapter(list[Marked])


class ClickRequest(BaseModel):
    """Which mask the page wants."""

    model_config = ConfigDict(extra="forbid")

    entity: Marked
    frame: int = Field(ge=0)


class StartRequest(BaseModel):
    """A preparation to start: of masks alone, or whole."""

    model_config = ConfigDict(extra="forbid")

    whole: bool
    out: str = Field(min_length=1)
    yes: bool = False
    replace: bool = False


class Session:
    """One video that is annotated.

    Args:
        video: a video file or a folder of frames. out: the clip that is proposed.
        options: further options of the preparation.

    Raises:
        SourceError: this is no video. SpecError: the stored clicks cannot be read.
    """

    def __init__(self, video: Path, out: Path, options: PrepareOptions) -> None:
        self.path, self.out, self.options = video, out, options
        stored = read_prompts(video)
        self.entities = [] if stored is None else from_texts(stored)
        self.video = ScrubbedVideo(video, options.folder_fps)
        self.people = FoundPeople(self.video)
        self.clicks = ClickMasks(self.video, self._person)
        self.jobs = Jobs(video, options.model_dump(mode="json", exclude_defaults=True))
        self._lock = threading.Lock()
        self._tracked: TrackedMasks | None = None
        self._tracked_from: StoredPrompts | None = None
        self.tracks = 0  # how often masks were tracked; the page looks at them anew
        threading.Thread(target=self.clicks.survey, daemon=True).start()

    def close(self) -> None:
        self.jobs.stop()
        self.clicks.close()
        self.video.close()

    def about(self) -> dict[str, Any]:
        """Everything that the page starts with."""
        video = self.video
        return {
            "name": self.path.name, "frames": video.count, "fps": video.fps, "width": video.width,
            "height": video.height, "out": str(self.out), "people": self.people.available,
            "entities": [e.model_dump() for e in self.entities], **self._said(),
        }  # fmt: skip

    def store(self, content: Any) -> dict[str, Any]:
        """Writes the clicks beside the video; the command line that says the same.

        Raises:
            SpecError: the file cannot be written. ValidationError: this is no list of entities.
        """
        with self._lock:
            self.entities = _ENTITIES.validate_python(content)
            write_prompts(self.path, to_texts(self.entities))
            return self._said()

    def _said(self) -> dict[str, Any]:
        texts = to_texts(self.entities)
        words = ["hoigs", "prepare", str(self.path)]
        words += [w for text in texts.object for w in ("--object", text)]
        words += [w for text in texts.person for w in ("--person", text)]
        return {"file": prompt_file(self.path).name, "command": shlex.join(words)}

    def clicked(self, content: Any) -> tuple[bytes, str] | None:
        """The mask of an entity in a frame with clicks, and what is doubtful; None without clicks.

        Raises:
            HoigsError: the person's mask cannot be found.
        """
        wanted = ClickRequest.model_validate(content)
        prompts = [p for p in wanted.entity.prompts() if p.frame < self.video.count]
        if wanted.entity.kind == "person" and self.people.available:
            here = next((p for p in prompts if p.frame == wanted.frame), None)
            return None if here is None else (_png(self.people.find(wanted.frame, here)), "")
        found = self.clicks.mask(prompts, wanted.frame)
        return None if found is None else (_png(found.soft > 0.5), found.note)

    def find_person(self, frame: int) -> bool:
        """Looks for the person in a frame, so that masks of objects there leave them out."""
        if not self.people.available or self._person(frame) is not None:
            return False
        self.people.find(frame)
        self.clicks.forget(frame)
        return True

    def tracked(self, name: str, frame: int) -> bytes | None:
        """The tracked mask of an entity; None where there is none."""
        mask = None if self._tracked is None else self._tracked.mask(name, frame)
        return None if mask is None else _png(mask)

    def start(self, content: Any) -> None:
        """Tracks masks, or prepares the clip.

        Raises:
            HoigsError: another preparation is running, or `out` cannot be the clip's name.
        """
        wanted = StartRequest.model_validate(content)
        out = Path(wanted.out).expanduser()
        if out.exists() and not is_clip_folder(out) and any(out.iterdir() if out.is_dir() else "x"):
            raise HoigsError(f"{out} is there and is no clip: choose another name")
        self.out = out
        said = to_texts(self.entities)
        chosen, _ = with_stored(self.options, self.path)  # for the entities' names
        self.jobs.start(
            out, whole=wanted.whole, yes=wanted.yes, replace=wanted.replace,
            finished=lambda: self._look(said, chosen),
        )  # fmt: skip

    def state(self) -> dict[str, Any]:
        """Of the preparation, for the page."""
        tracked = self._tracked
        return {
            **self.jobs.state(), "tracks": self.tracks,
            "fresh": to_texts(self.entities) == self._tracked_from,
            "tracked": [] if tracked is None else tracked.names(),
            "confidence": {} if tracked is None else tracked.confidence,
        }  # fmt: skip

    def _look(self, said: StoredPrompts, chosen: PrepareOptions) -> None:
        """Takes up the masks of the preparation that has just ended, and began with these."""
        self._tracked = TrackedMasks(self.out, chosen.object_name, chosen.human_name)
        self.tracks += 1
        self._tracked_from = said
        self.clicks.forget()

    def _person(self, frame: int) -> np.ndarray | None:
        tracked = self._tracked
        mask = None if tracked is None else tracked.mask(PERSON, frame)
        return self.people.known(frame) if mask is None else mask


def _png(mask: np.ndarray) -> bytes:
    """A mask as the opacity of a picture, which the page colours."""
    height, width = mask.shape
    alpha = Image.fromarray(mask.astype(np.uint8) * 255)
    if width > MASK_WIDTH:
        alpha = alpha.resize((MASK_WIDTH, max(1, round(height * MASK_WIDTH / width))))
    picture = Image.merge("LA", (Image.new("L", alpha.size, 255), alpha))
    file = io.BytesIO()
    picture.save(file, "PNG", compress_level=1)
    return file.getvalue()

"""What the page can do: frames, masks, stored clicks, preparations."""

from __future__ import annotations

import io
import shlex
import threading
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from hoigs.annotation.clicks import ClickMasks
from hoigs.annotation.jobs import Jobs
from hoigs.annotation.marks import Marked, from_texts, to_texts
from hoigs.annotation.people import NAME as PERSON
from hoigs.annotation.people import FoundPeople
from hoigs.annotation.tracked import TrackedMasks
from hoigs.annotation.video import ScrubbedVideo
from hoigs.core.clip_folder.format import is_clip_folder
from hoigs.core.errors import HoigsError
from hoigs.preparation.options.prepare_options import PrepareOptions
from hoigs.preparation.options.prompt_file import (
    StoredPrompts,
    prompt_file,
    read_prompts,
    with_stored,
    write_prompts,
)

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
        self._tracked = TrackedMasks(self.out, chosen.object, chosen.human)
        self.tracks += 1
        self._tracked_from = said
        self.clicks.forget()

    def _person(self, frame: int) -> np.ndarray | None:
        tracked = self._tracked
        mask = None if tracked is None else tracked.mask(PERSON, frame)
        return self.people.known(frame) if mask is None else mask


def _png(mask: np.ndarray) -> bytes:
    """A mask as the opacity of a picture, which the page colours."""
    from PIL import Image

    height, width = mask.shape
    alpha = Image.fromarray(mask.astype(np.uint8) * 255)
    if width > MASK_WIDTH:
        alpha = alpha.resize((MASK_WIDTH, max(1, round(height * MASK_WIDTH / width))))
    picture = Image.merge("LA", (Image.new("L", alpha.size, 255), alpha))
    file = io.BytesIO()
    picture.save(file, "PNG", compress_level=1)
    return file.getvalue()

"""Clicks as the page has them, and as texts of `--object` and `--person`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from hoigs.core.errors import SpecError
from hoigs.core.interfaces.estimator import FramePrompt, PromptPoint
from hoigs.core.names import require_entity_name
from hoigs.preparation.options.prepare_options import PromptAt
from hoigs.preparation.options.prompt_file import StoredPrompts
from hoigs.preparation.options.prompts import parse_prompts, split_name

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

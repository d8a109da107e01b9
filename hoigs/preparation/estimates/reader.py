"""What estimators find in the chosen frames, before their cameras are known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    EstimateKind,
    Estimates,
    Estimator,
    FramePrompt,
    PromptPoint,
    VideoRequest,
    checked,
)
from hoigs.core.interfaces.estimator import Frames as FrameArrays
from hoigs.preparation.body.landmarks import Landmarks
from hoigs.preparation.estimates.given import (
    FoundObject,
    FrameEstimates,
    GivenMasks,
    chosen_landmarks,
)
from hoigs.preparation.masks.mask_stack import MaskStack
from hoigs.preparation.options import Place, PrepareOptions, Prompt, PromptAt
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.pictures import resized_mask
from hoigs.preparation.video.source import Source, SourceError
from hoigs.preparation.work_folder import digest

Estimators = Mapping[Place, Estimator]


@dataclass(frozen=True)
class EstimateReader:
    """Runs the estimator of each kind: a given one, or that of the files beside the video.

    Attributes:
        people, prompts: who is followed, and where or what each entity is.
        work: folder for what estimators keep between runs.
    """

    source: Source
    video: Frames
    people: tuple[str, ...]
    prompts: Mapping[str, Prompt]
    options: PrepareOptions
    estimators: Estimators
    work: Path

    def landmarks_and_masks(self, progress: Callable[[float], None]) -> FrameEstimates:
        """Landmarks first: they are read fast, and a clip without them cannot be made."""
        if not self.people:
            return FrameEstimates({}, self._objects_alone(progress))
        first, *further = self.people
        landmarks = {name: self._landmarks(name, progress) for name in self.people}
        masks = self._masks((first, self.options.object), progress)
        if not further:
            return FrameEstimates(landmarks, masks)
        found = self.estimate("masks", progress).masks
        assert found is not None  # `checked` saw to it
        stacks = {name: self._stack(self._given(found, name)) for name in further}
        together = zip(*stacks.values(), strict=True)
        masks = replace(masks, others=MaskStack(np.logical_or.reduce(rows) for rows in together))
        return FrameEstimates(landmarks, masks, stacks)

    def _given(self, found: EntityMasks, name: str) -> FrameArrays:
        """Masks of a person.

        Raises:
            SourceError: there are none.
        """
        if name not in found.entities:
            raise SourceError(
                f"estimators.masks: {_name(self.estimators['masks'])} gave masks of "
                f"{_listed(found.entities)}, not of {name}: several people need masks of each"
            )
        return found.entities[name]

    def _objects_alone(self, progress: Callable[[float], None]) -> GivenMasks:
        """Masks of a video in which nobody is looked for: the person's are empty."""
        nobody = np.zeros((self.video.height, self.video.width), bool)
        human, thing = MaskStack(nobody for _ in self.video.indices), None
        if "masks" in self.estimators and self.of_both:
            found = self.estimate("masks", progress).masks
            if found is not None and self.options.object in found.entities:
                thing = self._stack(found.entities[self.options.object])
        return GivenMasks(human=human, object=thing)

    def object_masks(self, progress: Callable[[float], None]) -> FoundObject:
        """Masks of each object alone, from an estimator that has seen the person's.

        Raises:
            SourceError: it gave no masks of one of them.
        """
        found = self.estimate("object", progress).masks
        assert found is not None  # `checked` saw to it
        first, *further = (
            self._found(found, name)
            for name in (self.options.object, *self.options.further_objects)
        )
        names = self.options.further_objects
        return replace(
            first, notes=list(found.notes), further=dict(zip(names, further, strict=True))
        )

    def _found(self, found: EntityMasks, name: str) -> FoundObject:
        who = _name(self.estimators["object"])
        if name not in found.entities:
            raise SourceError(
                f"estimators.object: {who} gave masks of {_listed(found.entities)}, not of {name}"
            )
        confidence = found.confidence.get(name)
        chosen = found.chosen.get(name, ())
        return FoundObject(
            self._stack(found.entities[name]),
            found.provenance or who,
            None if confidence is None else np.asarray(confidence)[self.video.indices],
            [(at.frame, *at.box) for at in chosen if at.box is not None],
        )

    def estimate(self, role: Place, progress: Callable[[float], None]) -> Estimates:
        """The result of the estimator of a kind, or of that of the object's masks.

        Raises:
            SourceError: it does not give what it should.
        """
        estimator = self.estimators[role]
        kind: EstimateKind = "masks" if role == "object" else role
        if kind not in estimator.provides:
            raise SourceError(
                f"estimators.{role}: {type(estimator).__name__} provides "
                f"{_listed(estimator.provides)}, not {kind}"
            )
        request = self.request(role)
        try:
            return checked(
                estimator.estimate(request, lambda x, _: progress(x)), request, estimator
            )
        except HoigsError:
            raise
        except ValueError as error:
            raise SourceError(f"estimators.{role}: {error}") from error

    def seen(self) -> tuple[FramePrompt, ...]:
        """A box about everybody, from a quick look; see `Estimator.people`. Empty where files
        beside the video say who is meant."""
        if {"landmarks", "masks"} & set(self.source.beside):
            return ()
        estimator = self.estimators["landmarks"]
        return estimator.people(self.request("landmarks"))

    def request(self, kind: Place) -> VideoRequest:
        """The video as estimators see it: whole, at its own size."""
        video, options = self.video, self.options
        path = self.source.video
        return VideoRequest(
            frames=self._total,
            width=video.native_width,
            height=video.native_height,
            read=video.read,
            folder=self.source.folder,
            work=self.work / digest([identity(self.estimators[kind]), str(path)])[:16],
            static_camera=options.camera == "static",
            entities=self._entities(kind),
            wanted=tuple(video.indices),
            video=path if path.is_file() else None,
            fps=video.list.rate,
            known=self._known() if kind == "object" else None,
        )

    def _known(self) -> Estimates | None:
        """What was found of people; estimators keep their results, so this is fast."""
        if not self.people:
            return None
        masks = self.estimate("masks", lambda _done: None).masks
        return Estimates(masks, self.estimate("landmarks", lambda _done: None).landmarks)

    def notes_on_person(self) -> tuple[str, ...]:
        """What the estimator of masks finds doubtful in those of the person."""
        if "masks" not in self.estimators or not self.people:
            return ()
        masks = self.estimate("masks", lambda _done: None).masks
        return () if masks is None else masks.notes

    @cached_property
    def _total(self) -> int:
        """Frames of the whole video, which are counted only where the survey stopped early."""
        options = self.options
        whole = options.max_frames is None and options.end is None
        return self.video.total if whole else self.video.count()

    def _entities(self, kind: Place) -> tuple[EntityRequest, ...]:
        options = self.options
        people = tuple(self._asked(name, "human") for name in self.people)
        thing = self._asked(options.object, "object")
        if kind == "object":
            return (thing, *(self._asked(n, "object") for n in options.further_objects))
        if kind == "masks" and kind in self.source.beside:
            return tuple(e for e in (*people, thing) if e.name in self.source.masked)
        return (*people, thing) if self.of_both else people

    def _asked(self, name: str, kind: Literal["human", "object"]) -> EntityRequest:
        prompt = self.prompts.get(name)
        if prompt is None:
            return EntityRequest(name, kind)
        further = tuple(FramePrompt(at.frame or 0, _points(at), at.box) for at in prompt.further)
        return EntityRequest(
            name, kind, prompt.text, _points(prompt), prompt.box, prompt.frame or 0, further
        )

    @property
    def of_both(self) -> bool:
        """The estimator of masks gives those of the object, too."""
        return self.options.find_object and "object" not in self.estimators

    def _landmarks(self, name: str, progress: Callable[[float], None]) -> Landmarks:
        tracks = self.estimate("landmarks", progress).landmarks
        who = f"estimators.landmarks: {_name(self.estimators['landmarks'])}"
        if name not in tracks:
            raise SourceError(f"{who} gave landmarks of {_listed(tracks)}, not of {name}")
        if len(self.people) > 1:
            who += f", {name}"
        return chosen_landmarks(tracks[name], self.video, who, tracks[name].provenance or "given")

    def _masks(self, names: tuple[str, str], progress: Callable[[float], None]) -> GivenMasks:
        found = self.estimate("masks", progress).masks
        assert found is not None  # `checked` saw to it
        human, object_mask = (
            self._stack(found.entities[n]) if n in found.entities else None for n in names
        )
        together = None if found.together is None else self._stack(found.together)
        if not (together or human):
            raise SourceError(
                f"estimators.masks: {_name(self.estimators['masks'])} gave masks of "
                f"{_listed(found.entities)}; needed is that of {names[0]}, or one of {names[0]} "
                f"and {names[1]} together"
            )
        if human and (object_mask or together is None):
            return GivenMasks(human=human, object=object_mask)
        return GivenMasks(together=together)

    def _stack(self, masks) -> MaskStack:
        size = (self.video.width, self.video.height)
        return MaskStack(resized_mask(masks[number], size) for number in self.video.indices)


def identity(estimator: Estimator) -> list[str]:
    """An estimator and its settings, as a key of its results."""
    settings = sorted((name, repr(value)) for name, value in vars(estimator).items())
    return [f"{type(estimator).__module__}:{type(estimator).__qualname__}", repr(settings)]


def paths_of(estimator: Estimator, folder: Path) -> list[Path]:
    """Files and folders that an estimator's settings name, which its estimates may come from."""
    settings = getattr(estimator, "config", None)  # absent where `__init__` is an estimator's own
    values = [*vars(estimator).values(), *(dict(settings).values() if settings else ())]
    values += [item for value in values if isinstance(value, dict) for item in value.values()]
    paths = (folder / v.expanduser() for v in values if isinstance(v, Path))
    return sorted(path for path in paths if path.exists())


def _points(prompt: PromptAt) -> tuple[PromptPoint, ...]:
    return tuple(PromptPoint(x, y, bool(inside)) for x, y, inside in prompt.points)


def _name(estimator: Estimator) -> str:
    return type(estimator).__name__


def _listed(names) -> str:
    return ", ".join(sorted(names)) or "nothing"

"""What estimators find in the chosen frames, before their cameras are known."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces import estimator
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
from hoigs.core.values.lens import Undistortion
from hoigs.preparation.body.landmarks import FrameFates, Landmarks
from hoigs.preparation.mask_stack import MaskStack
from hoigs.preparation.objects.ball import BallTrack
from hoigs.preparation.options import Place, PrepareOptions, Prompt, PromptAt
from hoigs.preparation.video.frames import Frames
from hoigs.preparation.video.pictures import resized_mask
from hoigs.preparation.video.source import NobodyFoundError, Source, SourceError
from hoigs.preparation.work_folder import digest

RARE = 0.05  # of the frames: what is taken for a person in fewer of them is none
SHY = 0.2  # the same, of what no frame shows at the first look


def chosen_landmarks(
    track: estimator.Landmarks, video: Frames, what: str, source: str, placed: bool
) -> Landmarks:
    """Landmarks of a whole video, in its own pixels, as those of the chosen frames, at their size.

    Args:
        track: image [F, 33, 4] in pixels of the video, world [F, 33, 4] in metres.
        what, source: the estimator, for an error, and where it has the landmarks from.
        placed: a click, or the search for people, says where this one is, who may be hard to see.

    Raises:
        NobodyFoundError: no person is found in them; `what` names where they come from.
    """
    image = track.image_xyzv[video.indices].astype(np.float64)[..., [0, 1, 3]]
    image[..., :2] *= video.width / video.native_width
    if track.world_xyzv is None:
        world = np.full_like(image, np.nan)
    else:
        world = track.world_xyzv[video.indices].astype(np.float64)[..., :3]
    fates = FrameFates.at(track.lost, track.repaired, video.indices)
    found = Landmarks(
        torch.from_numpy(image), torch.from_numpy(world), source, fates, track.to_hips,
        track.world_spread,
    )  # fmt: skip
    count, frames = int(found.found.sum()), len(image)
    at_once = found.found.clone()
    at_once[fates.repaired_frames()] = False  # animals are found at further looks alone
    if count < (RARE if placed or at_once.any() else SHY) * frames:
        why = "; ".join(f"{text} in {len(rows)}" for text, rows in fates.lost.items())
        raise NobodyFoundError(
            f"{what}: no person was found in "
            + (f"{frames - count} of " if count else "")
            + f"the {frames} chosen frames{f' ({why})' if why else ''}; the body of a person "
            "whose shoulders, hips and some of the limbs are in the picture can be fitted. If "
            "there is one, click on them (--person X,Y@FRAME) or choose the part that shows them "
            "(--start, --end); if there is none, --person none prepares the object alone"
        )
    return found


@dataclass(frozen=True)
class GivenMasks:
    """Masks as the source has them: together, or the person's and perhaps the object's apart; those
    of further people, all in one; and those of people `beside` them, who are not fitted."""

    together: MaskStack | None = None
    human: MaskStack | None = None
    object: MaskStack | None = None
    others: MaskStack | None = None
    beside: MaskStack | None = None

    def named(self) -> dict[str, MaskStack]:
        """Those that there are, by the name of the field."""
        return {f.name: m for f in fields(self) if (m := getattr(self, f.name)) is not None}

    def moving(self, frame: int) -> Bool[np.ndarray, "H W"]:
        """Everything masked in a frame: what does not stand still with the scene."""
        return np.logical_or.reduce([stack[frame] for stack in self.named().values()])

    def persons(self, ball: BallTrack | None) -> MaskStack | None:
        """The person's, or the nearest to it that is known before the body is fitted: with what
        they hold, but without a tracked ball. None where only the object is masked."""
        if self.human is not None or self.together is None:
            return self.human
        stack = MaskStack()
        for frame, mask in enumerate(self.together):
            if self.object is not None:
                mask = mask & ~self.object[frame]
            if ball is not None:
                mask = mask & ~ball.disc(frame, mask.shape[1], mask.shape[0])
            stack.append(mask)
        return stack

    def undistorted(self, undistort: Undistortion, positions: Sequence[int]) -> GivenMasks:
        """On the cameras' undistorted images; `positions` are those of frames with a camera."""
        return GivenMasks(
            **{
                name: MaskStack(undistort.mask(stack[i]) for i in positions)
                for name, stack in self.named().items()
            }
        )


@dataclass(frozen=True)
class FrameEstimates:
    """Landmarks and masks of the frames: as found, or on the cameras' undistorted images.

    Attributes:
        landmarks: by person, the first one's first; none: nobody is looked for, and the person's
            masks are empty.
        further: masks of people but the first, by name.
    """

    landmarks: dict[str, Landmarks]
    masks: GivenMasks
    further: dict[str, MaskStack] = field(default_factory=dict)

    @property
    def person(self) -> Landmarks | None:
        """The first person's."""
        return next(iter(self.landmarks.values()), None)

    def undistorted(self, undistort: Undistortion, positions: Sequence[int]) -> FrameEstimates:
        """On the cameras' undistorted images; `positions` are those of frames with a camera."""
        return FrameEstimates(
            {name: one.undistorted(undistort, positions) for name, one in self.landmarks.items()},
            self.masks.undistorted(undistort, positions),
            {
                name: MaskStack(undistort.mask(stack[i]) for i in positions)
                for name, stack in self.further.items()
            },
        )


@dataclass(frozen=True)
class FoundObject:
    """The object's masks from an estimator of its own, of the chosen frames, distortion still in.

    Attributes:
        confidence: of each chosen frame, 0..1; None: not computed.
        boxes: frame of the video and box x0, y0, x1, y1 in its pixels where the object was proposed
            because no prompt said where it is.
        notes: for the report.
        states: of each chosen frame (`EntityMasks.states`); empty: not computed.
        further: other objects by name (`PrepareOptions.further_objects`).
    """

    masks: MaskStack
    provenance: str
    confidence: Float[np.ndarray, " F"] | None = None
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    states: list[str] = field(default_factory=list)
    further: dict[str, FoundObject] = field(default_factory=dict)


Estimators = Mapping[Place, Estimator]


@dataclass(frozen=True)
class EstimateReader:
    """Runs the estimator of each kind: a given one, or that of the files beside the video.

    Attributes:
        people, beside: who is followed, and who besides and is not fitted.
        prompts: where or what each entity is.
        work: folder for what estimators keep between runs.
    """

    source: Source
    video: Frames
    people: tuple[str, ...]
    beside: tuple[str, ...]
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
        masks = self._masks((first, self.options.object_name), progress)
        if not further and not self.beside:
            return FrameEstimates(landmarks, masks)
        found = self.estimate("masks", progress).masks
        assert found is not None  # `checked` saw to it
        stacks = {name: self._stack(self._given(found, name)) for name in further}
        beside = [self._stack(self._given(found, name)) for name in self.beside]
        masks = replace(masks, others=_all_of(list(stacks.values())), beside=_all_of(beside))
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
            if found is not None and self.options.object_name in found.entities:
                thing = self._stack(found.entities[self.options.object_name])
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
            for name in (self.options.object_name, *self.options.further_objects)
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
            states=[found.states[name][i] for i in self.video.indices]
            if name in found.states
            else [],
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
        people = tuple(self._asked(name, "human") for name in (*self.people, *self.beside))
        thing = self._asked(options.object_name, "object")
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
        source, placed = tracks[name].provenance or "given", name in self.prompts
        return chosen_landmarks(tracks[name], self.video, who, source, placed)

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


def _all_of(stacks: Sequence[MaskStack]) -> MaskStack | None:
    """Pixels of any of several; None where there is none."""
    if not stacks:
        return None
    return MaskStack(np.logical_or.reduce(rows) for rows in zip(*stacks, strict=True))


def identity(estimator: Estimator) -> list[str]:
    """An estimator and its settings, as a key of its results."""
    return [f"{type(estimator).__module__}:{type(estimator).__qualname__}", repr(estimator)]


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

"""What is known of the chosen frames before their cameras are, from priors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from PIL import Image

from hoigs.core.errors import HoigsError
from hoigs.core.video_prior import (
    EntityRequest,
    Evidence,
    EvidenceKind,
    Landmarks,
    PromptPoint,
    VideoPrior,
    VideoRequest,
    checked,
)
from hoigs.preparation.frames import Frames
from hoigs.preparation.masks import MaskStack
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.person import RawLandmarks, chosen_landmarks
from hoigs.preparation.source import Source, SourceError
from hoigs.preparation.split_masks import GivenMasks
from hoigs.preparation.store import digest

Priors = Mapping[EvidenceKind, VideoPrior]


@dataclass(frozen=True)
class RawEvidence:
    """Landmarks and masks of the chosen frames, at their size; distortion still in."""

    landmarks: RawLandmarks
    masks: GivenMasks


@dataclass(frozen=True)
class Gathering:
    """Where evidence comes from: each kind from its prior, given or of the files found beside.

    Attributes:
        work: folder for what priors keep between runs.
    """

    source: Source
    video: Frames
    options: PrepareOptions
    priors: Priors
    work: Path

    def gather(self, progress: Callable[[float], None]) -> RawEvidence:
        """Landmarks first: they are read fast, and a clip without them cannot be made."""
        landmarks = self._landmarks(progress)
        return RawEvidence(
            landmarks, self._masks((self.options.human, self.options.object), progress)
        )

    def estimate(self, kind: EvidenceKind, progress: Callable[[float], None]) -> Evidence:
        """What the prior of a kind says.

        Raises:
            SourceError: it does not give what it should.
        """
        prior = self.priors[kind]
        if kind not in prior.provides:
            raise SourceError(
                f"priors.{kind}: {type(prior).__name__} provides {_listed(prior.provides)}, not "
                f"{kind}"
            )
        request = self.request(kind)
        try:
            return checked(prior.estimate(request, lambda x, _: progress(x)), request, prior)
        except HoigsError:
            raise
        except ValueError as error:
            raise SourceError(f"priors.{kind}: {error}") from error

    def request(self, kind: EvidenceKind) -> VideoRequest:
        """The video as priors see it: whole, at its own size."""
        video, options = self.video, self.options
        path = self.source.video
        return VideoRequest(
            frames=self._total,
            width=video.native_width,
            height=video.native_height,
            read=video.read,
            folder=self.source.folder,
            work=self.work / digest([described(self.priors[kind]), str(path)])[:16],
            static_camera=options.camera == "static",
            entities=self._entities(kind),
            wanted=tuple(video.indices),
            video=path if path.is_file() else None,
            fps=video.list.rate,
        )

    @cached_property
    def _total(self) -> int:
        """Frames of the whole video, which are counted only where the survey stopped early."""
        return self.video.total if self.options.max_frames is None else self.video.count()

    def _entities(self, kind: EvidenceKind) -> tuple[EntityRequest, ...]:
        options = self.options
        asked = (
            _asked(options, options.human, "human"),
            _asked(options, options.object, "object"),
        )
        if kind == "masks" and kind in self.source.beside:
            return tuple(entity for entity in asked if entity.name in self.source.masked)
        return asked

    def _landmarks(self, progress: Callable[[float], None]) -> RawLandmarks:
        tracks = self.estimate("landmarks", progress).landmarks
        name, who = self.options.human, f"priors.landmarks: {_name(self.priors['landmarks'])}"
        if name not in tracks:
            raise SourceError(f"{who} gave landmarks of {_listed(tracks)}, not of {name}")
        track: Landmarks = tracks[name]
        return chosen_landmarks(
            track.image_xyzv, track.world_xyzv, self.video, who, track.provenance or "given"
        )

    def _masks(self, names: tuple[str, str], progress: Callable[[float], None]) -> GivenMasks:
        found = self.estimate("masks", progress).masks
        assert found is not None  # `checked` saw to it
        human, thing = (
            self._stack(found.entities[n]) if n in found.entities else None for n in names
        )
        together = None if found.together is None else self._stack(found.together)
        ball = self.source.ball is not None
        if not (together or (human and (thing or ball))):
            raise SourceError(
                f"priors.masks: {_name(self.priors['masks'])} gave masks of "
                f"{_listed(found.entities)}; needed are those of {names[0]} and {names[1]}, or one "
                "of both together"
            )
        if human and thing:
            return GivenMasks(human=human, thing=thing)
        return GivenMasks(together=together) if together else GivenMasks(human=human)

    def _stack(self, masks) -> MaskStack:
        size = (self.video.width, self.video.height)
        return MaskStack(resized_mask(masks[number], size) for number in self.video.indices)


def resized_mask(mask: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """The mask at another (width, height): pixels of which it covers half."""
    if mask.shape[::-1] == size:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * 255)
    return np.asarray(grey.resize(size, Image.Resampling.BOX)) > 127


def described(prior: VideoPrior) -> list[str]:
    """A prior and its settings, to tell one from another."""
    settings = sorted((name, repr(value)) for name, value in vars(prior).items())
    return [f"{type(prior).__module__}:{type(prior).__qualname__}", repr(settings)]


def paths_of(prior: VideoPrior, folder: Path) -> list[Path]:
    """Files and folders that a prior's settings name, which its evidence may come from."""
    values = list(vars(prior).values())
    values += [item for value in values if isinstance(value, dict) for item in value.values()]
    paths = (folder / v.expanduser() for v in values if isinstance(v, Path))
    return sorted(path for path in paths if path.exists())


def _asked(options: PrepareOptions, name: str, kind) -> EntityRequest:
    prompt = options.prompts.get(name)
    if prompt is None:
        return EntityRequest(name, kind)
    points = tuple(PromptPoint(x, y, bool(inside)) for x, y, inside in prompt.points)
    return EntityRequest(name, kind, prompt.text, points, prompt.box, prompt.frame)


def _name(prior: VideoPrior) -> str:
    return type(prior).__name__


def _listed(names) -> str:
    return ", ".join(sorted(names)) or "nothing"

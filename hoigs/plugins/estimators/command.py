"""estimator:command: any tool with a command line; what it writes is read as files.

It runs estimators that have no plugin of their own: SAMURAI, Track Anything, Metric3D, Video Depth
Anything, DepthCrafter, each in its own environment (docs/reference/estimators.md).
"""

from __future__ import annotations

import shlex
import shutil
import string
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import Field, field_validator, model_validator

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.interfaces.estimator import (
    ESTIMATES,
    EstimateKind,
    Estimates,
    Estimator,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.plugins.estimators.depth_files import DepthFilesConfig, DepthFilesEstimator
from hoigs.plugins.estimators.frame_files import absent
from hoigs.plugins.estimators.landmarks_files import LandmarksFilesConfig, LandmarksFilesEstimator
from hoigs.plugins.estimators.masks_files import MasksFilesConfig, MasksFilesEstimator
from hoigs.plugins.estimators.tools import run_tool, settings_key

PLACES = ("frames", "out", "video", "folder", "width", "height", "count", "fps")


class CommandConfig(ComponentConfig):
    """Settings of `estimator:command`.

    These settings run a program, which `hoigs prepare` does only with --allow-commands. Read
    settings from others before you allow it.
    """

    command: str = Field(
        description="program and arguments, split as a shell does but run without one; {frames}: "
        "a folder of all frames, 00000.png on; {out}: an empty folder for what it writes; "
        "{video}, {folder}: the video and its folder; {width}, {height}, {count}, {fps}"
    )
    cwd: Path | None = Field(
        default=None, description="folder to run it in, such as the tool's own; relative to the "
        "video's folder, which it is by default"
    )  # fmt: skip
    masks: MasksFilesConfig | None = Field(
        default=None,
        description="how to read masks, as estimator:masks-files; paths start at {out}",
    )
    depth: DepthFilesConfig | None = Field(
        default=None,
        description="how to read depth, as estimator:depth-files; paths start at {out}",
    )
    landmarks: LandmarksFilesConfig | None = Field(
        default=None, description="how to read landmarks, as estimator:landmarks-files does"
    )

    @field_validator("command")
    @classmethod
    def _is_a_template(cls, command: str) -> str:
        words = shlex.split(command)
        if not words:
            raise ValueError("the command is empty")
        for word in words:
            for _, place, _, _ in string.Formatter().parse(word):
                if place is not None and place not in PLACES:
                    known = ", ".join(f"{{{p}}}" for p in PLACES)
                    hint = did_you_mean(place, PLACES)
                    raise ValueError(
                        f"{{{place}}} is not a placeholder{hint} (there are {known}; braces are "
                        "written twice)"
                    )
        return command

    @model_validator(mode="after")
    def _reads_something(self) -> Self:
        if self.masks is None and self.depth is None and self.landmarks is None:
            raise ValueError("declare what the command writes: `masks`, `depth` or `landmarks`")
        return self


class _OfReaders:
    """`provides`: of the class, all that a command may give; of an instance, what it reads."""

    def __get__(
        self, estimator: CommandEstimator | None, owner: type[CommandEstimator]
    ) -> frozenset[EstimateKind]:
        if estimator is None:
            return frozenset(ESTIMATES)
        return frozenset().union(*(reader.provides for reader in estimator.readers))


class CommandEstimator(Estimator):
    """Estimates from the files that a command writes."""

    Config: ClassVar = CommandConfig
    config: CommandConfig
    provides = _OfReaders()

    def __init__(self, config: CommandConfig) -> None:
        super().__init__(config)
        # they read what the command writes; their relative paths start at {out}
        self.readers: list[Estimator] = []
        if config.masks is not None:
            self.readers.append(MasksFilesEstimator(config.masks))
        if config.depth is not None:
            self.readers.append(DepthFilesEstimator(config.depth))
        if config.landmarks is not None:
            self.readers.append(LandmarksFilesEstimator(config.landmarks))

    def commands(self) -> tuple[str, ...]:
        return (
            self.config.command
            if self.config.cwd is None
            else f"{self.config.command}   (in {self.config.cwd})",
        )

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        # all frames: arrays that tools write have no frame numbers, so their rows must be frames
        whole = replace(video, wanted=None)
        stem = (
            video.work
            / f"command-{settings_key({'command': self.config.command, 'cwd': self.config.cwd})}"
        )
        out, done = stem.with_suffix(".out"), stem.with_suffix(".done")
        text = f"running {shlex.split(self.config.command)[0]}"
        if not done.is_file():
            shutil.rmtree(out, ignore_errors=True)  # of a run that was cut short
            out.mkdir(parents=True)
            progress(0.0, text)
            argv, cwd = self._argv(whole, out), video.resolve(self.config.cwd or Path())
            if not cwd.is_dir():
                raise HoigsError(f"estimator:command: {absent(cwd)}: the command's `cwd`")
            log = stem.with_suffix(".log")
            run_tool(argv, what="estimator:command", log=log, cwd=cwd)
        estimates = self._read(replace(video, folder=out))
        done.touch()
        progress(1.0, text)
        return estimates

    def _argv(self, video: VideoRequest, out: Path) -> list[str]:
        if "{video}" in self.config.command and video.video is None:
            raise HoigsError(
                "estimator:command: {video} is in the command, but only frames are given"
            )
        places = {
            "frames": video.write_frames().absolute() if "{frames}" in self.config.command else "",
            "out": out.absolute(), "video": video.video and video.video.absolute(),
            "folder": video.folder.absolute(), "width": video.width, "height": video.height,
            "count": video.frames, "fps": f"{video.fps:g}",
        }  # fmt: skip
        return [word.format(**places) for word in shlex.split(self.config.command)]

    def _read(self, video: VideoRequest) -> Estimates:
        parts: dict[str, Any] = {}
        problems = []
        for reader in self.readers:
            try:
                found = reader.estimate(video)
            except HoigsError as error:
                problems.append(str(error))
                continue
            parts |= {k: getattr(found, k) for k in ESTIMATES if k in reader.provides}
        if problems:
            raise HoigsError(
                f"estimator:command: `{self.config.command}` exited with 0, but its files are "
                "unusable:\n" + "\n".join(problems)
            )
        return Estimates(**parts)

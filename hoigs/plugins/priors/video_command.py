"""prior:command: any tool with a command line; what it writes is read as files.

The way to estimators that no plugin knows: SAMURAI, Track Anything, Metric3D, Video Depth Anything,
DepthCrafter, each in the environment that it wants (docs/reference/estimators.md).
"""

from __future__ import annotations

import shlex
import shutil
import string
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from pydantic import Field, field_validator, model_validator

from hoigs.core.config import ComponentConfig
from hoigs.core.context import BuildContext
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.video_prior import (
    EVIDENCE,
    Evidence,
    EvidenceKind,
    Progress,
    VideoPrior,
    VideoRequest,
    no_progress,
)
from hoigs.plugins.priors.video_depth_files import DepthFilesConfig, DepthFilesPrior
from hoigs.plugins.priors.video_files import absent
from hoigs.plugins.priors.video_landmarks_files import LandmarksFilesConfig, LandmarksFilesPrior
from hoigs.plugins.priors.video_masks_files import MasksFilesConfig, MasksFilesPrior
from hoigs.plugins.priors.video_subprocess import run_tool, settings_key

PLACES = ("frames", "out", "video", "folder", "width", "height", "count", "fps")


class CommandConfig(ComponentConfig):
    """Settings of `prior:command`.

    Whoever uses such settings runs the command in them, which `hoigs prepare` does only with
    --allow-commands: read those of others before.
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
        default=None, description="how to read masks, as prior:masks-files; paths start at {out}"
    )
    depth: DepthFilesConfig | None = Field(
        default=None, description="how to read depth, as prior:depth-files; paths start at {out}"
    )
    landmarks: LandmarksFilesConfig | None = Field(
        default=None, description="how to read landmarks, as prior:landmarks-files; likewise"
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
                        f"{{{place}}} stands for nothing{hint} (there are {known}; braces are "
                        "written twice)"
                    )
        return command

    @model_validator(mode="after")
    def _reads_something(self) -> Self:
        if self.masks is None and self.depth is None and self.landmarks is None:
            raise ValueError("say what the command writes: `masks`, `depth` or `landmarks`")
        return self


class _OfReaders:
    """`provides`: of the class, all that a command may give; of an instance, what it reads."""

    def __get__(
        self, prior: CommandPrior | None, owner: type[CommandPrior]
    ) -> frozenset[EvidenceKind]:
        if prior is None:
            return frozenset(EVIDENCE)
        return frozenset().union(*(reader.provides for reader in prior.readers))


class CommandPrior(VideoPrior):
    """Evidence from the files of a command.

    Args:
        command: as CommandConfig describes it.
        readers: of what it writes, whose relative paths start at {out}; each of one kind.
        cwd: folder to run it in; None: the video's.
    """

    provides = _OfReaders()

    def __init__(
        self, command: str, readers: Iterable[VideoPrior], cwd: str | Path | None = None
    ) -> None:
        self.command, self.readers = command, tuple(readers)
        self.cwd = None if cwd is None else Path(cwd)

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        readers: list[VideoPrior] = []
        if config.masks is not None:
            readers.append(MasksFilesPrior.from_config(config.masks, context))
        if config.depth is not None:
            readers.append(DepthFilesPrior.from_config(config.depth, context))
        if config.landmarks is not None:
            readers.append(LandmarksFilesPrior.from_config(config.landmarks, context))
        return cls(config.command, readers, config.cwd)

    def commands(self) -> tuple[str, ...]:
        return (self.command if self.cwd is None else f"{self.command}   (in {self.cwd})",)

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Evidence:
        # all frames: arrays that tools write have no frame numbers, so their rows must be frames
        whole = replace(video, wanted=None)
        stamp = video.work / f"command-{settings_key({'command': self.command, 'cwd': self.cwd})}"
        out, done = stamp.with_suffix(".out"), stamp.with_suffix(".done")
        text = f"running {shlex.split(self.command)[0]}"
        if not done.is_file():
            shutil.rmtree(out, ignore_errors=True)  # of a run that was cut short
            out.mkdir(parents=True)
            progress(0.0, text)
            argv, cwd = self._argv(whole, out), video.resolve(self.cwd or Path())
            if not cwd.is_dir():
                raise HoigsError(f"prior:command: {absent(cwd)}: the command's `cwd`")
            log = stamp.with_suffix(".log")
            run_tool(argv, what="prior:command", log=log, cwd=cwd)
        evidence = self._read(replace(video, folder=out))
        done.touch()
        progress(1.0, text)
        return evidence

    def _argv(self, video: VideoRequest, out: Path) -> list[str]:
        if "{video}" in self.command and video.video is None:
            raise HoigsError("prior:command: {video} is asked for, but there are only frames")
        places = {
            "frames": video.write_frames().absolute() if "{frames}" in self.command else "",
            "out": out.absolute(), "video": video.video and video.video.absolute(),
            "folder": video.folder.absolute(), "width": video.width, "height": video.height,
            "count": video.frames, "fps": f"{video.fps:g}",
        }  # fmt: skip
        return [word.format(**places) for word in shlex.split(self.command)]

    def _read(self, video: VideoRequest) -> Evidence:
        parts: dict[str, Any] = {}
        problems = []
        for reader in self.readers:
            try:
                found = reader.estimate(video)
            except HoigsError as error:
                problems.append(str(error))
                continue
            parts |= {k: getattr(found, k) for k in EVIDENCE if k in reader.provides}
        if problems:
            raise HoigsError(
                f"prior:command: `{self.command}` ended well, but what it wrote cannot be used:\n"
                + "\n".join(problems)
            )
        return Evidence(**parts)

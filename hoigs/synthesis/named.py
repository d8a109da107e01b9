"""Built-in clips by name: "builtin:carry", "builtin:carry?width=128&frames=40"."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hoigs.core.errors import ClipError, did_you_mean
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document
from hoigs.synthesis.builtin import Progress, builtin_clip
from hoigs.synthesis.config import CLIPS, SceneConfig

PREFIX = "builtin:"


def is_named(clip: str | Path) -> bool:
    """Whether a CLIP argument names a built-in clip."""
    return str(clip).startswith(PREFIX)


def clip_config(name: str) -> SceneConfig:
    """The config of "builtin:NAME", or "builtin:NAME?setting=value&group.setting=value".

    A width alone sets the height too, so that frames are square. Several values have commas between
    them: "held_out_degrees=45,90,135".

    Raises:
        ClipError: no clip of that name, no such setting, or an invalid value.
    """
    short, _, query = name.removeprefix(PREFIX).partition("?")
    if short not in CLIPS:
        known = [PREFIX + n for n in CLIPS]
        near = did_you_mean(PREFIX + short, known)
        raise ClipError(
            f"{name}: no built-in clip of that name; there are {', '.join(known)}{near}"
        )
    settings: dict[str, Any] = {
        k: dict(v) if isinstance(v, Mapping) else v for k, v in CLIPS[short].items()
    }
    for part in filter(None, query.split("&")):
        key, equals, value = part.partition("=")
        if not equals:
            raise ClipError(
                f"{name}: {part!r} is not setting=value; write for example "
                f"{PREFIX}{short}?width=128"
            )
        *groups, last = key.split(".")
        place = settings
        for group in groups:
            place = place.setdefault(group, {})
            if not isinstance(place, dict):
                raise ClipError(f"{name}: {group} has no settings of its own")
        place[last] = [v for v in value.split(",") if v] if "," in value else value
    square = "width" in settings and "height" not in settings
    if square:
        settings["height"] = settings["width"]
    try:
        return SceneConfig.model_validate(settings)
    except ValidationError as error:
        lines = explain(error, SceneConfig, Document(f"{name}:", settings), ())
        same = f"{name}: height:" if square else None  # what is said of the width already
        lines = [line for line in lines if same is None or not line.startswith(same)]
        raise ClipError("\n".join(lines)) from error


def named_clip(name: str, body: BodyModel, *, progress: Progress | None = None) -> Path:
    """The folder of a built-in clip, generated unless it is cached (`builtin_clip`).

    Raises:
        ClipError: as `clip_config`.
    """
    return builtin_clip(body, clip_config(name), progress=progress)

"""Settings that readers share."""

from __future__ import annotations

from pydantic import Field

from hoigs.core.config import ComponentConfig


class ReaderConfig(ComponentConfig):
    """Settings of every reader of a folder of images."""

    cache_mb: int = Field(default=512, ge=0, description="decoded pixels kept in memory, MiB")


class VideoReaderConfig(ReaderConfig):
    """Settings of readers whose layout does not give the frames a second."""

    fps: float = Field(default=30.0, gt=0, description="of the video; the layout has none")


class VideoPointsConfig(VideoReaderConfig):
    """Settings of readers whose layout has neither these nor scene points."""

    points: int = Field(default=20_000, ge=1, description="scene points to start from")

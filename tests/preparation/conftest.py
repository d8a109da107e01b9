"""A tiny recorded scene: a person-shaped rectangle and a bright ball that moves, 12 frames."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny import FRAMES, make_source, picture

from hoigs.preparation.report.overlay import VideoWriter


@pytest.fixture(scope="session")
def tiny_video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "tiny.mp4"
    with VideoWriter(path, fps=12, crf=8) as video:
        for i in range(FRAMES):
            video.add(picture(i))
    return path


@pytest.fixture
def tiny_source(tiny_video: Path, tmp_path: Path) -> Path:
    return make_source(tmp_path / "source", tiny_video)

"""Tiny data sets in the layouts of others, to be damaged; those that need no licensed body file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from hoigs.core.registry.registry import default_registry
from hoigs.core.values.clip import Clip

# the writers that the readers' own tests use
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "plugins" / "readers"))

Reader = Callable[[Path], None]
PIXELS = (".png", ".jpg")
# from tests/plugins/readers/layouts; colmap-binary is written by COLMAP from the same model
LAYOUTS: dict[str, dict[str, Any]] = {
    "dnerf": {"points": 50},
    "hypernerf": {},
    "colmap": {},
    "colmap-binary": {},
    "nerfstudio": {"points": 50},
    "davis": {"points": 50},
    "davis-folders": {"points": 50},
    "hold": {},
}


def write_layouts(root: Path, clip: Path) -> list[tuple[str, Path, tuple[str, ...], Reader]]:
    """Every layout in a folder of its own: its name, the folder, the files to damage, the reader.

    Args:
        clip: a clip folder with a person, an object and depth.
    """
    from hoigs.plugins.readers.clip import ClipFolderReader

    read, made = ClipFolderReader().read(clip), []
    for name, options in LAYOUTS.items():
        folder = root / f"layout-{name}"
        folder.mkdir()
        start = _write(name, read, folder).relative_to(folder)
        files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
        # every frame has the same kinds of files: those of the third are damaged
        pixels = [p for p in files if p.suffix in PIXELS]
        third = [p for i, p in enumerate(pixels) if _number(p) in (2, 3) and i % 2 == 0]
        chosen = [p for p in files if p.suffix not in PIXELS and _number(p) in (None, 2)] + third
        made.append((
            f"layout {name}",
            folder,
            tuple(str(p.relative_to(folder)) for p in chosen),
            _reader(f"reader:{name.partition('-')[0]}", start, options),
        ))  # fmt: skip
    return made


def _number(path: Path) -> int | None:
    digits = "".join(c for c in path.stem if c.isdigit())
    return int(digits) if digits and path.suffix not in (".txt", ".bin") else None


def _write(name: str, clip: Clip, folder: Path) -> Path:
    """The folder that the reader is given."""
    from layouts import colmap, davis, dnerf, hold, hypernerf, nerfstudio

    if name.startswith("davis"):
        return davis.write(clip, folder, folders=name == "davis-folders")
    if name == "hold":
        return hold.write(clip, folder)
    if name.startswith("colmap"):
        colmap.write(clip, folder, binary=name == "colmap-binary")
    else:
        {"dnerf": dnerf, "hypernerf": hypernerf, "nerfstudio": nerfstudio}[name].write(clip, folder)
    return folder


def _reader(key: str, start: Path, options: dict[str, Any]) -> Reader:
    registry = default_registry()

    def read(folder: Path) -> None:
        reader = registry.concrete(key)(registry.config_class(key)(**options))
        reader.matches(folder / start)
        clip = reader.read(folder / start)
        assert torch.isfinite(clip.points).all(), "points are not finite"
        # a COLMAP model may have poses alone; the other layouts have points of their own
        assert len(clip.points) or key == "reader:colmap", "no points"
        for position in (0, 2, len(clip) - 1):
            frame = clip[position % len(clip)]
            camera = frame.camera
            assert frame.image.shape[:2] == (camera.height, camera.width), "size of an image"
            assert torch.isfinite(camera.K).all(), "intrinsics are not finite"
            assert torch.isfinite(camera.world_to_camera).all(), "a camera is not finite"
            assert 0 <= frame.moment.time <= 1, "a time out of range"
            for mask in frame.masks.values():
                assert mask.shape == frame.image.shape[:2], "size of a mask"
            if frame.depth is not None:
                assert torch.isfinite(frame.depth).all(), "depth is not finite"

    return read

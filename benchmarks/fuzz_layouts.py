"""Tiny data sets in the layouts of others, to be damaged, and files of bodies.

Body files are in the layouts of SMPL, SMPL+H and SMPL-X with the built-in body's shape and joints,
as in the readers' own tests: the real ones are licensed.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from hoigs.core.registry.registry import default_registry
from hoigs.core.values.clip import Clip

# the writers that the readers' own tests use
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "plugins" / "readers"))

Reader = Callable[[Path], None]
# from tests/plugins/readers/layouts; colmap-binary is written by COLMAP from the same model
LAYOUTS: dict[str, dict[str, Any]] = {
    "dnerf": {"points": 50},
    "hypernerf": {},
    "colmap": {},
    "colmap-binary": {},
    "nerfstudio": {"points": 50},
    "hold": {},
    "arctic": {},
    "behave": {},
    "exavatar": {"num_betas": 10, "smplx": "smplx.npz"},
    "hosnerf": {"points": 50, "smpl": "smpl.npz"},
    "neuman": {"smpl": "smpl.npz"},
}
# whose files may have poses alone; the others have points of their own, or random ones
WITHOUT_POINTS = [f"reader:{n}" for n in ("colmap", "arctic", "behave", "exavatar", "neuman")]
BODIES = ("smpl", "smplh", "smplx")


def write_layouts(root: Path, clip: Path) -> list[tuple[str, Path, tuple[str, ...], Reader]]:
    """Every layout in a folder of its own: its name, the folder, the files to damage, the reader.

    Args:
        clip: a clip folder with a person, an object and depth.
    """
    from hoigs.plugins.readers.clip import ClipFolderReader

    read, made = ClipFolderReader().read(clip), [_body_files(root)]
    for name, options in LAYOUTS.items():
        folder = root / f"layout-{name}"
        folder.mkdir()
        start = _write(name, read, folder).relative_to(folder)
        files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
        given = {key: folder / value if str(value).endswith(".npz") else value
                 for key, value in options.items()}  # fmt: skip
        # every frame has the same kinds of files: the third of each kind is damaged
        kinds: dict[str, list[str]] = {}
        for path in files:
            place = str(path.relative_to(folder))
            kinds.setdefault(re.sub(r"\d+", "#", place), []).append(place)
        chosen = [p for same in kinds.values() for p in (same if len(same) < 3 else same[2:3])]
        made.append((
            f"layout {name}",
            folder,
            tuple(chosen),
            _reader(f"reader:{name.partition('-')[0]}", start, given),
        ))  # fmt: skip
    return made


def _write(name: str, clip: Clip, folder: Path) -> Path:
    """The folder that the reader is given."""
    from layouts import colmap, dnerf, hold, hypernerf, nerfstudio

    if name in ("arctic", "behave", "exavatar", "hosnerf", "neuman"):
        return _write_with_body(name, clip, folder)
    if name == "hold":
        return hold.write(clip, folder)
    if name.startswith("colmap"):
        colmap.write(clip, folder, binary=name == "colmap-binary")
    else:
        {"dnerf": dnerf, "hypernerf": hypernerf, "nerfstudio": nerfstudio}[name].write(clip, folder)
    return folder


def _write_with_body(name: str, clip: Clip, folder: Path) -> Path:
    """The layouts that have a person's pose, some with the body's file in the same folder."""
    from layouts import arctic, behave, exavatar, hosnerf, neuman
    from layouts.anny_models import write_model
    from layouts.changed import without_fingers

    from hoigs.plugins.bodies.anny import AnnyBody
    from hoigs.plugins.bodies.smpl import SmplBody

    poses = clip.bodies["human"].poses
    if name == "arctic":
        flat = replace(poses, betas=torch.zeros_like(poses.betas))
        track = replace(clip.bodies["human"], poses=flat)
        template = AnnyBody().template.double().numpy()[:240]
        return arctic.write(replace(clip, bodies={"human": track}), folder, template, view=0)
    if name == "behave":
        still = replace(clip, cameras=clip.cameras[:1] * len(clip))
        pelvis = AnnyBody().shaped(poses.betas)[1][0]
        return behave.write(still, folder, pelvis)[0]
    if name == "exavatar":
        write_model(folder / "smplx.npz", "smplx")
        exavatar.write(clip, folder, AnnyBody())
        return folder
    model = write_model(folder / "smpl.npz", "smpl")
    if name == "neuman":
        neuman.write(without_fingers(clip), folder, AnnyBody())
    else:
        hosnerf.write(without_fingers(clip), folder, SmplBody(SmplBody.Config(path=model)))
    return folder


def _body_files(root: Path) -> tuple[str, Path, tuple[str, ...], Reader]:
    """The three kinds of body files, as a target of their own."""
    from layouts.anny_models import write_model

    registry, folder = default_registry(), root / "bodies"
    folder.mkdir()
    for family in BODIES:
        write_model(folder / f"{family}.npz", family)

    def read(folder: Path) -> None:
        for family in BODIES:
            key = f"body:{family}"
            config = registry.config_class(key)(path=folder / f"{family}.npz")
            body = registry.concrete(key)(config)
            assert torch.isfinite(body.template).all(), "the template is not finite"

    return "bodies", folder, tuple(f"{family}.npz" for family in BODIES), read


def _reader(key: str, start: Path, options: dict[str, Any]) -> Reader:
    registry = default_registry()

    def read(folder: Path) -> None:
        reader = registry.concrete(key)(registry.config_class(key)(**options))
        reader.matches(folder / start)
        clip = reader.read(folder / start)
        assert torch.isfinite(clip.points).all(), "points are not finite"
        assert len(clip.points) or key in WITHOUT_POINTS, "no points"
        for frame in clip:
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

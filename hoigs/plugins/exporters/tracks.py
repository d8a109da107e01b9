"""exporter:tracks: where objects, people and cameras are, and when hands touch."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.body import LEFT_HAND_PART, RIGHT_HAND_PART
from hoigs.core.maths.nearest import nearest
from hoigs.core.maths.rotations import matrices_to_quats
from hoigs.core.model.exporter import Exporter, ExportRequest
from hoigs.core.reporting import Progress
from hoigs.core.values.between import camera_between, frame_of
from hoigs.core.values.camera import Camera
from hoigs.plugins.exporters.posed import (
    SEEN,
    BodyMotion,
    ObjectMotion,
    body_motion,
    object_motions,
)

HANDS = {"left": LEFT_HAND_PART, "right": RIGHT_HAND_PART}
POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")


class TracksConfig(ComponentConfig):
    """Settings of `exporter:tracks`."""

    contact: float = Field(default=0.02, gt=0)
    """a hand nearer than this to an object touches it, metres"""


class TracksExporter(Exporter):
    """`objects.csv`, `cameras.csv`, `joints.csv`, `contacts.csv`, all in `tracks.json`, and
    `colmap/` with the cameras as COLMAP's text model.
    """

    Config: ClassVar = TracksConfig
    config: TracksConfig
    keeps: ClassVar = {
        "objects": "object to world, quaternion wxyz and metres: the rigid motion that fits the "
        "Gaussians best, in the frame of the clip's track",
        "cameras": "world to camera, quaternion wxyz and metres, and intrinsics in pixels",
        "joints": "world positions of the joints of each person",
        "contacts": "distance of the nearest vertex of each hand to the nearest visible Gaussian "
        "of each object, metres",
    }

    def write(self, request: ExportRequest, folder: Path, progress: Progress) -> Mapping[str, str]:
        frames = [frame_of(request.clip, moment) for moment in request.moments]
        stamps = [(f"{f:.4f}", f"{i / request.fps:.6f}") for i, f in enumerate(frames)]
        cameras = [camera_between(request.clip, frame).to("cpu") for frame in frames]
        lost: dict[str, str] = {"looks": "the files hold motion alone"}
        progress(0.1, "objects")
        objects = object_motions(request)
        people = []
        for name in request.of_kind("human"):
            if name in request.bodies:
                people.append(body_motion(request, name))
            else:
                lost[f"joints of {name}"] = "it has no body model"
        for motion in objects:
            if motion.residual > 1e-4:
                lost[f"deformation of {motion.name}"] = (
                    f"its Gaussians are {1000 * motion.residual:.2f} mm (RMS) from a rigid motion"
                )
        progress(0.5, "contacts")
        tables = {
            "objects": (("frame", "seconds", "entity", *POSE), _objects(objects, stamps)),
            "cameras": (
                ("frame", "seconds", *POSE, "fx", "fy", "cx", "cy", "width", "height"),
                _cameras(cameras, stamps),
            ),
            "joints": (
                ("frame", "seconds", "entity", "joint", "x", "y", "z"), _joints(people, stamps),
            ),
            "contacts": (
                ("frame", "seconds", "human", "hand", "object", "distance", "contact"),
                self._contacts(request, people, objects, stamps),
            ),
        }  # fmt: skip
        document: dict[str, Any] = {"fps": request.fps}
        for name, (header, rows) in tables.items():
            kept = [dict(zip(header, row, strict=True)) for row in rows]
            document[name] = kept
            if kept:
                _write_csv(folder / f"{name}.csv", header, [list(row.values()) for row in kept])
        text = json.dumps(document, indent=1)
        (folder / "tracks.json").write_text(text + "\n", encoding="utf-8")
        progress(0.9, "cameras")
        _write_colmap(folder / "colmap", cameras)
        return lost

    def _contacts(
        self,
        request: ExportRequest,
        people: Sequence[BodyMotion],
        objects: Sequence[ObjectMotion],
        stamps: Sequence[tuple[str, str]],
    ) -> Iterable[tuple[Any, ...]]:
        for i, moment in enumerate(request.moments):
            for thing in objects if people else ():
                gaussians = request.scene(moment, [thing.name]).gaussians[thing.name]
                seen = gaussians.opacities > SEEN
                means = gaussians.means[seen].detach().cpu() if seen.any() else gaussians.means
                for person in people:
                    vertices = person.vertices(i)
                    for hand, part in HANDS.items():
                        skin = vertices[person.body.vertex_parts == part]
                        distance = float(nearest(skin, 1, means)[1].min())
                        yield (
                            *stamps[i], person.name, hand, thing.name, round(distance, 5),
                            int(distance < self.config.contact),
                        )  # fmt: skip


def _objects(
    objects: Sequence[ObjectMotion], stamps: Sequence[tuple[str, str]]
) -> Iterable[tuple[Any, ...]]:
    for motion in objects:
        for stamp, turn, place in zip(stamps, motion.rotations, motion.translations, strict=True):
            yield (*stamp, motion.name, *_pose(turn, place))


def _cameras(
    cameras: Sequence[Camera], stamps: Sequence[tuple[str, str]]
) -> Iterable[tuple[Any, ...]]:
    for stamp, camera in zip(stamps, cameras, strict=True):
        view = camera.world_to_camera
        yield (*stamp, *_pose(view[:3, :3], view[:3, 3]), *_intrinsics(camera), *_size(camera))


def _joints(
    people: Sequence[BodyMotion], stamps: Sequence[tuple[str, str]]
) -> Iterable[tuple[Any, ...]]:
    for person in people:
        for i, stamp in enumerate(stamps):
            for joint, place in zip(person.body.joint_names, person.joints(i), strict=True):
                yield (*stamp, person.name, joint, *_rounded(place))


def _pose(turn: Float[Tensor, "3 3"], place: Float[Tensor, " 3"]) -> list[float]:
    return [*_rounded(matrices_to_quats(turn)), *_rounded(place)]


def _rounded(values: Float[Tensor, " N"]) -> list[float]:
    return [round(x, 7) + 0.0 for x in values.double().tolist()]


def _intrinsics(camera: Camera) -> list[float]:
    K = camera.K
    return [round(float(x), 6) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]


def _size(camera: Camera) -> list[int]:
    return [camera.width, camera.height]


def _write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")


def _write_colmap(folder: Path, cameras: Sequence[Camera]) -> None:
    """`cameras.txt`, `images.txt` and an empty `points3D.txt`; an image is named by its number."""
    folder.mkdir()
    lenses: dict[tuple[float, ...], int] = {}
    images = []
    for i, camera in enumerate(cameras):
        lens = lenses.setdefault((*_size(camera), *_intrinsics(camera)), len(lenses) + 1)
        view = camera.world_to_camera
        pose = " ".join(map(str, _pose(view[:3, :3], view[:3, 3])))
        images.append(f"{i + 1} {pose} {lens} {i:05d}.png\n\n")
    rows = [f"{n} PINHOLE {' '.join(f'{x:.10g}' for x in lens)}\n" for lens, n in lenses.items()]
    (folder / "cameras.txt").write_text("".join(rows), encoding="ascii")
    (folder / "images.txt").write_text("".join(images), encoding="ascii")
    (folder / "points3D.txt").write_text("", encoding="ascii")

"""Overlays: body mesh, skeleton, object track, cameras and points as 3D nodes of the browser."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image
from pydantic import ValidationError

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.deformation import ProvidesSkeleton
from hoigs.core.maths.rotations import matrices_to_quats
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry
from hoigs.core.values.between import moment_between
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.runs.kept_clip import NoPixels
from hoigs.viewing.viewer.panes import nearest_position
from hoigs.viewing.viewer.run_drawing import entity_colors
from hoigs.viewing.viewer.views import View

# Posed bodies of a run or a clip: vertices and joints at any frame number.


@dataclass(frozen=True)
class PosedBody:
    """A person's body over time.

    Attributes:
        faces: triangles. bones: pairs of joints.
    """

    body: BodyModel
    pose: Callable[[Moment], BodyPose]
    clip: Clip

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        return self.body.faces.cpu().numpy()

    @property
    def bones(self) -> Int[np.ndarray, "E 2"]:
        pairs = [(p, j) for j, p in enumerate(self.body.parents) if p >= 0]
        return np.array(pairs)

    @torch.no_grad()
    def at(self, frame: float) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "J 3"]]:
        """Vertices and joints at a frame number, world, metres."""
        device = self.body.faces.device
        posed = self.body(self.pose(moment_between(self.clip, frame).to(device)))
        return posed.vertices.cpu().numpy(), posed.joints.cpu().numpy()


def bodies_of_run(model: SceneModel, clip: Clip) -> dict[str, PosedBody]:
    """The bodies that a run's deformations hold, in the poses that training has refined."""
    found = {}
    for name in model.names("human"):
        deformation = model.entity(name).deformation
        body = getattr(deformation, "body", None)
        if isinstance(body, BodyModel) and isinstance(deformation, ProvidesSkeleton):
            found[name] = PosedBody(body, deformation.pose, clip)
    return found


def bodies_of_clip(clip: Clip, registry: Registry) -> tuple[dict[str, PosedBody], dict[str, str]]:
    """The bodies of a clip, and by entity why one cannot be shown."""
    found, missing = {}, {}
    for name, track in clip.bodies.items():
        try:
            config = registry.config_class(track.model)()
            context = BuildContext(entity=name, clip=clip, body_track=track)
            body = registry.concrete(track.model).from_config(config, context)
        except (HoigsError, ValidationError) as error:
            missing[name] = f"no body mesh: {track.model}: {str(error).splitlines()[0]}"
            continue
        found[name] = PosedBody(body, partial(_pose_of, name), clip)
    return found, missing


def _pose_of(name: str, moment: Moment) -> BodyPose:
    return moment.poses[name]


CAMERAS = 24  # frusta that are drawn at most
APART = 0.02  # of the scene's size: nearer cameras would cover each other
AT_THE_CAMERA = frozenset({"cameras", "camera images"})
# shown of a clip where a drag has left its frames
IN_PLACE_OF_FRAMES = ("body mesh", "object points", "scene points")
THUMBNAIL = 160  # pixels of width of a camera's image
DEPTH_POINTS = 30_000  # of the depth of one frame at most


def offered(
    clip: Clip, bodies: Mapping[str, PosedBody], *, before_training: bool
) -> tuple[str, ...]:
    """Names of the overlays that there is something to show of."""
    names = {
        "body mesh": bool(bodies),
        "skeleton": bool(bodies),
        "object track": bool(clip.objects),
        "cameras": True,
        "camera images": not isinstance(clip.store, NoPixels),
        "object points": before_training and bool(clip.objects),
        "scene points": before_training and len(clip.points) > 0,
        "depth points": before_training and clip.depth_kind == "metric",
    }
    return tuple(name for name, there in names.items() if there)


class Overlays:
    """The nodes in a viser scene. A node is made when it is first shown.

    Args:
        scene: viser's scene of one browser. bodies: by entity.
    """

    def __init__(self, scene: Any, clip: Clip, bodies: Mapping[str, PosedBody]) -> None:
        self.scene, self.clip, self.bodies = scene, clip, bodies
        self.colors = {n: _rgb(c) for n, c in entity_colors(list(clip.kinds)).items()}
        self.size = clip.extent()
        self._nodes: dict[str, list[Any]] = {}
        self._shown: frozenset[str] = frozenset()
        self._frame: float | None = None

    def update(self, shown: set[str], frame: float) -> None:
        """Show these overlays at a frame number, and hide the others."""
        wanted = frozenset(shown)
        if wanted == self._shown and frame == self._frame:
            return
        for name in self._shown - wanted:
            for node in self._nodes[name]:
                node.visible = False
        for name in wanted:
            if name not in self._nodes:
                self._nodes[name] = list(getattr(self, "_make_" + name.replace(" ", "_"))(frame))
            elif frame != self._frame or name not in self._shown:
                move = getattr(self, "_move_" + name.replace(" ", "_"), None)
                if move is not None:
                    move(frame)
            if name not in self._shown:
                for node in self._nodes[name]:
                    node.visible = True
        self._shown, self._frame = wanted, frame

    def _make_body_mesh(self, frame: float) -> Any:
        for name, body in self.bodies.items():
            yield self.scene.add_mesh_simple(
                f"/body/{name}", body.at(frame)[0], body.faces, color=self.colors[name],
                opacity=0.7, side="double", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip

    def _move_body_mesh(self, frame: float) -> None:
        for node, body in zip(self._nodes["body mesh"], self.bodies.values(), strict=True):
            node.vertices = body.at(frame)[0].astype(np.float32)

    def _make_skeleton(self, frame: float) -> Any:
        for name, body in self.bodies.items():
            joints = body.at(frame)[1]
            yield self.scene.add_line_segments(
                f"/skeleton/{name}", joints[body.bones], (255, 255, 255), line_width=3.0
            )

    def _move_skeleton(self, frame: float) -> None:
        for node, body in zip(self._nodes["skeleton"], self.bodies.values(), strict=True):
            node.points = body.at(frame)[1][body.bones].astype(np.float32)

    def _make_object_track(self, frame: float) -> Any:
        for name, track in self.clip.objects.items():
            path = track.translations.numpy()
            if len(path) > 1:
                yield self.scene.add_line_segments(
                    f"/track/{name}/path", np.stack((path[:-1], path[1:]), 1), self.colors[name],
                    line_width=3.0,
                )  # fmt: skip
            turn, place = self._pose(track, frame)
            length = float(track.points.norm(dim=-1).max()) if len(track.points) else 0.2
            yield self.scene.add_frame(
                f"/track/{name}/axes", wxyz=turn, position=place, axes_length=length,
                axes_radius=length / 40,
            )  # fmt: skip

    def _move_object_track(self, frame: float) -> None:
        self._place("object track", "/axes", frame)

    def _make_object_points(self, frame: float) -> Any:
        for name, track in self.clip.objects.items():
            turn, place = self._pose(track, frame)
            yield self.scene.add_point_cloud(
                f"/object_points/{name}", track.points.numpy(), _bytes(track.colors),
                point_size=0.004 * self.size, wxyz=turn, position=place,
            )  # fmt: skip

    def _move_object_points(self, frame: float) -> None:
        self._place("object points", "", frame)

    def _make_scene_points(self, frame: float) -> Any:
        yield self.scene.add_point_cloud(
            "/scene_points", self.clip.points.numpy(), _bytes(self.clip.point_colors),
            point_size=0.003 * self.size,
        )  # fmt: skip

    def _make_depth_points(self, frame: float) -> Any:
        points, colors = self._depth_points(frame)
        yield self.scene.add_point_cloud(
            "/depth_points", points, colors, point_size=0.003 * self.size
        )

    def _move_depth_points(self, frame: float) -> None:
        (node,) = self._nodes["depth points"]
        node.points, node.colors = self._depth_points(frame)

    def _make_cameras(self, frame: float) -> Any:
        yield from self._frusta("/cameras", images=False)
        centers = np.stack([c.center.numpy() for c in self.clip.cameras])
        if len(centers) > 1:
            segments = np.stack((centers[:-1], centers[1:]), 1)
            yield self.scene.add_line_segments("/cameras/path", segments, (255, 200, 80))

    def _make_camera_images(self, frame: float) -> Any:
        yield from self._frusta("/camera_images", images=True)

    def _frusta(self, place: str, images: bool) -> Any:
        clip, last = self.clip, None
        for i in range(0, len(clip), -(-len(clip) // CAMERAS)):
            camera = clip.cameras[i]
            if last is not None and float((camera.center - last).norm()) < APART * self.size:
                continue
            last = camera.center
            view = View.of_camera(camera, 1.0, (camera.width, camera.height))
            image = None
            if images:
                source = Image.fromarray(clip.store.image(i).numpy())
                height = max(1, round(THUMBNAIL * source.height / source.width))
                image = np.asarray(source.resize((THUMBNAIL, height)))
            yield self.scene.add_camera_frustum(
                f"{place}/{i}", view.fov, camera.width / camera.height, scale=0.05 * self.size,
                color=(255, 200, 80), image=image, position=view.position,
                wxyz=_quat(torch.from_numpy(view.rotation.copy())),
            )  # fmt: skip

    def _place(self, name: str, ending: str, frame: float) -> None:
        nodes = [n for n in self._nodes[name] if n.name.endswith(ending)]
        for node, track in zip(nodes, self.clip.objects.values(), strict=True):
            node.wxyz, node.position = self._pose(track, frame)

    def _pose(self, track: ObjectTrack, frame: float) -> tuple[Any, Any]:
        """Quaternion and position of an object in the nearest frame."""
        i = nearest_position(self.clip, frame)
        return _quat(track.rotations[i]), track.translations[i].numpy()

    def _depth_points(self, frame: float) -> tuple[Any, Any]:
        """World points of the nearest frame's depth, with the colours of the video."""
        i = nearest_position(self.clip, frame)
        depth, camera = self.clip.store.depth(i), self.clip.cameras[i]
        if depth is None:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        known = (depth > 0).nonzero()
        rows, columns = known[:: len(known) // DEPTH_POINTS + 1].unbind(-1)
        points = camera.unproject(camera.pixel_grid()[rows, columns], depth[rows, columns])
        return points.numpy(), self.clip.store.image(i)[rows, columns].numpy()


def _quat(rotation: torch.Tensor) -> np.ndarray:
    return matrices_to_quats(rotation).numpy()


def _bytes(colors: torch.Tensor) -> np.ndarray:
    return (colors.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _rgb(color: tuple[float, float, float]) -> tuple[int, int, int]:
    r, g, b = (round(255 * c) for c in color)
    return r, g, b

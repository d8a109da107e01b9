"""Colour, depth and entities of a view by casting rays at triangle meshes (Warp mesh queries).

Shading is Lambert with a fixed sun (a small disc, so shadows are soft) and a sky, neither of which
depends on the view: two cameras that see one point see one colour, unless it is a mirror's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from hoigs.core.system.quiet_warp import wp
from hoigs.core.values.camera import Camera
from hoigs.synthesis import raycast_kernels as kernels
from hoigs.synthesis.config import CameraConfig, LightConfig, SceneConfig
from hoigs.synthesis.meshes import TexturedMesh
from hoigs.synthesis.raycast_kernels import DIRECTIONS, FINE, Lights, Surface, View
from hoigs.synthesis.textures import TextureAtlas

Array = np.ndarray


@dataclass(frozen=True)
class Layer:
    """A mesh on Warp's side; keeps the arrays that the kernel's struct points to alive."""

    surface: Surface
    mesh: wp.Mesh

    @staticmethod
    def build(mesh: TexturedMesh, entity: Int[Array, " F"], fine: wp.array | None = None) -> Layer:
        """Args: entity: number of each face's entity. fine: mesh colours, from `fine_array`."""
        built = wp.Mesh(
            points=wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3, device="cpu"),
            indices=wp.array(mesh.faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu"),
        )
        surface = Surface()
        surface.mesh = built.id
        flat = lambda x, n: np.ascontiguousarray(x.reshape(-1, n), np.float32)  # noqa: E731
        surface.normals = wp.array(flat(mesh.normals, 3), dtype=wp.vec3, device="cpu")
        surface.uv = wp.array(flat(mesh.uv, 2), dtype=wp.vec2, device="cpu")
        surface.texture = wp.array(mesh.texture.astype(np.int32), dtype=wp.int32, device="cpu")
        surface.entity = wp.array(entity.astype(np.int32), dtype=wp.int32, device="cpu")
        surface.fine = wp.zeros(1, dtype=wp.vec3, device="cpu") if fine is None else fine
        return Layer(surface, built)


def fine_array(colors: Float[Array, "F N 3"]) -> wp.array:
    """Mesh colours on Warp's side, to be shared by all frames."""
    return wp.array(
        np.ascontiguousarray(colors.reshape(-1, 3), np.float32), dtype=wp.vec3, device="cpu"
    )


def fine_barycentrics() -> Float[Array, "N 3"]:
    """Barycentric coordinates of a face's mesh-colour samples, in the kernel's order."""
    rows = [(i, j, FINE - i - j) for i in range(FINE + 1) for j in range(FINE + 1 - i)]
    return np.asarray(rows, float) / FINE


@dataclass(frozen=True)
class Picture:
    """One view. color is linear RGB; depth is z in metres, 0 where nothing was hit; entity is the
    number of what the pixel's centre shows, -1 for nothing."""

    color: Float[Array, "H W 3"]
    depth: Float[Array, "H W"]
    entity: Int[Array, "H W"]


class RayCaster:
    """Renders views of a room and the objects in it.

    Args:
        shell: floor, walls and ceiling, which cast no shadow: the sun shines through them.
        room: corners of the room, low and high; its edges are dimmed.
        mirror: share of its light that entity 2 reflects as a mirror does.
    """

    def __init__(
        self,
        shell: Layer,
        atlas: TextureAtlas,
        light: LightConfig,
        room: tuple[Sequence[float], Sequence[float]],
        samples: int = 4,
        edge_samples: int = 16,
        mirror: float = 0.0,
    ):
        wp.load_module(kernels, device="cpu", block_dim=1)  # as launched, before threads use it
        self.shell = shell
        self.texels: wp.array = wp.array(atlas.texels, dtype=wp.vec3, device="cpu")
        self.levels: wp.array = wp.array(atlas.levels, dtype=wp.vec3i, device="cpu")
        self.lights = _lights(light, room, mirror)
        self.samples, self.edge_samples = samples, max(samples, edge_samples)
        offsets = pixel_samples(samples, self.edge_samples)
        self.offsets: wp.array = wp.array(offsets, dtype=wp.vec2, device="cpu")

    def render(self, camera: Camera, things: Layer) -> Picture:
        """Depth and entities at pixel centres, colour averaged over the pixel.

        One thread, and the GIL is released: frames side by side keep all cores busy.
        """
        count = camera.width * camera.height
        color = wp.zeros(count, dtype=wp.vec3, device="cpu")
        depth = wp.zeros(count, dtype=wp.float32, device="cpu")
        entity = wp.zeros(count, dtype=wp.int32, device="cpu")
        wp.launch(
            kernels.render,
            dim=count,
            inputs=[
                self.shell.surface, things.surface, self.texels, self.levels, self.lights,
                _view(camera), self.offsets, self.samples, self.edge_samples, color, depth, entity,
            ],
            device="cpu",
        )  # fmt: skip
        shape = (camera.height, camera.width)
        return Picture(
            color.numpy().reshape(*shape, 3).copy(),
            depth.numpy().reshape(shape).copy(),
            entity.numpy().reshape(shape).copy(),
        )


def pixel_samples(plain: int, more: int) -> Float[Array, "S 2"]:
    """Places in a pixel: its centre, a ring of plain samples, another ring that edges add.

    Each ring is centred, so that neither shifts the image.
    """

    def ring(count: int, phase: float) -> Array:
        angle = phase + 2 * np.pi * np.arange(count) / max(count, 1)
        return 0.5 + 0.42 * np.stack((np.cos(angle), np.sin(angle)), -1)

    rings = [np.full((1, 2), 0.5), ring(plain - 1, 0.3), ring(more - plain, 0.9)]
    return np.concatenate(rings).astype(np.float32)


def _disc(count: int) -> Float[Array, "N 2"]:
    """Vogel's spiral: even over the unit disc."""
    i = np.arange(count)
    radius, angle = np.sqrt((i + 0.5) / count), i * np.pi * (3 - np.sqrt(5))
    return np.stack((radius * np.cos(angle), radius * np.sin(angle)), -1)


def _lights(
    light: LightConfig, room: tuple[Sequence[float], Sequence[float]], mirror: float
) -> Lights:
    axis = np.asarray(light.sun_direction, float)
    axis /= np.linalg.norm(axis)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    disc = _disc(DIRECTIONS)
    spread = np.tan(np.radians(light.sun_radius_degrees)) * disc
    suns = axis + spread[:, :1] * side + spread[:, 1:] * np.cross(axis, side)
    suns /= np.linalg.norm(suns, axis=-1, keepdims=True)
    skies = np.concatenate((disc, np.sqrt(1 - (disc**2).sum(-1, keepdims=True))), -1)
    order = np.array([0, 4, 2, 6, 1, 5, 3, 7])  # neighbours in a sample lie apart
    lights: Any = Lights()
    lights.sun = wp.vec3(*(light.sun * np.array([1.0, 0.94, 0.84])))
    lights.sky = wp.vec3(*(light.ambient * np.array([0.93, 0.97, 1.05])))
    lights.ground = wp.vec3(*(light.ambient * np.array([0.60, 0.53, 0.46])))
    lights.shadows, lights.occlusion = light.shadows, light.occlusion
    lights.mirror = mirror
    lights.room_low, lights.room_high = wp.vec3(*room[0]), wp.vec3(*room[1])
    lights.suns = wp.array(suns[order].astype(np.float32), dtype=wp.vec3, device="cpu")
    lights.skies = wp.array(skies[order].astype(np.float32), dtype=wp.vec3, device="cpu")
    return lights


def _view(camera: Camera) -> View:
    K = camera.K.double().numpy()
    to_camera = camera.world_to_camera.double().numpy()
    view: Any = View()
    view.fx, view.fy, view.cx, view.cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    view.width = camera.width
    view.to_world = wp.mat33(*to_camera[:3, :3].T.ravel())
    view.eye = wp.vec3(*(-to_camera[:3, :3].T @ to_camera[:3, 3]))
    return view


# Cameras: the path of the clip, and the held-out views.

INSIDE = 0.7  # share of the distance at which a turned camera is still inside the room


def camera_path(config: SceneConfig) -> list[Camera]:
    """One camera a frame, float32."""
    return [_on_path(config, s) for s in _sweeps(config)]


def _sweeps(config: SceneConfig) -> np.ndarray:
    """Place on the path of each frame, from -0.5 to 0.5."""
    sweeps = np.linspace(-0.5, 0.5, config.frames)
    # ease in and out a little, with similar steps between frames
    return 0.75 * sweeps + 0.25 * np.sin(np.pi * sweeps) / 2


def held_out_views(config: SceneConfig) -> list[tuple[int, Camera]]:
    """(frame, camera) pairs, spread over the clip.

    Each is on the path at another time (half the clip away), raised or lowered: a new view of that
    moment, of walls and floor that training frames have seen. With `held_out_degrees` they are
    turned about the target instead, and see what no training frame shows.
    """
    count = min(config.held_out_views, config.frames)
    frames = [round((i + 0.5) * config.frames / count) for i in range(count)] if count else []
    views = []
    for number, frame in enumerate(min(f, config.frames - 1) for f in frames):
        sweep = frame / (config.frames - 1) - 0.5
        if config.held_out_degrees:
            turn = config.held_out_degrees[number // 2 % len(config.held_out_degrees)]
            turn *= 1 if number % 2 else -1
            views.append((frame, _on_path(config, float(_sweeps(config)[frame]), turn=turn)))
            continue
        other = sweep + 0.5 if sweep < 0 else sweep - 0.5
        lift = 0.18 * (1 if number % 2 else -1)
        views.append((frame, _on_path(config, float(other), lift)))
    return views


def _on_path(config: SceneConfig, sweep: float, lift: float = 0.0, turn: float = 0.0) -> Camera:
    """Camera at a place of the path, from -0.5 (start) to 0.5 (end), raised by `lift` metres and
    turned about the target by `turn` degrees."""
    c = config.camera
    azimuth = np.radians(c.azimuth_degrees + turn)
    target = np.array(c.target, float)
    height = c.height + lift
    if c.path == "orbit":
        azimuth += np.radians(c.arc_degrees) * sweep
    if c.path != "static":
        height += c.height_change * sweep
    ahead = np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
    distance = c.distance * (INSIDE if turn else 1.0)
    eye = target * [1, 0, 1] + distance * ahead + np.array([0, height, 0])
    if c.path == "pan":
        sideways = c.pan_metres * sweep * np.array([ahead[2], 0.0, -ahead[0]])
        eye, target = eye + sideways, target + 0.6 * sideways
    return _shifted(_look(config, eye, target), c)


def _look(config: SceneConfig, eye: np.ndarray, target: np.ndarray) -> Camera:
    camera = Camera.look_at(
        torch.from_numpy(eye), torch.from_numpy(target), width=config.width, height=config.height,
        fov_y=float(np.radians(config.camera.fov_y_degrees)),
    )  # fmt: skip
    return camera.to(torch.float32)


def _shifted(camera: Camera, config: CameraConfig) -> Camera:
    """The same camera with its principal point off the middle."""
    K = camera.K.clone()
    K[0, 2] += config.principal_point_shift[0] * camera.width
    K[1, 2] += config.principal_point_shift[1] * camera.height
    return replace(camera, K=K)

"""generate(config, body): a clip with known truth, one frame at a time."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from hoigs.core.interfaces.body import BodyModel
from hoigs.core.system.quiet_warp import wp
from hoigs.core.values.camera import Camera
from hoigs.core.values.moment import BodyPose
from hoigs.synthesis.choreography import Choreographer
from hoigs.synthesis.clothes import DressedBody, dress
from hoigs.synthesis.config import SceneConfig
from hoigs.synthesis.meshes import TexturedMesh, ball, box, smooth_normals
from hoigs.synthesis.object_motions import MOTIONS, ObjectScript, deformed_mesh
from hoigs.synthesis.raycast import Layer, RayCaster, camera_path, fine_array, held_out_views
from hoigs.synthesis.room import HIGH, LOW, Palette, Room, Stand, build_room
from hoigs.synthesis.textures import TextureAtlas, crate_faces, faded, to_srgb

Array = np.ndarray
HINGE = 0.1  # share of a bar that bends; below it, strips would cross at the inner side
ENTITIES = ("human", "object")  # numbers 1 and 2 in entity images; 0 is the scene


@dataclass(frozen=True)
class TrueView:
    """What a camera sees at a moment, exactly.

    Attributes:
        frame: of the clip. depth: along z, metres. entity: 0 scene, 1 human, 2 object at each
            pixel's centre.
    """

    frame: int
    camera: Camera
    image: UInt8[Array, "H W 3"]
    depth: Float[Array, "H W"]
    entity: Int[Array, "H W"]

    def mask(self, name: str) -> Bool[Array, "H W"]:
        """Visible pixels of "human" or "object"."""
        return self.entity == 1 + ENTITIES.index(name)


@dataclass(frozen=True)
class SyntheticScene:
    """A scripted scene; views are rendered on demand.

    Attributes:
        poses: batched over the frames. script: of the object. object_mesh: about its own centre,
            unbent. cameras: one a frame. held_out: (frame, camera) pairs.
    """

    config: SceneConfig
    poses: BodyPose
    script: ObjectScript
    dressed: DressedBody
    object_mesh: TexturedMesh
    shell: TexturedMesh
    props: TexturedMesh
    atlas: TextureAtlas
    cameras: list[Camera]
    held_out: list[tuple[int, Camera]]

    @cached_property
    def body_vertices(self) -> Float[Array, "T V 3"]:
        """The dressed body at every frame, world, metres."""
        return self.dressed.posed(self.poses)

    @cached_property
    def _caster(self) -> RayCaster:
        config = self.config
        shell = Layer.build(self.shell, np.zeros(len(self.shell.faces), int))
        return RayCaster(
            shell, self.atlas, config.light, (LOW, HIGH), config.samples, config.edge_samples,
            mirror=config.object.mirror,
        )  # fmt: skip

    @cached_property
    def _fine(self) -> wp.array:
        return fine_array(self.dressed.colors)

    def object_at(self, frame: int) -> TexturedMesh:
        """The object's mesh in the world."""
        script = self.script
        own = deformed_mesh(
            self.object_mesh, script.bend[frame], script.bend_width, script.squeeze[frame]
        )
        return own.moved(script.track.rotations[frame], script.track.translations[frame])

    def layer(self, frame: int) -> Layer:
        """Person, object and furniture of a frame, for ray casting."""
        vertices, faces = self.body_vertices[frame], self.dressed.faces
        normals = smooth_normals(vertices, faces)[faces]
        person = TexturedMesh(
            vertices, faces, normals, np.zeros((len(faces), 3, 2)), np.full(len(faces), -1)
        )
        parts = [(1, person), (0, self.props)]
        if frame >= self.config.object.appears * (self.config.frames - 1):
            parts.insert(1, (2, self.object_at(frame)))
        numbers = np.repeat([n for n, _ in parts], [len(mesh.faces) for _, mesh in parts])
        return Layer.build(TexturedMesh.join([mesh for _, mesh in parts]), numbers, self._fine)

    def render(self, frame: int, camera: Camera, layer: Layer | None = None) -> TrueView:
        """The moment `frame` from any camera."""
        picture = self._caster.render(camera, layer or self.layer(frame))
        gain = 1 + self.config.light.exposure_ramp * (frame / (self.config.frames - 1) - 0.5)
        image = np.round(255 * to_srgb(gain * picture.color)).astype(np.uint8)
        return TrueView(frame, camera, image, picture.depth, picture.entity)

    def views(self) -> Iterator[tuple[TrueView, list[TrueView]]]:
        """Every frame from the path's camera, with the held-out views of that moment.

        Frames are rendered in parallel, a few ahead of the one that is yielded.
        """
        threads = _cores()
        _ = self.body_vertices, self._caster, self._fine  # computed before threads read them
        with ThreadPoolExecutor(threads) as pool:
            ahead: deque[Future[tuple[TrueView, list[TrueView]]]] = deque()
            for frame in range(len(self.cameras)):
                ahead.append(pool.submit(self._moment, frame))
                if len(ahead) > 2 * threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def _moment(self, frame: int) -> tuple[TrueView, list[TrueView]]:
        layer = self.layer(frame)
        others = [self.render(f, c, layer) for f, c in self.held_out if f == frame]
        return self.render(frame, self.cameras[frame], layer), others


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def generate(config: SceneConfig, body: BodyModel) -> SyntheticScene:
    """Script a scene; deterministic in its arguments.

    Raises:
        HoigsError: the person cannot reach the object.
    """
    script = MOTIONS[config.object.motion](config).script()
    person = Choreographer(body, config)
    poses = person.perform(script)
    script = script.in_world()
    room, atlas = _furnished(script.stands, config.seed)
    sides = crate_faces(np.random.default_rng(config.seed + 1), 256, config.object.textured)
    sides = [faded(side, config.object.contrast) for side in sides]
    bar = config.object.motion == "bending"
    columns = 1 if not bar else 24 if config.object.bend_share > HINGE else 2
    numbers = [len(atlas.levels) + i for i in range(6)]
    mesh = box(config.object.size, numbers, columns)
    if config.object.round:
        mesh = ball(config.object.size[0] / 2, numbers[0])
    return SyntheticScene(
        config=config,
        poses=poses,
        script=script,
        dressed=dress(body, person.betas, config.cloth_thickness, config.seed + 2),
        object_mesh=mesh,
        shell=room.shell,
        props=room.props,
        atlas=atlas.extended(sides),
        cameras=camera_path(config),
        held_out=held_out_views(config),
    )


@lru_cache(maxsize=4)  # a study makes many clips of one room
def _furnished(stands: tuple[Stand, ...], seed: int) -> tuple[Room, TextureAtlas]:
    palette = Palette()
    room = build_room(palette, stands, seed)
    return room, TextureAtlas.pack(palette.images)


def canonical(scene: SyntheticScene, points: Float[Array, "P 3"], frame: int) -> Array:
    """World points in the object's own frame at a moment (rigid part of its motion)."""
    track = scene.script.track
    return (points - track.translations[frame]) @ track.rotations[frame]


def unproject(view: TrueView, where: Bool[Array, "H W"]) -> tuple[Array, Array]:
    """World points [P, 3] and sRGB [P, 3] of some pixels of a view."""
    grid = view.camera.pixel_grid()[torch.from_numpy(where)]
    points = view.camera.unproject(grid, torch.from_numpy(view.depth[where]))
    return points.double().numpy(), view.image[where] / 255.0

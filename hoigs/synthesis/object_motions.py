"""How the object moves: each class scripts one motion over the time of the clip."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from hoigs.synthesis.config import SceneConfig
from hoigs.synthesis.kinematics import about
from hoigs.synthesis.meshes import TexturedMesh
from hoigs.synthesis.room import Stand
from hoigs.synthesis.walking import Walk, standing, walking

# ObjectScript: the scripted motion of the object, and the bending of its mesh.

Array = np.ndarray


@dataclass(frozen=True)
class Track:
    """A rigid path: object to world."""

    rotations: Float[Array, "F 3 3"]
    translations: Float[Array, "F 3"]


@dataclass(frozen=True)
class ObjectScript:
    """The motion of the object over a clip, and what the person does with it.

    Attributes:
        track: of the object. hold: the path that the hands follow (where the object is, or would
            be, while they hold it).
        grip: 1 where the hands touch, 0 where they are away, smooth between.
        bend: end-to-end angle, radians; 0 for a rigid object. bend_width: length of the part in
            the middle that bends, metres.
        squeeze: width along x as a share of its own; 1 for a rigid object.
        stands: furniture that it stands on.
        walk: of the person. track and hold are in the person's frame until `in_world`.
    """

    track: Track
    hold: Track
    grip: Float[Array, " F"]
    bend: Float[Array, " F"]
    bend_width: float
    squeeze: Float[Array, " F"]
    stands: tuple[Stand, ...]
    walk: Walk

    def in_world(self) -> ObjectScript:
        """The same script with track and hold in world space instead of the person's frame."""
        turn, walk = self.walk.rotations, self.walk
        return replace(
            self,
            track=Track(turn @ self.track.rotations, walk.to_world(self.track.translations)),
            hold=Track(turn @ self.hold.rotations, walk.to_world(self.hold.translations)),
        )


def bend_points(
    points: Float[Array, "*batch 3"], bend: float, width: float
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
    """Bends the middle along x into an arc whose middle line keeps its length; ends stay straight.

    Args:
        bend: angle between the ends, radians. width: length of the part that bends, metres.

    Returns:
        bent points, and the local rotation at each.
    """
    within = np.clip(points[..., 0], -width / 2, width / 2)
    phase = within * (bend / width)
    rotation = about(np.array([0, 1, 0]), phase.ravel()).reshape(*phase.shape, 3, 3)
    x = within * np.sinc(phase / np.pi)
    z = within * np.sinc(phase / (2 * np.pi)) * np.sin(phase / 2) * -1.0
    middle = np.stack((x, np.zeros_like(x), z), -1)
    offset = np.concatenate(((points[..., 0] - within)[..., None], points[..., 1:]), -1)
    return middle + np.einsum("...ij,...j->...i", rotation, offset), rotation


def squeezed(points: Float[Array, "*batch 3"], squeeze: float) -> Float[Array, "*batch 3"]:
    """A share of the width along x, at the same volume."""
    return points * np.array([squeeze, squeeze**-0.5, squeeze**-0.5])


def deformed_mesh(mesh: TexturedMesh, bend: float, width: float, squeeze: float) -> TexturedMesh:
    """`mesh` after `bend_points` and `squeezed`."""
    if squeeze != 1:
        normals = squeezed(mesh.normals, 1 / squeeze)  # inverse transpose, of the same volume
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        mesh = replace(mesh, vertices=squeezed(mesh.vertices, squeeze), normals=normals)
    if bend == 0:
        return mesh
    vertices, rotations = bend_points(mesh.vertices, bend, width)
    turned = np.einsum("fcij,fcj->fci", rotations[mesh.faces], mesh.normals)
    return replace(mesh, vertices=vertices, normals=turned)


GRAVITY = 9.81
STAND_RADIUS = 0.60  # from the person's axis to the middle of what the object stands on, metres
# keys of a carrying walk: u, heading in degrees (0 faces the camera), share of the way
WINDING = np.array(
    [
        [0.00, -8, 0.00],
        [0.08, -4, 0.00],
        [0.30, 90, 0.26],
        [0.50, 172, 0.50],
        [0.62, 168, 0.63],
        [0.90, 55, 1.00],
        [1.00, 50, 1.00],
    ]
)


class ObjectMotion(ABC):
    """Scripts the object over a clip; u in [0, 1] is the time of each frame."""

    def __init__(self, config: SceneConfig):
        self.config, self.object = config, config.object
        self.u = np.linspace(0, 1, config.frames)
        self.rest_height = self.object.stand_height + self.object.size[1] / 2

    @abstractmethod
    def script(self) -> ObjectScript: ...

    def follow(self, keys: Array) -> Array:
        """Monotone cubic through rows (u, yaw, radius, height, pitch, roll), slightly smoothed.

        Sampled finely first, so that the path does not depend on the number of frames.
        """
        fine = np.linspace(0, 1, 1025)
        values = PchipInterpolator(keys[:, 0], keys[:, 1:])(fine)
        values = gaussian_filter1d(values, 14.0, axis=0, mode="nearest")
        return np.stack([np.interp(self.u, fine, v) for v in values.T], -1)

    def path(self, keys: Array) -> Track:
        """Keys in degrees and metres about the person's axis, as poses."""
        yaw, radius, height, pitch, roll = self.follow(keys).T
        yaw, pitch, roll = np.radians(yaw), np.radians(pitch), np.radians(roll)
        turned = about(np.array([0, 1, 0]), yaw)
        rotations = turned @ about(np.array([1, 0, 0]), pitch) @ about(np.array([0, 0, 1]), roll)
        place = np.stack((radius * np.sin(yaw), height, radius * np.cos(yaw)), -1)
        return Track(rotations, place)

    def ramp(self, *points: tuple[float, float]) -> Array:
        """Smooth interpolation of (u, value) pairs."""
        u, value = np.asarray(points, float).T
        return PchipInterpolator(u, value)(self.u)

    def stand(self, yaw_degrees: float, width: float = 0.42) -> Stand:
        yaw = np.radians(yaw_degrees)
        return Stand(
            STAND_RADIUS * np.sin(yaw), STAND_RADIUS * np.cos(yaw), self.object.stand_height,
            width=width, yaw=yaw,
        )  # fmt: skip

    def swing_keys(self, side: float) -> Array:
        """Lift at one side, swing across and back, put down at the other."""
        s, t, low, top = self.object.swing_degrees, self.object.tilt_degrees, self.rest_height, \
            self.object.lift_height  # fmt: skip
        middle = low + 0.80 * (top - low)
        keys = np.array(
            [
                # u,  yaw,      radius,       height,             pitch,    roll
                [0.00, -s, STAND_RADIUS, low, 0, 0],
                [0.11, -s, STAND_RADIUS, low, 0, 0],
                [0.29, -0.6 * s, 0.52, middle, -0.4 * t, -0.5 * t],
                [0.46, 0.75 * s, 0.50, 0.5 * (middle + top), -0.6 * t, t],
                [0.63, -0.45 * s, 0.50, top, -0.9 * t, -0.9 * t],
                [0.76, 0.45 * s, 0.52, 0.65 * middle + 0.35 * low, -0.3 * t, 0.35 * t],
                [0.88, s, STAND_RADIUS, low, 0, 0],
                [1.00, s, STAND_RADIUS, low, 0, 0],
            ]
        )
        keys[:, [1, 5]] *= side
        return keys

    def lift_grip(self) -> Array:
        return self.ramp((0, 0), (0.085, 1), (0.905, 1), (1, 0))

    def scripted(
        self, track: Track, hold: Track, grip: Array, stands: tuple[Stand, ...] = ()
    ) -> ObjectScript:
        """The script of a rigid object and a person who stands."""
        frames = len(self.u)
        return ObjectScript(
            track, hold, grip,
            bend=np.zeros(frames), bend_width=self.object.bend_share * self.object.size[0],
            squeeze=np.ones(frames), stands=stands, walk=standing(frames),
        )  # fmt: skip


class Held(ObjectMotion):
    """Lifted from one stool, swung from side to side, put down on another."""

    def script(self) -> ObjectScript:
        track = self.path(self.swing_keys(1.0))
        s = self.object.swing_degrees
        stands = (self.stand(-s), self.stand(s))
        return self.scripted(track, track, self.lift_grip(), stands)


class Thrown(ObjectMotion):
    """Lifted, thrown up with a turn about x in true free fall, caught and put down."""

    def script(self) -> ObjectScript:
        low, chest = self.rest_height, 0.5 * (self.rest_height + self.object.lift_height)
        flight = 2 * np.sqrt(2 * self.object.throw_height / GRAVITY)
        seconds = (self.config.frames - 1) / self.config.fps
        share = min(0.5, flight / seconds)
        up, down = 0.5 - share / 2, 0.5 + share / 2
        keys = np.array(
            [
                [0.00, 0, STAND_RADIUS, low, 0, 0],
                [0.11, 0, STAND_RADIUS, low, 0, 0],
                [0.5 * (0.11 + up), 0, 0.50, chest - 0.12, 0, 0],
                [up, 0, 0.52, chest, 0, 0],
                [down, 0, 0.52, chest, 0, 0],
                [0.5 * (0.88 + down), 0, 0.50, chest - 0.12, 0, 0],
                [0.88, 0, STAND_RADIUS, low, 0, 0],
                [1.00, 0, STAND_RADIUS, low, 0, 0],
            ]
        )
        hold = self.path(keys)
        r = np.clip((self.u - up) / share, 0, 1)
        rise = 4 * self.object.throw_height * r * (1 - r)
        turned = hold.rotations @ about(
            np.array([1, 0, 0]), -2 * np.pi * self.object.throw_turns * r
        )
        track = Track(turned, hold.translations + rise[:, None] * np.array([0, 1.0, 0]))
        free = self.ramp((0, 1), (up, 1), (0.5 * (up + down), 0.25), (down, 1), (1, 1))
        return self.scripted(track, hold, self.lift_grip() * free, (self.stand(0),))


class Pushed(ObjectMotion):
    """Slid along a table between both hands."""

    def script(self) -> ObjectScript:
        reach, low = 0.55 * self.object.swing_degrees, self.rest_height
        columns = [(0.0, -1), (0.13, -1), (0.42, 0.9), (0.62, -0.5), (0.87, 1), (1.0, 1)]
        # along a straight table edge: radius grows as 1 / cos(yaw)
        keys = np.array(
            [
                [u, reach * k, STAND_RADIUS / np.cos(np.radians(reach * k)), low, 0, 0]
                for u, k in columns
            ]
        )
        track = self.path(keys)
        track.translations[:, 2] = STAND_RADIUS
        # hands and object together, so that the hands predict the object
        if self.object.jolt_metres:
            rng = np.random.default_rng([self.config.seed, 21])
            jolts = self.object.jolt_metres * rng.normal(size=len(self.u))
            track.translations[:, 0] += jolts * self.lift_grip()
        grip = self.lift_grip() * self._regripping()
        return self.scripted(track, track, grip, (self.stand(0, width=1.15),))

    def _regripping(self) -> Array:
        """1, and 0 at evenly spread moments at which both hands are off the object."""
        count = self.object.regrips
        off = [0.15 + 0.7 * (i + 0.5) / count for i in range(count)]
        half = 0.25 * 0.7 / max(1, count)
        points = [(0.0, 1.0), *((u + d, float(d != 0)) for u in off for d in (-half, 0, half))]
        return self.ramp(*points, (1.0, 1.0))


class Bending(ObjectMotion):
    """A bar held at both ends that is lifted and bent to and fro (not rigid)."""

    def script(self) -> ObjectScript:
        keys = self.swing_keys(1.0)
        keys[:, 1] *= 0.6  # both ends of a long bar stay in reach
        held = self.path(keys)
        wave = np.sin(2 * np.pi * 2.0 * np.clip((self.u - 0.16) / 0.64, 0, 1))
        bend = np.radians(self.object.bend_degrees) * wave * self.ramp(
            (0, 0), (0.16, 0), (0.3, 1), (0.66, 1), (0.80, 0), (1, 0)
        )  # fmt: skip
        s = 0.6 * self.object.swing_degrees
        script = self.scripted(held, held, self.lift_grip(), (self.stand(-s), self.stand(s)))
        return replace(script, bend=bend)


class Gliding(ObjectMotion):
    """Held before the chest and moved across at constant speed; two keyframes represent it."""

    def script(self) -> ObjectScript:
        sweep = np.linspace(-1, 1, len(self.u))
        yaw = np.radians(0.4 * self.object.swing_degrees) * sweep
        height = np.full_like(sweep, 0.86 * self.object.lift_height)
        place = np.stack((0.22 * sweep, height + 0.08 * sweep, np.full_like(sweep, 0.5)), -1)
        track = Track(about(np.array([0, 1, 0]), yaw), place)
        if not self.object.alone:
            return self.scripted(track, track, np.ones(len(self.u)))
        middle = len(self.u) // 2
        hold = Track(*(x[middle : middle + 1].repeat(len(x), 0) for x in (
            track.rotations, track.translations)))  # fmt: skip
        return self.scripted(track, hold, np.zeros(len(self.u)))


class Squeezed(ObjectMotion):
    """Soft, held before the chest, squeezed between both hands three times (not rigid)."""

    def script(self) -> ObjectScript:
        height, t = 0.86 * self.object.lift_height, self.object.tilt_degrees
        keys = [[u, 6 * k, 0.48, height + 0.05 * k, 0.2 * t * k, 0] for u, k in
                ((0.0, -1), (0.3, 1), (0.65, -0.5), (1.0, 1))]  # fmt: skip
        held = self.path(np.array(keys))
        squeeze = 1 - self.object.squeeze_share * np.sin(3 * np.pi * self.u) ** 2
        script = self.scripted(held, held, np.ones(len(self.u)))
        return replace(script, squeeze=squeeze)


class FigureEight(ObjectMotion):
    """Held before the chest and moved along a figure eight that lies on its side."""

    def script(self) -> ObjectScript:
        phase = 2 * np.pi * self.object.cycles * self.u
        height = 0.86 * self.object.lift_height + 0.15 * np.sin(2 * phase)
        place = np.stack((0.24 * np.sin(phase), height, np.full_like(phase, 0.5)), -1)
        roll = np.radians(self.object.tilt_degrees) * np.sin(phase)
        track = Track(about(np.array([0, 0, 1]), roll), place)
        return self.scripted(track, track, np.ones(len(self.u)))


class Carried(ObjectMotion):
    """Carried in both hands on a winding walk across the view.

    The person holds the box before the chest, turns away, so that the back hides the box, and turns
    round again.
    """

    def script(self) -> ObjectScript:
        t, height = self.object.tilt_degrees, 0.86 * self.object.lift_height
        held = np.array(
            [
                # u, yaw, radius, height, pitch, roll
                [0.00, 0, 0.47, height, 0, 0],
                [0.12, 0, 0.47, height, 0, 0],
                [0.30, -9, 0.50, height + 0.10, -0.4 * t, 0.5 * t],
                [0.48, 8, 0.47, height + 0.02, 0.1 * t, -0.4 * t],
                [0.66, -8, 0.49, height + 0.14, -0.5 * t, 0.3 * t],
                [0.84, 9, 0.47, height + 0.03, 0, -0.5 * t],
                [1.00, 0, 0.47, height, 0, 0],
            ]
        )
        track = self.path(held)
        script = self.scripted(track, track, np.ones(len(self.u)))
        return replace(script, walk=walking(len(self.u), self._winding(), 1.9, (-0.06, -0.1)))

    def _winding(self) -> Array:
        """WINDING, or the same path with the back turned for a share of the clip."""
        share = self.object.hidden_share
        if share is None:
            return WINDING
        away = 0.55 - share / 2
        back = max(0.55 + share / 2, away + 0.02)  # even a turn without a stop takes time
        keys = WINDING.copy()
        keys[1:6, 0] = (0.25 * away, 0.6 * away, away, back, back + 0.6 * (1 - back))
        return keys


class Static(ObjectMotion):
    """The object stays in place while the person moves the hands towards it."""

    def script(self) -> ObjectScript:
        keys = self.swing_keys(1.0)
        keys[:, 1] = np.minimum(keys[:, 1], -0.35 * self.object.swing_degrees)
        hold = self.path(keys)
        stand = self.stand(self.object.swing_degrees)
        count = len(self.u)
        place = np.array([stand.x, self.rest_height, stand.z])
        rotation = about(np.array([0, 1, 0]), np.full(1, stand.yaw))
        track = Track(np.repeat(rotation, count, 0), np.repeat(place[None], count, 0))
        return self.scripted(track, hold, np.zeros(count), (stand,))


MOTIONS: dict[str, type[ObjectMotion]] = {
    "held": Held, "thrown": Thrown, "pushed": Pushed, "bending": Bending, "static": Static,
    "carried": Carried, "gliding": Gliding, "figure-eight": FigureEight, "squeezed": Squeezed,
}  # fmt: skip

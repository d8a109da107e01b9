"""Cameras: the path of the clip, and the held-out views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hoigs.core.values.camera import Camera
from hoigs.synthesis.config import CameraConfig, SceneConfig

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

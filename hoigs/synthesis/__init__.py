"""Clips with known truth, ray-cast from meshes (never splatted)."""

from __future__ import annotations

from hoigs.synthesis.builtin import builtin_clip, cache_folder, write_scene
from hoigs.synthesis.generate import SyntheticScene, TrueView, generate
from hoigs.synthesis.knobs import CameraKnobs, LightKnobs, NoiseKnobs, ObjectKnobs, SceneKnobs

__all__ = [
    "CameraKnobs",
    "LightKnobs",
    "NoiseKnobs",
    "ObjectKnobs",
    "SceneKnobs",
    "SyntheticScene",
    "TrueView",
    "builtin_clip",
    "cache_folder",
    "generate",
    "write_scene",
]

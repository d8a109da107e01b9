"""Synthetic clips with known ground truth, ray-cast from meshes rather than splatted.

- `builtin.builtin_clip`: the clip folder of a SceneConfig, cached. `named.named_clip`: by name.
- `generate.generate`: the scene itself, whose views are rendered on demand.
- `config.SceneConfig`: all settings.
"""

from __future__ import annotations

from hoigs.synthesis.builtin import builtin_clip, cache_folder, write_scene
from hoigs.synthesis.config import CameraConfig, LightConfig, NoiseConfig, ObjectConfig, SceneConfig
from hoigs.synthesis.generate import SyntheticScene, TrueView, generate

__all__ = [
    "CameraConfig",
    "LightConfig",
    "NoiseConfig",
    "ObjectConfig",
    "SceneConfig",
    "SyntheticScene",
    "TrueView",
    "builtin_clip",
    "cache_folder",
    "generate",
    "write_scene",
]

"""CLIPS: the built-in clips by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hoigs.synthesis.config import SceneConfig

# what each clip sets; the rest is a default of SceneConfig
CLIPS: Mapping[str, Mapping[str, Any]] = {
    "lift-and-swing": {},
    "carry": {
        "frames": 80,
        "object": {"motion": "carried", "size": (0.36, 0.30, 0.26)},
        "camera": {
            "azimuth_degrees": 0.0,
            "arc_degrees": 30.0,
            "distance": 3.7,
            "target": (0.0, 0.88, -0.1),
        },
    },
    "throw-and-catch": {"object": {"motion": "thrown"}},
    "still-box": {"object": {"motion": "static"}},
    "glide": {"object": {"motion": "gliding"}},
    "figure-eight": {"object": {"motion": "figure-eight"}},
    "bending-bar": {"object": {"motion": "bending", "size": (0.70, 0.12, 0.12)}},
    "jolted-push": {"object": {"motion": "pushed", "jolt_metres": 0.03}},
}


def name_of(config: SceneConfig) -> str:
    """The name of the built-in clip whose object moves as in `config`; else that motion's."""
    motions = {
        str(settings.get("object", {}).get("motion", SceneConfig().object.motion)): name
        for name, settings in CLIPS.items()
    }
    return motions.get(config.object.motion, config.object.motion)

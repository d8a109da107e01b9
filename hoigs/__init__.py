"""hoigs: people handling things, from one video, as moving 3D Gaussians.

Importing this package loads neither torch nor warp; names below arrive on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it; resolved lazily so `import hoigs` stays light
_PUBLIC = {
    "BodyModel": "hoigs.core.body",
    "BodyPose": "hoigs.core.moment",
    "Camera": "hoigs.core.camera",
    "Clip": "hoigs.core.clip",
    "Component": "hoigs.core.component",
    "DeformationModel": "hoigs.core.deformation",
    "DensityControl": "hoigs.core.density",
    "Entity": "hoigs.core.entity",
    "FeatureExtractor": "hoigs.core.features",
    "GaussianDelta": "hoigs.core.gaussians",
    "Gaussians": "hoigs.core.gaussians",
    "InteractionModule": "hoigs.core.interaction",
    "Moment": "hoigs.core.moment",
    "Rasterizer": "hoigs.core.rasterizer",
    "RenderOutput": "hoigs.core.rasterizer",
    "RenderRequest": "hoigs.core.rasterizer",
    "Residual": "hoigs.core.interaction",
    "SceneModel": "hoigs.core.scene",
    "Spec": "hoigs.core.spec",
    "Tokens": "hoigs.core.features",
    "TopologyChange": "hoigs.core.topology",
    "compose": "hoigs.core.compose",
    "hookimpl": "hoigs.core.hookspecs",
}

__all__ = ["__version__", *_PUBLIC]  # noqa: PLE0604  (the names are strings)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'hoigs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

"""hoigs: people handling things, from one video, as moving 3D Gaussians.

Importing this package loads neither torch nor warp; names below arrive on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it; resolved lazily so `import hoigs` stays light
_PUBLIC = {
    # values
    "BodyPose": "hoigs.core.moment",
    "Camera": "hoigs.core.camera",
    "Clip": "hoigs.core.clip",
    "GaussianDelta": "hoigs.core.gaussians",
    "Gaussians": "hoigs.core.gaussians",
    "Moment": "hoigs.core.moment",
    "RenderOutput": "hoigs.core.rasterizer",
    "RenderRequest": "hoigs.core.rasterizer",
    "Residual": "hoigs.core.interaction",
    "Tokens": "hoigs.core.features",
    "TopologyChange": "hoigs.core.topology",
    # interfaces
    "BodyModel": "hoigs.core.body",
    "ClipReader": "hoigs.core.reader",
    "DeformationModel": "hoigs.core.deformation",
    "DensityControl": "hoigs.core.density",
    "FeatureExtractor": "hoigs.core.features",
    "InteractionModule": "hoigs.core.interaction",
    "Rasterizer": "hoigs.core.rasterizer",
    # composition
    "Component": "hoigs.core.component",
    "Entity": "hoigs.core.entity",
    "SceneModel": "hoigs.core.scene",
    "Spec": "hoigs.core.spec",
    "compose": "hoigs.core.compose",
    "hookimpl": "hoigs.core.hookspecs",
    # built-in parts
    "AdaptiveDensity": "hoigs.plugins.density.adc",
    "AnnyBody": "hoigs.plugins.bodies.anny",
    "BodyPartFeatures": "hoigs.plugins.features.body_parts",
    "CrossAttention": "hoigs.plugins.interaction.cross_attention",
    "CubicHermite": "hoigs.plugins.deformation.chs",
    "Embedded": "hoigs.plugins.deformation.embedded",
    "EmbeddingFeatures": "hoigs.plugins.features.embedding",
    "GsplatRasterizer": "hoigs.rasterizers.gsplat",
    "HexPlaneField": "hoigs.plugins.deformation.hexplane_field",
    "HexPlaneSkinning": "hoigs.plugins.deformation.hexplane_skinning",
    "MlpDeformation": "hoigs.plugins.deformation.mlp",
    "OracleRasterizer": "hoigs.rasterizers.oracle",
    "Se3Field": "hoigs.plugins.deformation.se3_field",
    "SmplxBody": "hoigs.plugins.bodies.smplx",
    "SplineMotionFeatures": "hoigs.plugins.features.spline_motion",
    "Static": "hoigs.plugins.deformation.static",
    "TorchRasterizer": "hoigs.rasterizers.torch_tiles",
    "TrackedHermite": "hoigs.plugins.deformation.tracked_chs",
    "WarpRasterizer": "hoigs.rasterizers.warp",
    # work
    "Session": "hoigs.training.session",
    "TrainSpec": "hoigs.core.train_spec",
    "Trainer": "hoigs.training.trainer",
    "builtin_clip": "hoigs.synthesis",
    "evaluate": "hoigs.evaluation.evaluate",
    "read_clip": "hoigs.training.session",
}

__all__ = ["__version__", *_PUBLIC]  # noqa: PLE0604  (the names are strings)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'hoigs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

"""hoigs: people handling things, from one video, as moving 3D Gaussians.

Importing this package loads neither torch nor warp; names below arrive on first use.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.2.0"

# public name -> module that defines it; resolved lazily so `import hoigs` stays light
_PUBLIC = {
    # values
    "BodyPose": "hoigs.core.values.moment",
    "Camera": "hoigs.core.values.camera",
    "Clip": "hoigs.core.values.clip",
    "Frame": "hoigs.core.values.clip",
    "GaussianDelta": "hoigs.core.values.gaussians",
    "Gaussians": "hoigs.core.values.gaussians",
    "Moment": "hoigs.core.values.moment",
    "ObjectTrack": "hoigs.core.values.clip",
    "Optics": "hoigs.core.maths.optics",
    "RenderOutput": "hoigs.core.interfaces.rasterizer",
    "RenderRequest": "hoigs.core.interfaces.rasterizer",
    "Residual": "hoigs.core.values.tokens",
    "Tokens": "hoigs.core.values.tokens",
    "TopologyChange": "hoigs.core.values.topology",
    "HoigsError": "hoigs.core.errors",
    "World": "hoigs.core.values.world",
    # interfaces
    "ComponentConfig": "hoigs.core.config",
    "Estimator": "hoigs.core.interfaces.estimator",
    "Exporter": "hoigs.core.model.exporter",
    "ObjectInitializer": "hoigs.core.interfaces.initializer",
    "BodyModel": "hoigs.core.interfaces.body",
    "ClipReader": "hoigs.core.interfaces.reader",
    "Decoder": "hoigs.core.interfaces.decoder",
    "DeformationModel": "hoigs.core.interfaces.deformation",
    "DensityControl": "hoigs.core.interfaces.density",
    "FeatureExtractor": "hoigs.core.interfaces.features",
    "InteractionModule": "hoigs.core.interfaces.interaction",
    "Rasterizer": "hoigs.core.interfaces.rasterizer",
    # composition
    "Component": "hoigs.core.registry.component",
    "Entity": "hoigs.core.model.entity",
    "SceneModel": "hoigs.core.model.scene",
    "Spec": "hoigs.core.spec.schema",
    "compose": "hoigs.core.model.compose",
    "hookimpl": "hoigs.core.registry.component",
    # built-in parts
    "AdaptiveDensity": "hoigs.plugins.density.adc",
    "AnnyBody": "hoigs.plugins.bodies.anny",
    "BodyPartFeatures": "hoigs.plugins.features.body_parts",
    "CrossAttention": "hoigs.plugins.interaction.cross_attention",
    "CubicHermite": "hoigs.plugins.deformation.chs",
    "Embedded": "hoigs.plugins.deformation.zoo.embedded",
    "EmbeddingFeatures": "hoigs.plugins.features.embedding",
    "GsplatRasterizer": "hoigs.rasterizers.gsplat",
    "HexPlaneField": "hoigs.plugins.deformation.zoo.hexplane_field",
    "HexPlaneSkinning": "hoigs.plugins.deformation.hexplane_skinning",
    "MlpDeformation": "hoigs.plugins.deformation.mlp",
    "OracleRasterizer": "hoigs.rasterizers.oracle",
    "Se3Field": "hoigs.plugins.deformation.zoo.se3_field",
    "SmplxBody": "hoigs.plugins.bodies.smpl",
    "SplineMotionFeatures": "hoigs.plugins.features.spline_motion",
    "Static": "hoigs.plugins.deformation.static",
    "TorchRasterizer": "hoigs.rasterizers.torch_tiles",
    "TrackedHermite": "hoigs.plugins.deformation.tracked_chs",
    "WarpRasterizer": "hoigs.rasterizers.warp",
    # work: the commands as functions, then what they are made of
    "annotate": "hoigs.viewing.annotate.server",
    "auto": "hoigs.studies.needs.auto",
    "batch": "hoigs.studies.batch.batch",
    "bug_report": "hoigs.studies.doctor",
    "compress": "hoigs.studies.needs.compress",
    "demo": "hoigs.training.demo",
    "doctor": "hoigs.studies.doctor",
    "evaluate": "hoigs.evaluation.evaluate_run",
    "export": "hoigs.viewing.export",
    "needs": "hoigs.studies.needs.needs",
    "open_run": "hoigs.runs.loaded_run",
    "prepare": "hoigs.preparation.prepare",
    "prepare_until": "hoigs.preparation.prepare",
    "publish": "hoigs.core.system.urls",
    "refine_poses": "hoigs.training.refine_poses",
    "render": "hoigs.viewing.films",
    "train": "hoigs.training.train",
    "view": "hoigs.viewing.view",
    "work": "hoigs.studies.batch.batch",
    "LoadedRun": "hoigs.runs.loaded_run",
    "Playback": "hoigs.viewing.playback",
    "PrepareOptions": "hoigs.preparation.options",
    "TrainOptions": "hoigs.training.options",
    "EvaluateOptions": "hoigs.evaluation.options",
    "ViewOptions": "hoigs.viewing.options",
    "RenderOptions": "hoigs.viewing.options",
    "ExportOptions": "hoigs.viewing.options",
    "StepReport": "hoigs.training.trainer",
    "Session": "hoigs.training.session",
    "TrainSpec": "hoigs.core.spec.train_schema",
    "Trainer": "hoigs.training.trainer",
    "builtin_clip": "hoigs.synthesis",
    "score": "hoigs.evaluation.evaluate",
    "read_clip": "hoigs.runs.clip_source",
}

# public modules, that load with their first use as `hoigs.metrics`
_MODULES = ("gsplat", "metrics")

__all__ = ["__version__", *_MODULES, *_PUBLIC]  # noqa: PLE0604  (the names are strings)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"hoigs.{name}")
    raise AttributeError(f"module 'hoigs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

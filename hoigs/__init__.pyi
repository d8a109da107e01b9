# written by scripts/public_stub.py

from hoigs import gsplat as gsplat
from hoigs import metrics as metrics
from hoigs.core.config import ComponentConfig as ComponentConfig
from hoigs.core.errors import HoigsError as HoigsError
from hoigs.core.interfaces.body import BodyModel as BodyModel
from hoigs.core.interfaces.body import BodyModel as _BodyModel
from hoigs.core.interfaces.body import BodySurface as _BodySurface
from hoigs.core.interfaces.deformation import DeformationModel as DeformationModel
from hoigs.core.interfaces.density import DensityControl as DensityControl
from hoigs.core.interfaces.estimator import Estimator as Estimator
from hoigs.core.interfaces.features import FeatureExtractor as FeatureExtractor
from hoigs.core.interfaces.initializer import ObjectInitializer as ObjectInitializer
from hoigs.core.interfaces.interaction import InteractionModule as InteractionModule
from hoigs.core.interfaces.rasterizer import Rasterizer as Rasterizer
from hoigs.core.interfaces.rasterizer import RenderOutput as RenderOutput
from hoigs.core.interfaces.rasterizer import RenderRequest as RenderRequest
from hoigs.core.interfaces.reader import ClipReader as ClipReader
from hoigs.core.model.compose import compose as compose
from hoigs.core.model.entity import Entity as Entity
from hoigs.core.model.exporter import Exporter as Exporter
from hoigs.core.model.scene import SceneModel as SceneModel
from hoigs.core.registry.component import Component as Component
from hoigs.core.registry.component import hookimpl as hookimpl
from hoigs.core.spec.schema import Spec as Spec
from hoigs.core.spec.train_schema import TrainSpec as TrainSpec
from hoigs.core.system.urls import publish as publish
from hoigs.core.values.camera import Camera as Camera
from hoigs.core.values.clip import Clip as Clip
from hoigs.core.values.clip import Clip as _Clip
from hoigs.core.values.clip import Frame as Frame
from hoigs.core.values.clip import ObjectTrack as ObjectTrack
from hoigs.core.values.clip import ObjectTrack as _ObjectTrack
from hoigs.core.values.gaussians import GaussianDelta as GaussianDelta
from hoigs.core.values.gaussians import Gaussians as Gaussians
from hoigs.core.values.moment import BodyPose as BodyPose
from hoigs.core.values.moment import Moment as Moment
from hoigs.core.values.tokens import Residual as Residual
from hoigs.core.values.tokens import Tokens as Tokens
from hoigs.core.values.topology import TopologyChange as TopologyChange
from hoigs.core.values.world import World as World
from hoigs.evaluation.evaluate import score as score
from hoigs.evaluation.evaluate_run import evaluate as evaluate
from hoigs.plugins.bodies.anny import AnnyBody as AnnyBody
from hoigs.plugins.bodies.smpl import SmplxBody as _SmplxBody
from hoigs.plugins.deformation.chs import CubicHermite as _CubicHermite
from hoigs.plugins.deformation.hexplane_skinning import HexPlaneSkinning as _HexPlaneSkinning
from hoigs.plugins.deformation.keyframes import AdaptiveKnotsConfig as _AdaptiveKnotsConfig
from hoigs.plugins.deformation.mlp import MlpDeformation as _MlpDeformation
from hoigs.plugins.deformation.nonrigid import NonRigidConfig as _NonRigidConfig
from hoigs.plugins.deformation.static import Static as Static
from hoigs.plugins.deformation.tracked_chs import TrackedHermite as _TrackedHermite
from hoigs.plugins.deformation.zoo.embedded import Embedded as _Embedded
from hoigs.plugins.deformation.zoo.hexplane_field import HexPlaneField as _HexPlaneField
from hoigs.plugins.deformation.zoo.se3_field import Se3Field as _Se3Field
from hoigs.plugins.density.adc import AdaptiveDensity as _AdaptiveDensity
from hoigs.plugins.features.body_parts import BodyPartFeatures as BodyPartFeatures
from hoigs.plugins.features.embedding import EmbeddingFeatures as _EmbeddingFeatures
from hoigs.plugins.features.spline_motion import SplineMotionFeatures as _SplineMotionFeatures
from hoigs.plugins.interaction.cross_attention import CrossAttention as _CrossAttention
from hoigs.preparation.options import PrepareOptions as PrepareOptions
from hoigs.preparation.prepare import prepare as prepare
from hoigs.preparation.prepare import prepare_until as prepare_until
from hoigs.rasterizers.gsplat import GsplatRasterizer as GsplatRasterizer
from hoigs.rasterizers.oracle import OracleRasterizer as _OracleRasterizer
from hoigs.rasterizers.torch_tiles import TorchRasterizer as _TorchRasterizer
from hoigs.rasterizers.warp import WarpRasterizer as _WarpRasterizer
from hoigs.runs.clip_source import read_clip as read_clip
from hoigs.runs.loaded_run import LoadedRun as LoadedRun
from hoigs.runs.loaded_run import open_run as open_run
from hoigs.studies.batch.batch import batch as batch
from hoigs.studies.batch.batch import work as work
from hoigs.studies.doctor import bug_report as bug_report
from hoigs.studies.doctor import doctor as doctor
from hoigs.studies.needs.auto import auto as auto
from hoigs.studies.needs.compress import compress as compress
from hoigs.studies.needs.needs import needs as needs
from hoigs.synthesis import builtin_clip as builtin_clip
from hoigs.training.demo import demo as demo
from hoigs.training.refine_poses import refine_poses as refine_poses
from hoigs.training.session import Session as Session
from hoigs.training.train import train as train
from hoigs.training.trainer import StepReport as StepReport
from hoigs.training.trainer import Trainer as Trainer
from hoigs.viewing.annotate.server import annotate as annotate
from hoigs.viewing.export import export as export
from hoigs.viewing.films import render as render
from hoigs.viewing.playback import Playback as Playback
from hoigs.viewing.view import view as view
from pathlib import Path as _Path
from torch import Tensor
from typing import Any, Literal

__version__: str

class AdaptiveDensity(_AdaptiveDensity):
    def __init__(
        self,
        config: Any = ...,
        *,
        start: float = ...,
        stop: float = ...,
        interval: int = ...,
        threshold: float = ...,
        cap: int | str = ...,
        keep: int = ...,
        clone_scale: float = ...,
        prune_opacity: float = ...,
        prune_scale: float | None = ...,
        prune_radius: float | None = ...,
        reset_every: int | None = ...,
        reset_opacity: float = ...,
        seed: int = ...,
        clip: _Clip | None = ...,
    ) -> None: ...

class CrossAttention(_CrossAttention):
    def __init__(
        self,
        config: Any = ...,
        *,
        gate: Literal['soft', 'hard', 'none'] = ...,
        granularity: Literal['object', 'gaussian', 'part'] = ...,
        reach_from: Literal['nearest', 'pelvis'] = ...,
        reach: float = ...,
        softness: float = ...,
        width: int = ...,
        values: Literal['gated', 'swapped'] = ...,
        pose_head: Literal['flat', 'per-part'] = ...,
        object_residual: Literal['per-gaussian', 'rigid', 'both'] = ...,
        hidden: int = ...,
        pose_bound: float = ...,
        means_bound: float = ...,
        places: Literal['none', 'hands'] = ...,
    ) -> None: ...

class CubicHermite(_CubicHermite):
    def __init__(
        self,
        config: Any = ...,
        *,
        keyframes: int | Literal['adaptive'] | None = ...,
        keyframe_step: int = ...,
        tangents: Literal['learned', 'finite-difference'] = ...,
        light: bool = ...,
        adaptive: _AdaptiveKnotsConfig = ...,
        opacity: Literal['keyed', 'constant', 'auto'] = ...,
        num_frames: int | None = ...,
        track: _ObjectTrack | None = ...,
        cameras: Any = ...,
    ) -> None: ...

class Embedded(_Embedded):
    def __init__(
        self,
        config: Any = ...,
        *,
        embedding: int = ...,
        table: int = ...,
        rows: int | None = ...,
        coarse_rows: int | None = ...,
        fine_until: float = ...,
        width: int = ...,
        depth: int = ...,
        heads: Any = ...,
        table_spread: float = ...,
        anneal: float = ...,
        turning: Literal['composed', 'added'] = ...,
        neighbours: int = ...,
        table_smoothness: Literal['neighbours', 'last-row'] = ...,
        num_frames: int | None = ...,
    ) -> None: ...

class EmbeddingFeatures(_EmbeddingFeatures):
    def __init__(
        self,
        config: Any = ...,
        *,
        tokens: int | None = ...,
        width: int = ...,
        keyframes: int | None = ...,
    ) -> None: ...

class HexPlaneField(_HexPlaneField):
    def __init__(
        self,
        config: Any = ...,
        *,
        channels: int = ...,
        resolution: int = ...,
        time_resolution: int | None = ...,
        multires: Any = ...,
        width: int = ...,
        depth: int = ...,
        heads: Any = ...,
        time_span: Literal['whole', 'half'] = ...,
        turning: Literal['composed', 'added'] = ...,
        start: float = ...,
        num_frames: int | None = ...,
    ) -> None: ...

class HexPlaneSkinning(_HexPlaneSkinning):
    def __init__(
        self,
        config: Any = ...,
        *,
        refine_poses: bool | Literal['auto'] = ...,
        light: bool = ...,
        fusion: Literal['paired', 'product'] = ...,
        resolution: int = ...,
        channels: int = ...,
        time_resolution: int | None = ...,
        box: float = ...,
        width: int = ...,
        head: Literal['full', 'exavatar'] = ...,
        free_attributes: bool | Literal['all'] = ...,
        scale_about: Literal['pelvis', 'camera'] = ...,
        alpha_start: Literal['one', 'depth'] = ...,
        field_points: int = ...,
        field_at: Literal['posed', 'canonical'] = ...,
        residual_rule: Literal['add', 'compose'] = ...,
        nonrigid: bool | Literal['auto', 'shading'] = ...,
        nonrigid_motion: _NonRigidConfig = ...,
        laplacian: Literal['points', 'mesh'] = ...,
        laplacian_of: Any = ...,
        body: _BodyModel,
        entity: str = ...,
        betas: Tensor | None = ...,
        surface: _BodySurface | None = ...,
        seed: int = ...,
        num_frames: int | None = ...,
        trained_frames: Any | None = ...,
        camera_centers: Tensor | None = ...,
        frame_times: Any | None = ...,
    ) -> None: ...

class MlpDeformation(_MlpDeformation):
    def __init__(
        self,
        config: Any = ...,
        *,
        width: int = ...,
        depth: int = ...,
        position_frequencies: int = ...,
        time_frequencies: int = ...,
        space: Literal['raw', 'activated'] = ...,
        turning: Literal['composed', 'added'] = ...,
        zero_heads: bool = ...,
        start: float = ...,
        time_noise: float = ...,
        noise_until: float = ...,
        num_frames: int | None = ...,
        track: _ObjectTrack | None = ...,
    ) -> None: ...

class OracleRasterizer(_OracleRasterizer):
    def __init__(
        self,
        config: Any = ...,
        *,
        cutoffs: bool = ...,
    ) -> None: ...

class Se3Field(_Se3Field):
    def __init__(
        self,
        config: Any = ...,
        *,
        code: int = ...,
        width: int = ...,
        depth: int = ...,
        skip: int = ...,
        frequencies: int = ...,
        window_until: float = ...,
        ambient: int = ...,
        ambient_width: int = ...,
        ambient_depth: int = ...,
        elastic_points: int = ...,
        times: Any,
    ) -> None: ...

class SmplxBody(_SmplxBody):
    def __init__(
        self,
        config: Any = ...,
        *,
        path: _Path,
        num_betas: int = ...,
        template: Tensor | None = ...,
    ) -> None: ...

class SplineMotionFeatures(_SplineMotionFeatures):
    def __init__(
        self,
        config: Any = ...,
        *,
        width: int = ...,
        embedding: Literal['per-gaussian', 'shared', 'low-rank', 'none'] = ...,
        interpolation: Literal['catmull-rom', 'zero-tangent', 'linear'] = ...,
        velocity: Literal['derivative', 'keyframes'] = ...,
        embedding_width: int = ...,
        rank: int = ...,
        hidden: int = ...,
        keyframes: int | None = ...,
    ) -> None: ...

class TorchRasterizer(_TorchRasterizer):
    def __init__(
        self,
        config: Any = ...,
        *,
        tile_size: int = ...,
    ) -> None: ...

class TrackedHermite(_TrackedHermite):
    def __init__(
        self,
        config: Any = ...,
        *,
        keyframes: int | Literal['adaptive'] | None = ...,
        keyframe_step: int = ...,
        tangents: Literal['learned', 'finite-difference'] = ...,
        light: bool = ...,
        adaptive: _AdaptiveKnotsConfig = ...,
        opacity: Literal['keyed', 'constant', 'auto'] = ...,
        num_frames: int | None = ...,
        track: _ObjectTrack | None = ...,
        cameras: Any = ...,
    ) -> None: ...

class WarpRasterizer(_WarpRasterizer):
    def __init__(
        self,
        config: Any = ...,
        *,
        cpu_kernels: Literal['auto', 'native', 'portable'] = ...,
        scheduler: Literal['threads', 'openmp', 'auto', 'serial'] = ...,
        threads: int | None = ...,
    ) -> None: ...

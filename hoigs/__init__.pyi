# written by scripts/public_stub.py

from collections.abc import Sequence
from hoigs import gsplat as gsplat
from hoigs import metrics as metrics
from hoigs.core.config import ComponentConfig as ComponentConfig
from hoigs.core.errors import HoigsError as HoigsError
from hoigs.core.interfaces.body import BodyModel as BodyModel
from hoigs.core.interfaces.body import BodyModel as _BodyModel
from hoigs.core.interfaces.body import BodySurface as _BodySurface
from hoigs.core.interfaces.decoder import Decoder as Decoder
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
from hoigs.core.maths.optics import Optics as Optics
from hoigs.core.model.compose import compose as compose
from hoigs.core.model.entity import Entity as Entity
from hoigs.core.model.exporter import Exported as _Exported
from hoigs.core.model.exporter import Exporter as Exporter
from hoigs.core.model.scene import SceneModel as SceneModel
from hoigs.core.model.scene import SceneModel as _SceneModel
from hoigs.core.registry.component import Component as Component
from hoigs.core.registry.component import hookimpl as hookimpl
from hoigs.core.spec.schema import ComponentSpec as _ComponentSpec
from hoigs.core.spec.schema import Spec as Spec
from hoigs.core.spec.schema import Spec as _Spec
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
from hoigs.evaluation.evaluate_run import EvaluatedRun as _EvaluatedRun
from hoigs.evaluation.options import EvaluateOptions as EvaluateOptions
from hoigs.evaluation.options import EvaluateOptions as _EvaluateOptions
from hoigs.evaluation.options import ScoreOptions as _ScoreOptions
from hoigs.evaluation.scores import Evaluation as _Evaluation
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
from hoigs.preparation.options import PrepareOptions as _PrepareOptions
from hoigs.preparation.report.report import PrepareReport as _PrepareReport
from hoigs.rasterizers.gsplat import GsplatRasterizer as GsplatRasterizer
from hoigs.rasterizers.oracle import OracleRasterizer as _OracleRasterizer
from hoigs.rasterizers.torch_tiles import TorchRasterizer as _TorchRasterizer
from hoigs.rasterizers.warp import WarpRasterizer as _WarpRasterizer
from hoigs.runs.clip_source import read_clip as read_clip
from hoigs.runs.loaded_run import LoadedRun as LoadedRun
from hoigs.runs.loaded_run import open_run as open_run
from hoigs.studies.batch.batch import Batch as _Batch
from hoigs.studies.doctor import bug_report as bug_report
from hoigs.studies.doctor import doctor as doctor
from hoigs.studies.needs.auto import AutoRun as _AutoRun
from hoigs.studies.needs.compress import compress as compress
from hoigs.studies.needs.options import NeedsOptions as _NeedsOptions
from hoigs.studies.needs.result import Needs as _Needs
from hoigs.studies.options import BatchOptions as _BatchOptions
from hoigs.studies.options import WorkOptions as _WorkOptions
from hoigs.synthesis import builtin_clip as builtin_clip
from hoigs.training.options import DemoOptions as _DemoOptions
from hoigs.training.options import RefineOptions as _RefineOptions
from hoigs.training.options import TrainOptions as TrainOptions
from hoigs.training.options import TrainOptions as _TrainOptions
from hoigs.training.refine_poses import RefinedPoses as _RefinedPoses
from hoigs.training.session import Session as Session
from hoigs.training.train import TrainedRun as _TrainedRun
from hoigs.training.trainer import StepReport as StepReport
from hoigs.training.trainer import Trainer as Trainer
from hoigs.viewing.annotate.server import annotate as annotate
from hoigs.viewing.films import Film as _Film
from hoigs.viewing.options import ExportOptions as ExportOptions
from hoigs.viewing.options import ExportOptions as _ExportOptions
from hoigs.viewing.options import RenderOptions as RenderOptions
from hoigs.viewing.options import RenderOptions as _RenderOptions
from hoigs.viewing.options import ViewOptions as ViewOptions
from hoigs.viewing.options import ViewOptions as _ViewOptions
from hoigs.viewing.playback import Playback as Playback
from hoigs.viewing.player.page import Page as _Page
from pathlib import Path as _Path
from torch import Tensor
from typing import Any as _Any
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
        heads: Sequence[Literal['means', 'scales', 'rotations', 'opacity', 'sh']] = ...,
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
        multires: Sequence[int] = ...,
        width: int = ...,
        depth: int = ...,
        heads: Sequence[Literal['means', 'scales', 'rotations', 'opacity', 'sh']] = ...,
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
        shading: _NonRigidConfig | None = ...,
        laplacian: Literal['points', 'mesh'] = ...,
        laplacian_of: Sequence[Literal['offset', 'scale', 'color']] = ...,
        body: _BodyModel,
        entity: str = ...,
        betas: Tensor | None = ...,
        surface: _BodySurface | None = ...,
        seed: int = ...,
        num_frames: int | None = ...,
        trained_frames: Any | None = ...,
        camera_centers: Tensor | None = ...,
        frame_times: Sequence[float] | None = ...,
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

def auto(
    clip: _Path | str | None,
    spec: str | _Path | _Spec | None = ...,
    *,
    out: _Path | str | None = ...,
    resume: bool = ...,
    allow_faults: bool = ...,
    reader: str | None = ...,
    reader_settings: Sequence[str] = ...,
    budget: str | float | None = ...,
    chunk: int | None = ...,
    evaluate: bool = ...,
    view: bool = ...,
    port: int = ...,
    lpips_weights: _Path | str | None = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    overrides: Sequence[str] = ...,
    overwrite: bool = ...,
    smallest: bool = ...,
    on_found: Any | None = ...,
    on_start: Any | None = ...,
    on_step: Any | None = ...,
    progress: Any | None = ...,
    report: Any = ...,
    options: _TrainOptions | None = ...,
) -> _AutoRun: ...

def batch(
    manifest: _Path | str,
    out: _Path | str,
    *,
    spec: str | None = ...,
    auto: bool = ...,
    overrides: Sequence[str] = ...,
    export: Sequence[str] = ...,
    device: str | None = ...,
    limit: int | None = ...,
    only: str | None = ...,
    dry_run: bool = ...,
    jobs: int = ...,
    threads: int | None = ...,
    executor: str | _Any = ...,
    address: str | None = ...,
    retries: int = ...,
    report: Any = ...,
    tick: Any = ...,
    options: _BatchOptions | None = ...,
) -> _Batch: ...

def demo(
    *,
    out: _Path | str = ...,
    fast: bool = ...,
    steps: int | None = ...,
    baseline: bool | None = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    overrides: Sequence[str] = ...,
    overwrite: bool = ...,
    on_start: Any | None = ...,
    on_step: Any | None = ...,
    progress: Any | None = ...,
    report: Any = ...,
    options: _DemoOptions | None = ...,
) -> dict[str, _TrainedRun]: ...

def evaluate(
    run: _Path | str,
    *,
    lpips_weights: _Path | str | None = ...,
    test_pose: str | None = ...,
    test_camera: str | None = ...,
    fit_steps: int | None = ...,
    report: bool = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    clip: str | _Path | None = ...,
    progress: Any | None = ...,
    options: _EvaluateOptions | None = ...,
) -> _EvaluatedRun: ...

def export(
    run: _Path | str,
    *,
    format: str,
    out: _Path | str | None = ...,
    entities: Sequence[str] = ...,
    overrides: Sequence[str] = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    clip: str | _Path | None = ...,
    start: float | None = ...,
    end: float | None = ...,
    fps: float | None = ...,
    slow: float = ...,
    progress: Any | None = ...,
    options: _ExportOptions | None = ...,
) -> _Exported: ...

def needs(
    clip: _Path | str,
    spec: str | _Path = ...,
    *,
    out: _Path | str | None = ...,
    least: float = ...,
    share: float = ...,
    smallest: bool = ...,
    search_spaces: _Path | str | None = ...,
    allow_faults: bool = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    overrides: Sequence[str] = ...,
    overwrite: bool = ...,
    report: Any = ...,
    options: _NeedsOptions | None = ...,
) -> _Needs: ...

def prepare(
    source: str | _Path,
    out: str | _Path,
    *,
    object: Sequence[str] = ...,
    person: Sequence[str] = ...,
    preset: Literal['auto', 'offline', 'hub', 'files'] = ...,
    yes: bool = ...,
    width: int | None = ...,
    camera: Literal['auto', 'static', 'turning', 'moving', 'sfm'] = ...,
    max_frames: int | None = ...,
    every: int = ...,
    fps: float | None = ...,
    start: str | float | None = ...,
    end: str | float | None = ...,
    focal: float | None = ...,
    intrinsics: Sequence[float] | None = ...,
    calibration: str | None = ...,
    keep_borders: bool = ...,
    person_height: float | None = ...,
    chunk: int | None = ...,
    overlap: int | None = ...,
    keep_black: bool = ...,
    overwrite: bool = ...,
    overrides: Sequence[str] = ...,
    file: _Path | None = ...,
    allow_commands: bool = ...,
    redo: Sequence[str] = ...,
    body: str = ...,
    estimators: dict[Literal['masks', 'landmarks', 'depth', 'object'], _ComponentSpec] = ...,
    consent: Any | None = ...,
    announce: Any | None = ...,
    progress: Any | None = ...,
    options: _PrepareOptions | None = ...,
) -> _PrepareReport: ...

def prepare_until(
    stage: str,
    source: str | _Path,
    out: str | _Path,
    *,
    object: Sequence[str] = ...,
    person: Sequence[str] = ...,
    preset: Literal['auto', 'offline', 'hub', 'files'] = ...,
    yes: bool = ...,
    width: int | None = ...,
    camera: Literal['auto', 'static', 'turning', 'moving', 'sfm'] = ...,
    max_frames: int | None = ...,
    every: int = ...,
    fps: float | None = ...,
    start: str | float | None = ...,
    end: str | float | None = ...,
    focal: float | None = ...,
    intrinsics: Sequence[float] | None = ...,
    calibration: str | None = ...,
    keep_borders: bool = ...,
    person_height: float | None = ...,
    chunk: int | None = ...,
    overlap: int | None = ...,
    keep_black: bool = ...,
    overwrite: bool = ...,
    overrides: Sequence[str] = ...,
    file: _Path | None = ...,
    allow_commands: bool = ...,
    redo: Sequence[str] = ...,
    body: str = ...,
    estimators: dict[Literal['masks', 'landmarks', 'depth', 'object'], _ComponentSpec] = ...,
    consent: Any | None = ...,
    announce: Any | None = ...,
    progress: Any | None = ...,
    options: _PrepareOptions | None = ...,
) -> dict[str, float]: ...

def refine_poses(
    clip: _Path | str,
    out: _Path | str,
    *,
    steps: int | None = ...,
    width: int = ...,
    overrides: Sequence[str] = ...,
    device: str = ...,
    overwrite: bool = ...,
    progress: Any = ...,
    options: _RefineOptions | None = ...,
) -> _RefinedPoses: ...

def render(
    run: _Path | str,
    *,
    out: _Path | str | None = ...,
    path: str = ...,
    entities: Sequence[str] = ...,
    compare: bool = ...,
    background: str | None = ...,
    width: int | None = ...,
    height: int | None = ...,
    at: float | None = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    clip: str | _Path | None = ...,
    start: float | None = ...,
    end: float | None = ...,
    fps: float | None = ...,
    slow: float = ...,
    progress: Any | None = ...,
    options: _RenderOptions | None = ...,
) -> _Film: ...

def train(
    clip: _Path | str | None = ...,
    spec: str | _Path | _Spec | None = ...,
    *,
    out: _Path | str | None = ...,
    resume: bool = ...,
    allow_faults: bool = ...,
    reader: str | None = ...,
    reader_settings: Sequence[str] = ...,
    budget: str | float | None = ...,
    chunk: int | None = ...,
    evaluate: bool = ...,
    view: bool = ...,
    port: int = ...,
    lpips_weights: _Path | str | None = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    overrides: Sequence[str] = ...,
    overwrite: bool = ...,
    on_start: Any | None = ...,
    on_step: Any | None = ...,
    progress: Any | None = ...,
    report: Any = ...,
    options: _TrainOptions | None = ...,
) -> _TrainedRun: ...

def view(
    what: _Path | str,
    second: _Path | str | None = ...,
    *,
    host: str = ...,
    port: int = ...,
    html: _Path | str | None = ...,
    max_mb: float | None = ...,
    entities: Sequence[str] = ...,
    width: int = ...,
    rasterizer: str | None = ...,
    device: str = ...,
    plugins: Sequence[_Path | str] = ...,
    clip: str | _Path | None = ...,
    report: Any = ...,
    progress: Any | None = ...,
    started: Any | None = ...,
    options: _ViewOptions | None = ...,
) -> _Page | None: ...

def work(
    out: _Path | str,
    *,
    retries: int = ...,
    jobs: int = ...,
    threads: int | None = ...,
    executor: str | _Any = ...,
    address: str | None = ...,
    report: Any = ...,
    tick: Any = ...,
    options: _WorkOptions | None = ...,
) -> _Batch: ...

def score(
    model: _SceneModel,
    clip: _Clip,
    *,
    split: str = ...,
    lpips_weights: _Path | str | None = ...,
    held_out: bool = ...,
    test_pose: Literal['auto', 'given', 'interpolated', 'blended', 'fitted'] = ...,
    test_camera: Literal['given', 'interpolated', 'fitted'] = ...,
    fit_steps: int = ...,
    pixels: Literal['float', '8-bit'] = ...,
    band: int | None = ...,
    timing_frames: int = ...,
    timing_warmup: int = ...,
    timing_budget_s: float = ...,
    device: str | None = ...,
    progress: Any | None = ...,
    options: _ScoreOptions | None = ...,
) -> _Evaluation: ...

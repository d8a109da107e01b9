"""TrainSpec: how a model is optimised. No torch here: a spec is checked without it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from hoigs.core.errors import did_you_mean

Graphs = Literal["auto", "on", "off"]
TestCamera = Literal["given", "interpolated", "fitted"]
TestPose = Literal["given", "interpolated", "blended", "fitted"]
TestPoseSetting = Literal["auto", "given", "interpolated", "blended", "fitted"]


class _Strict(BaseModel):
    model_config = ConfigDict(
        extra="forbid",
        validate_assignment=True,
        use_attribute_docstrings=True,
        allow_inf_nan=False,
    )


class WarmupSpec(_Strict):
    """When parts of the model start to train, as fractions of all steps; HOIGS publishes no
    schedule."""

    motion: float = Field(default=0.1, ge=0, le=1)
    """The object follows its initial track before this; then its keyframes are free."""
    interaction: float = Field(default=0.2, ge=0, le=1)
    """The interaction module is off before this."""
    poses: float = Field(default=0.1, ge=0, le=1)
    """Body poses stay as given before this, when they are optimised at all."""
    cameras: float = Field(default=0.1, ge=0, le=1)
    """Cameras stay as given before this, when they are optimised (`train.rates.camera`)."""


class LossSpec(_Strict):
    """The joint objective (paper Sec. "Optimization"; supplement "Objective Function Details")."""

    weights: Literal["supp", "main"] = "main"
    """"main" = all ones (the main text); "supp" = 0.5 human + 1.0 object + 0.25 scene + 1.0 depth
    (the supplement). On the built-in clip "main" scores higher in every region, because the scene's
    gradients then reach density control at full strength."""
    human: float | None = Field(default=None, ge=0)
    """Weight of this term in place of the preset's."""
    object: float | None = Field(default=None, ge=0)
    """Weight of this term in place of the preset's."""
    scene: float | None = Field(default=None, ge=0)
    """Weight of this term in place of the preset's."""
    depth: float | None = Field(default=None, ge=0)
    """Weight of this term in place of the preset's."""
    lambda_dssim: float = Field(default=0.2, ge=0, le=1)
    """(1 - l) L1 + l (1 - SSIM) in every image term. The supplement and 3DGS have l = 0.2; the main
    text's plain sum L1 + D-SSIM is l = 0.5 at twice the term's weight."""
    ssim: Literal["warp", "torch"] = "warp"
    """"warp" computes SSIM with kernels, in float32 on a CPU or on CUDA; "torch" with convolutions,
    many times slower on a CPU, for what the kernels do not take."""
    human_image: Literal["alone", "composite", "both"] = "alone"
    """What is compared with the video on the crop of a human's mask. "alone" is the human over a
    plain colour, which trains the outline; "composite" is the whole scene's render in that box (the
    paper's "cropped human region"); "both" is ExAvatar's sum."""
    lpips: float = Field(default=0.0, ge=0)
    """Weight of LPIPS in the human's image terms; above 0 it needs weights on disk. The paper sums
    L1, D-SSIM and LPIPS unweighted while following ExAvatar, which has 0.8, 0.2 and 0.2."""
    lpips_net: Literal["alex", "vgg"] | None = None
    """"vgg" (ExAvatar) or "alex"; None takes the first that is found on disk."""
    face: float = Field(default=0.0, ge=0)
    """Weight of L_face, the textured face mesh against the video (hoigs/training/face.py).
    """
    depth_fit: Literal["auto", "scale", "affine"] = "auto"
    """How L_depth aligns the depth prior with the render. "auto" takes metric depth as it is, or by
    one factor for all frames where it disagrees with the scene points by more than 7 % (which
    the run reports), and fits scale and shift to relative disparity; "scale" fits one factor
    for each frame to either ("scaled via COLMAP points", which cannot correct a shift), "affine"
    both."""
    scene_loss: Literal["full", "masked", "both", "background"] = "full"
    """"full" compares the composite with the whole image (the supplement's formula), "masked" draws
    the scene alone and leaves out the dilated masks (its text), "both". "background" also leaves
    out people and objects that are in the clip and not in the model."""
    background: Literal["random", "black"] = "random"
    """Colour behind masked terms. "random" is drawn anew at each step."""
    dilate: int = Field(default=3, ge=0, le=64)
    """Pixels by which masks grow before they cut a hole into the scene term."""
    regularizers: dict[str, float] = Field(default_factory=dict)
    """Weight by name of the penalties that components offer, over their defaults; and of
    "residual_pose" and "residual_means", the mean squared corrections by the interaction, which
    keyframes and poses could explain as well; off by default. "camera" is of the squared
    corrections of cameras, 0.1 where these are learned."""


class RatesSpec(_Strict):
    """Adam's learning rates at the start; those in `by_extent` are multiplied by the extent.

    Sources: 3DGS (Kerbl 2023) for the Gaussian fields, ExAvatar (Moon 2024) for networks and
    poses, 4DGS (Wu 2024) for planes, E-D3DGS (Bae 2024) for embeddings; HOIGS gives none. Those
    of sh, planes and networks are 2 to 6 times the published ones and those of means 15 times,
    because runs here take thousands of steps, not tens of thousands: means 8e-4, sh 1e-2, planes
    1e-2, networks 2e-3 gain 0.7 dB (full frame) and 0.4 dB (human and object) over the published
    in 1500 steps on the built-in clip; means 2.4e-3 up to 0.1 dB on real clips and cost no more
    than that on the built-in one (docs/results).
    `*_final` rates are reached log-linearly at the last step.
    """

    means: float = Field(default=2.4e-3, ge=0)
    means_final: float = Field(default=2.4e-5, ge=0)
    means_steps: int | None = Field(default=None, ge=1)
    """Steps over which Gaussians may travel as far as these two rates bring them: in a longer
    training both are lower by as much as it is longer. 2000 are 3DGS's rates at its 30,000 steps.
    None: the rates are the same at any length."""
    sh: float = Field(default=1e-2, ge=0)
    sh_rest: float = Field(default=1.0, ge=0, le=1)
    """Rate of the harmonics above the first, as a share of `sh` (3DGS: 1/20)."""
    opacity: float = Field(default=0.05, ge=0)
    scale: float = Field(default=5e-3, ge=0)
    rotation: float = Field(default=1e-3, ge=0)
    planes: float = Field(default=1e-2, ge=0)
    planes_final: float = Field(default=5e-4, ge=0)
    networks: float = Field(default=2e-3, ge=0)
    networks_final: float = Field(default=2e-4, ge=0)
    keyframes: float = Field(default=1e-3, ge=0)  # metres a step, of positions and tangents
    keyframes_final: float = Field(default=1e-5, ge=0)
    keyframe_rotation: float = Field(default=1e-3, ge=0)
    embedding: float = Field(default=2.5e-3, ge=0)
    pose: float = Field(default=1e-4, ge=0)
    """Of corrections of given poses, radians and metres: a body's where the human's deformation
    refines them, an object's where it is about its track."""
    pose_final: float = Field(default=1e-4, ge=0)
    shape: float = Field(default=1e-4, ge=0)
    camera: float = Field(default=0.0, ge=0)
    """Of each frame's correction of its camera, radians and scene extents a step; 0 takes cameras
    as they are (docs/reference/refinement.md)."""
    settle: float = Field(default=1.0, gt=0, le=1)
    """Share of the rates without a `*_final` that is left at the last step, reached log-linearly
    over the last fifth of the run."""
    by_extent: tuple[str, ...] = ("means",)
    """Rates in units of the entity's extent (3DGS: means; 4DGS: planes and networks too)."""
    by_entity: dict[str, dict[str, Annotated[float, Field(ge=0)]]] = Field(default_factory=dict)
    """Rates of some entities that differ from these, by exact entity name or by kind; the name
    wins: `{scene: {scale: 0.02}}`."""

    @field_validator("by_extent")
    @classmethod
    def _are_rates(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        rates = [name for name, field in cls.model_fields.items() if field.annotation is float]
        for name in names:
            if name not in rates:
                raise ValueError(f'no rate "{name}"{did_you_mean(name, rates)}')
        return names

    @field_validator("by_entity")
    @classmethod
    def _change_rates(cls, changes: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
        for rates in changes.values():
            cls._are_rates(tuple(rates))
        return changes

    def of(self, entity: str, kind: str) -> RatesSpec:
        """The rates of an entity of that kind."""
        own = {**self.by_entity.get(kind, {}), **self.by_entity.get(entity, {})}
        return self.model_copy(update=own) if own else self


def rate_names() -> list[str]:
    """The rates that a component may declare for its parameters (`DeformationModel.rates`)."""
    shares = ("sh_rest", "settle")
    names = [n for n, field in RatesSpec.model_fields.items() if field.annotation is float]
    return [n for n in names if n not in shares and not n.endswith("_final")]


class TrainSpec(_Strict):
    """One training run."""

    steps: int = Field(default=2000, ge=1)
    """Optimizer steps, one frame each."""
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    """Seed of every random draw."""
    passes: int | None = Field(default=None, ge=1)
    """Passes over the training frames after which people, objects and the interaction are done:
    their schedules end there, and the rest of a longer training changes the scene alone. More
    passes fit them to the views of these few frames, and other views of them lose (docs/results).
    None: they are trained to the end."""
    width: int | None = Field(default=None, ge=16)
    """Train and score at this image width, at most: frames are never enlarged. None is the clip's
    own."""
    chunk: int | None = Field(default=None, ge=2)
    """Frames of a window, for long clips: of parameters that grow with the clip, the rows of one
    window are in memory, with their gradients and moments (hoigs/training/time_windows.py). Each
    step copies a window's rows: few frames cost less. None trains all at once."""
    sh_interval: int | None = Field(default=None, ge=1)
    """Steps after which one more degree of harmonics is trained (3DGS: 1000); None trains all from
    the start."""
    fill_unseen: tuple[Annotated[float, Field(gt=0, le=1)], ...] = ()
    """Shares of the steps after which sides of people and objects that no training frame shows take
    their colour, and people their shape too, from what lies beside them, and so does the scene that
    they hide (hoigs/training/unseen); with 1.0 the colours are filled again at the end. Empty: they
    stay as they are."""
    unseen_sides: Literal["neighbours", "opposite"] = "neighbours"
    """Where these colours come from. "neighbours" continues what was seen beside them, and on the
    other half of the body, which leaves no pattern; "opposite" also takes the pattern of the other
    side of the same part of the body: of the front for the back, but not for the head."""
    warmup: WarmupSpec = WarmupSpec()
    loss: LossSpec = LossSpec()
    rates: RatesSpec = RatesSpec()
    checkpoint_every: int = Field(default=1000, ge=1)
    """Steps between checkpoints; the last step always writes one."""
    keep_checkpoints: int | None = Field(default=2, ge=1)
    """How many of the newest checkpoints are kept, so that there is another one if the newest is
    damaged; null keeps all."""
    log_every: int = Field(default=25, ge=1)
    """Steps between lines of the log; the last step always writes one."""
    preview_every: int = Field(default=250, ge=0)
    """Steps between scores of a few test frames, for the curve in the report; 0 never scores."""
    graphs: Graphs = "auto"
    """Whether steps are captured as CUDA graphs; values and gradients differ by rounding. "auto"
    captures them on CUDA where every component allows it, and continues without, with a warning,
    where that fails; "on" raises there; "off" captures none. A CPU has no graphs."""


class EvaluationSpec(_Strict):
    """How a run is scored."""

    test_pose: TestPoseSetting = "auto"
    """Body poses of test frames. "auto" is "blended" where the clip's poses were estimated
    from its frames (`hoigs prepare`), and "given" elsewhere. "given" are the clip's, moved by the
    corrections that neighbouring training frames learned; "interpolated" are these neighbours'
    poses, as if the clip had none for test frames; "blended" lie between both, at the share of
    the way that draws training frames best when each is posed so; "fitted" are optimised on the
    test images that are scored. Stored with every score (docs/reference/refinement.md)."""
    test_camera: TestCamera = "given"
    """Cameras of test frames: "given" by the clip, "interpolated" or "fitted"."""
    fit_steps: int = Field(default=40, ge=1)
    """Optimization steps of "fitted" for each frame."""
    held_out: bool = True
    """Also score cameras that were never trained on, where the clip has them."""

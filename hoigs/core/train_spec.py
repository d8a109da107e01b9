"""TrainSpec: how a model is optimised. No torch here: a spec is checked without it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from hoigs.core.errors import did_you_mean

Graphs = Literal["auto", "on", "off"]
TestPose = Literal["given", "interpolated", "fitted"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", validate_assignment=True)


class WarmupSpec(_Strict):
    """When parts join in, as fractions of all steps (the paper gives no order: methods A.10).

    Attributes:
        motion: the object follows its initial track before this; then its keyframes are free.
        interaction: the interaction module is off before this (methods A.7: 10-20 %).
        poses: body poses stay as given before this, when they are optimised at all.
        cameras: cameras likewise (`train.rates.camera`).
    """

    motion: float = Field(0.1, ge=0, le=1)
    interaction: float = Field(0.2, ge=0, le=1)
    poses: float = Field(0.1, ge=0, le=1)
    cameras: float = Field(0.1, ge=0, le=1)


class LossSpec(_Strict):
    """The joint objective (paper Sec. "Optimization"; supplement "Objective Function Details").

    Attributes:
        weights: "main" = all ones (the main text); "supp" = 0.5 human + 1.0 object + 0.25 scene +
            1.0 depth (the supplement). On the built-in clip "main" scores higher in every region,
            because the scene's gradients then reach density control at full strength.
        human, object, scene, depth: override one weight of the preset.
        lambda_dssim: (1 - l) L1 + l (1 - SSIM) in every image term. The supplement and 3DGS have
            l = 0.2; the main text's plain sum L1 + D-SSIM is l = 0.5 at twice the term's weight.
        ssim: "warp" computes SSIM with kernels, in float32 on a CPU or on CUDA; "torch" with
            convolutions, many times slower on a CPU, for what the kernels do not take.
        human_image: what of the human is compared on the crop of its mask. "alone" draws it over a
            colour in place of all else, which teaches the outline; "composite" is the whole scene's
            render in that box (the paper's "cropped human region"); "both" is ExAvatar's sum.
        lpips: weight of LPIPS in those terms; above 0 it needs weights on disk. The paper sums L1,
            D-SSIM and LPIPS unweighted while following ExAvatar, which has 0.8, 0.2 and 0.2.
        lpips_net: "vgg" (ExAvatar) or "alex"; None takes what is found.
        face: weight of L_face, the textured face mesh against the video (hoigs/training/face.py).
        depth_fit: how the depth prior meets the render in L_depth. "auto" takes metric depth as it
            stands, or by one factor for all frames where it disagrees with the scene points by more
            than 7 % (which the run reports), and fits scale and shift to relative disparity;
            "scale" fits one factor a frame to either ("scaled via COLMAP points", which cannot mend
            a shift), "affine" both.
        scene_loss: "full" compares the composite with the whole image (the supplement's formula),
            "masked" draws the scene alone and leaves out the dilated masks (its text), "both".
            "background" also leaves out people and things that are in the clip and not in the
            model.
        background: colour behind masked terms. "random" is drawn anew at each step.
        dilate: pixels by which masks grow before they cut a hole into the scene term.
        regularizers: weight by name of the penalties that components offer, over their defaults;
            and of "residual_pose" and "residual_means", the mean squared corrections by the
            interaction, which m, tau and theta could explain as well (methods A.7); off by default.
            "camera" is of the squared corrections of cameras, 0.1 where these are learned.
    """

    weights: Literal["supp", "main"] = "main"
    human: float | None = Field(None, ge=0)
    object: float | None = Field(None, ge=0)
    scene: float | None = Field(None, ge=0)
    depth: float | None = Field(None, ge=0)
    lambda_dssim: float = Field(0.2, ge=0, le=1)
    ssim: Literal["warp", "torch"] = "warp"
    human_image: Literal["alone", "composite", "both"] = "alone"
    lpips: float = Field(0.0, ge=0)
    lpips_net: Literal["alex", "vgg"] | None = None
    face: float = Field(0.0, ge=0)
    depth_fit: Literal["auto", "scale", "affine"] = "auto"
    scene_loss: Literal["full", "masked", "both", "background"] = "full"
    background: Literal["random", "black"] = "random"
    dilate: int = Field(3, ge=0, le=64)
    regularizers: dict[str, float] = Field(default_factory=dict)


class RatesSpec(_Strict):
    """Adam's learning rates at the start; those in `by_extent` are multiplied by the extent.

    Sources: 3DGS (Kerbl 2023) for the Gaussian fields, ExAvatar (Moon 2024) for networks and
    poses, 4DGS (Wu 2024) for planes, E-D3DGS (Bae 2024) for embeddings; methods A.10, D.4. Those
    of sh, planes and networks are 2 to 6 times the published ones and those of means 15 times,
    because runs here take thousands of steps, not tens of thousands: means 8e-4, sh 1e-2, planes
    1e-2, networks 2e-3 gain 0.7 dB (full frame) and 0.4 dB (human and object) over the published
    in 1500 steps on the built-in clip; means 2.4e-3 as much as 0.1 dB on real clips and lose no
    more on that one (docs/results/README.md).
    `*_final` rates are reached log-linearly at the last step.

    Attributes:
        by_extent: rates in units of the entity's extent (3DGS: means; 4DGS: planes and networks
            too). sh_rest: rate of the harmonics above the first, as a share of `sh` (3DGS: 1/20).
        camera: of each frame's correction of its camera, radians and scene extents a step; 0 takes
            cameras as they are (docs/reference/refinement.md). pose: of corrections of given poses,
            radians and metres: a body's where the human's deformation refines them, an object's
            where it is about its track. settle: share of the rates without a `*_final` that is left
            at the last step, reached log-linearly over the last fifth of the run.
    """

    means: float = Field(2.4e-3, ge=0)
    means_final: float = Field(2.4e-5, ge=0)
    sh: float = Field(1e-2, ge=0)
    sh_rest: float = Field(1.0, ge=0, le=1)
    opacity: float = Field(0.05, ge=0)
    scale: float = Field(5e-3, ge=0)
    rotation: float = Field(1e-3, ge=0)
    planes: float = Field(1e-2, ge=0)
    planes_final: float = Field(5e-4, ge=0)
    networks: float = Field(2e-3, ge=0)
    networks_final: float = Field(2e-4, ge=0)
    keyframes: float = Field(1e-3, ge=0)  # metres a step, of positions and tangents
    keyframes_final: float = Field(1e-5, ge=0)
    keyframe_rotation: float = Field(1e-3, ge=0)
    embedding: float = Field(2.5e-3, ge=0)
    pose: float = Field(1e-4, ge=0)
    pose_final: float = Field(1e-4, ge=0)
    shape: float = Field(1e-4, ge=0)
    camera: float = Field(0.0, ge=0)
    settle: float = Field(1.0, gt=0, le=1)
    by_extent: tuple[str, ...] = ("means",)

    @field_validator("by_extent")
    @classmethod
    def _are_rates(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        rates = [name for name, field in cls.model_fields.items() if field.annotation is float]
        for name in names:
            if name not in rates:
                raise ValueError(f'no rate "{name}"{did_you_mean(name, rates)}')
        return names


class TrainSpec(_Strict):
    """One training run.

    Attributes:
        steps: optimizer steps, one frame each.
        seed: of everything random.
        width: train and score at this image width, at most: frames are never enlarged. None is
            the clip's own.
        sh_interval: steps after which one more degree of harmonics is trained (3DGS: 1000); None
            trains all from the start.
        checkpoint_every, log_every, preview_every: steps; the last step always writes both.
            preview_every scores a few test frames for the curve in the report (0 = never).
        graphs: replay the model's part of a step, forward and backward, as CUDA graphs: the same
            values and gradients but for rounding, without what Python costs. "auto" does on CUDA
            where every component allows it, and goes on without, with a warning, where that fails;
            "on" insists; "off" never does, nor does anything on a CPU.
    """

    steps: int = Field(2000, ge=1)
    seed: int = Field(0, ge=0)
    width: int | None = Field(None, ge=16)
    sh_interval: int | None = Field(None, ge=1)
    warmup: WarmupSpec = WarmupSpec()
    loss: LossSpec = LossSpec()
    rates: RatesSpec = RatesSpec()
    checkpoint_every: int = Field(1000, ge=1)
    log_every: int = Field(25, ge=1)
    preview_every: int = Field(250, ge=0)
    graphs: Graphs = "auto"


class EvaluationSpec(_Strict):
    """How a run is judged.

    Attributes:
        test_pose: body poses of test frames. "given" are the clip's, moved by the corrections that
            neighbouring training frames learned; "interpolated" are these neighbours' poses, as if
            the clip had none for test frames; "fitted" are optimised on the test images that are
            scored. Recorded with every score (methods A.9; docs/reference/refinement.md).
        test_camera: cameras of test frames, likewise.
        fit_steps: of "fitted", a frame.
        held_out: also score cameras that were never trained on, where the clip has them.
    """

    test_pose: TestPose = "given"
    test_camera: TestPose = "given"
    fit_steps: int = Field(40, ge=1)
    held_out: bool = True

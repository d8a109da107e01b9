"""score: scores of a model on a clip, each with its protocol or the reason why it is absent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime

import torch
from torch import Tensor

from hoigs.core.errors import did_you_mean
from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.scene import SceneModel
from hoigs.core.options import verb
from hoigs.core.parameters import PIECE, release_time_rows
from hoigs.core.reporting import Progress, default_progress
from hoigs.core.system.threads import short_waits_when_busy
from hoigs.core.values.clip import CAMERAS_REFINED, Clip, Frame
from hoigs.core.values.tokens import EntityKind
from hoigs.evaluation.geometry import measure_geometry
from hoigs.evaluation.measure import device_name, model_size, render_time
from hoigs.evaluation.options import ScoreOptions
from hoigs.evaluation.posing import own_share, posed_clip, source_of_poses
from hoigs.evaluation.protocol import NotComputed, Protocol, Value
from hoigs.evaluation.scores import METRICS, Evaluation, FrameScores, ViewScores
from hoigs.metrics.lpips import Lpips, find_weights
from hoigs.metrics.psnr import region_psnr
from hoigs.metrics.regions import default_band, region_masks
from hoigs.metrics.ssim import ssim_map

TIMING_SHARE, FITTING_SHARE = 0.3, 0.5  # of the progress bar


@verb(ScoreOptions)
@short_waits_when_busy()
def score(
    model: SceneModel, clip: Clip, *, options: ScoreOptions, progress: Progress | None = None
) -> Evaluation:
    """Score a model on a split of a clip and on its held-out cameras, and measure it.

    Args:
        progress: called with the share that is done, in [0, 1], and the present work.

    Raises:
        ValueError: the clip has no such split. In one without frames nothing is scored, and every
            score gives that as its reason.
        HoigsError: `lpips_weights` names no file, or a damaged one.
    """
    split = options.split
    if split not in clip.split:
        known = list(clip.split)
        raise ValueError(f"clip has no split {split!r}: {known}{did_you_mean(split, known)}")
    if options.device is not None:
        model.to(options.device)
    found = find_weights(options.lpips_weights)
    lpips: Lpips | NotComputed = NotComputed(found.reason)
    if found.location is not None:
        lpips = Lpips.load(found).to(model.device)
    report = progress or default_progress()
    was_training = model.training
    model.eval()
    trained = {clip.moments[p].index for p in clip.split.get("train", ())}

    # body poses and cameras of the scored frames
    poses, cameras = source_of_poses(clip, options.test_pose), options.test_camera
    begun = FITTING_SHARE if {"blended", "fitted"} & {poses, cameras} else 0.0

    def posing(done: float, text: str) -> None:
        report(FITTING_SHARE * done, text)

    share = own_share(model, clip, split, posing) if poses == "blended" else None
    clip = posed_clip(model, clip, options, share=share, progress=posing)

    # every frame of the split, and of the held-out cameras
    chosen = [("test frames" if split == "test" else f"{split} frames", clip, split)]
    if options.held_out and clip.held_out is not None and len(clip.held_out):
        chosen.append(("held-out cameras", clip.held_out, "test"))
    work = max(1, sum(len(source.split[name]) for _, source, name in chosen))
    views, done = [], 0
    for title, source, name in chosen:
        protocol = replace(
            _protocol(model, source, title, name, trained, options, lpips),
            test_pose=poses,
            test_camera=cameras if source is clip else "given",
            fit_steps=options.fit_steps if "fitted" in (poses, cameras) else 0,
            own_share=share,
        )
        frames = []
        for position in source.split[name]:
            frames.append(score_frame(model, source[position], source, protocol, lpips))
            done += 1
            if done % PIECE == 0:
                release_time_rows(model)
            report(begun + (1 - TIMING_SHARE - begun) * done / work, title)
        views.append(ViewScores(title, protocol, frames))

    report(1 - TIMING_SHARE, "geometry")
    geometry = measure_geometry(model, clip, clip.split[split])
    report(1 - TIMING_SHARE, "render time")
    timed = list(clip.split[split]) or list(range(len(clip)))
    timing = NotComputed("timing_frames is 0") if options.timing_frames == 0 else render_time(
        model, clip, timed, frames=options.timing_frames, warmup=options.timing_warmup,
        budget_s=options.timing_budget_s,
    )  # fmt: skip
    report(1.0, "")
    model.train(was_training)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return Evaluation(clip.name, views, timing, model_size(model), created, geometry, clip)


def _protocol(
    model: SceneModel,
    clip: Clip,
    title: str,
    split: str,
    trained: set[int],
    options: ScoreOptions,
    lpips: Lpips | NotComputed,
) -> Protocol:
    """The conditions of a view's scores, with given poses and cameras."""
    positions = clip.split[split]
    camera = clip.cameras[positions[0] if positions else 0]
    first = camera.world_to_camera
    ignored = (clip.store.ignored(p) for p in positions)
    share = sum(float(m.float().mean()) for m in ignored if m is not None) / max(1, len(positions))
    fixed = all(torch.equal(c.world_to_camera, first) for c in clip.cameras)
    views = title if title == "held-out cameras" else "training cameras"
    return Protocol(
        views="the one fixed training camera" if fixed and views != title else views,
        split=split,
        frames=len(positions),
        unseen_times=sum(clip.moments[p].index not in trained for p in positions),
        region="full",
        band=default_band(camera.width, camera.height) if options.band is None else options.band,
        test_pose="given",
        object_poses="given" if set(clip.objects) & set(model.entities) else "",
        pixels=options.pixels,
        width=camera.width,
        height=camera.height,
        lpips_net=None if isinstance(lpips, NotComputed) else lpips.net,
        lpips_weights="" if isinstance(lpips, NotComputed) else lpips.source,
        device=device_name(model.device),
        rasterizer=type(model.rasterizer).__name__,
        cameras_refined=bool(clip.provenance.get(CAMERAS_REFINED)),
        ignored=share,
    )


@torch.no_grad()
def score_frame(
    model: SceneModel, frame: Frame, clip: Clip, protocol: Protocol, lpips: Lpips | NotComputed
) -> FrameScores:
    """Render one frame and score every region of it."""
    device = model.device
    output = model.render(frame.moment.to(device), frame.camera.to(device))
    target = frame.rgb.to(device)
    color = output.color.clamp(0, 1)
    if protocol.pixels == "8-bit":
        color = (color * 255).round() / 255
    if frame.ignored is not None:  # SSIM and LPIPS windows see the target in these pixels
        color = torch.where(frame.ignored.to(device)[..., None], target, color)
    regions = region_masks(frame, clip.kinds, protocol.band)
    if not torch.isfinite(color).all():
        broken = dict.fromkeys(METRICS, NotComputed("the render is not finite"))
        return FrameScores(frame.position, frame.moment.index, dict.fromkeys(regions, broken))
    similarity = ssim_map(color, target).mean(-1)
    perceptual = lpips if isinstance(lpips, NotComputed) else lpips.map(color, target)
    depth = _depth_error(output, frame, clip)
    values: dict[str, Mapping[str, Value]] = {}
    for region, mask in regions.items():
        mask = mask.to(device)
        if not mask.any():
            reason = _absence(region, clip.kinds)
            if frame.unknown and region != "full":
                reason = f"no mask of {', '.join(sorted(frame.unknown))}"
            values[region] = dict.fromkeys(METRICS, NotComputed(reason))
            continue
        values[region] = {
            "psnr": float(region_psnr(color, target, mask)),
            "ssim": float(similarity[mask].mean()),
            "lpips": perceptual
            if isinstance(perceptual, NotComputed)
            else float(perceptual[mask].mean()),
            "depth": _mean_depth(depth, mask),
        }
    if not isinstance(lpips, NotComputed) and frame.ignored is None:
        # whole images: LPIPS as published, which averages each layer before upsampling
        values["full"] = {**values["full"], "lpips": float(lpips(color, target))}
    return FrameScores(frame.position, frame.moment.index, values)


def _depth_error(
    output: RenderOutput, frame: Frame, clip: Clip
) -> tuple[Tensor, Tensor] | NotComputed:
    """|rendered - true| depth at each pixel, metres, and the pixels where both are known."""
    if clip.depth_kind != "metric" or frame.depth is None:
        return NotComputed(f"the clip's depth is {clip.depth_kind!r}, not metric")
    truth = frame.depth.to(output.depth)
    return (output.expected_depth - truth).abs(), (truth > 0) & (output.alpha > 0.5)


def _mean_depth(errors: tuple[Tensor, Tensor] | NotComputed, mask: Tensor) -> Value:
    if isinstance(errors, NotComputed):
        return errors
    error, known = errors
    if not (known & mask).any():
        return NotComputed("no pixel of the region has both true and rendered depth")
    mean = float(error[known & mask].mean())
    return mean if math.isfinite(mean) else NotComputed("the rendered depth is not finite")


def _absence(region: str, kinds: Mapping[str, EntityKind]) -> str:
    present = set(kinds.values())
    needed = {"human": {"human"}, "object": {"object"}, "interaction": {"human", "object"}}
    missing = needed.get(region, set()) - present
    if missing:
        return f"the clip has no {' and no '.join(sorted(missing))}"
    return "human and object are not close" if region == "interaction" else "no visible pixels"

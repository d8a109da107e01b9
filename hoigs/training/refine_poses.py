"""refine_poses: the body poses of a clip, corrected by drawing all its frames."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clip_folder.check import require_clip
from hoigs.core.clip_folder.format import HEADER, is_clip_folder
from hoigs.core.clip_folder.write import refuse_to_overwrite, replace_folder, save_body
from hoigs.core.errors import ClipError, SpecError
from hoigs.core.interfaces.body import BodyModel
from hoigs.core.maths.skinning import transform_points
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.options import verb
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.spec.schema import Spec
from hoigs.core.system.files import write_whole
from hoigs.core.system.random_state import callers_random_state
from hoigs.core.system.threads import short_waits_when_busy
from hoigs.core.values.clip import POSES_EXACT, BodyTrack, Clip
from hoigs.core.values.moment import POSE, BodyPose
from hoigs.plugins.deformation.skinned_body import SkinnedBody
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import clip_folder, read_clip, require_folder
from hoigs.training.options import RefineOptions
from hoigs.training.trainer import Trainer

VISITS = 12.5  # of each frame
LEAST, MOST = 800, 2000  # steps
# people alone: objects and the scene change their poses by nothing that was measured, and cost half
# of the time; clothes that move would explain what poses should; and three times the rate of a
# training's refinement
SETTINGS = (
    "entities=[human]",
    "interaction.use=interaction:none",
    "train.loss.human_image=alone",
    "model.human.deformation.nonrigid=false",
    "model.human.deformation.refine_poses=true",
    "train.rates.pose=1e-3",
    "train.rates.pose_final=1e-4",
    "train.fill_unseen=[]",
    "train.preview_every=0",
)

SMOOTHED = (0.0, 0.05, 0.1, 0.2, 0.4)  # seconds
BODY_JOINTS = 22  # without hands, jaw and eyes


@dataclass(frozen=True)
class RefinedPoses:
    """What was done.

    Attributes:
        path: the clip folder with the refined poses. steps: of the training.
        moved: by person, the mean distance by which joints moved, metres.
    """

    path: Path
    steps: int
    moved: Mapping[str, float]

    def __str__(self) -> str:
        by = ", ".join(f"{name} {1000 * far:.1f} mm" for name, far in self.moved.items())
        return f"joints moved by {by} (mean) in {self.steps} steps over all frames"


@verb(RefineOptions)
@short_waits_when_busy()
@callers_random_state()
def refine_poses(
    clip: Path | str,
    out: Path | str,
    *,
    options: RefineOptions,
    progress: Progress = no_progress,
) -> RefinedPoses:
    """Correct the estimated body poses of a clip by a short training on all its frames.

    Landmarks and masks leave errors of about a pixel in every frame, which differ from frame to
    frame. One model of the person, whose looks all frames share, is drawn in each, and pose and
    translation of every frame and one shape follow the gradients of the image terms (as ExAvatar,
    Moon et al. 2024, refines those of training frames). Training does that too, but only on
    training frames, and there clothes that move take up a part of what poses should explain.

    The poses of test frames then owe something to the images of test frames, as landmarks do;
    the clip's provenance says so.

    Args:
        clip: a clip folder, whose poses were estimated.
        out: folder of the refined clip: a copy, whose images are hard links where the file system
            has them; or the clip's own folder, with `overwrite`.
        progress: called with the share done, in [0, 1], and the work.

    Raises:
        ClipError: nobody in the clip has poses with errors, or `out` is there already.
        SpecError: `overrides` are wrong, or name a deformation that refines no poses.
    """
    registry = default_registry()
    folder, out = clip_folder(clip), Path(out)
    require_folder(folder)
    if not is_clip_folder(folder):
        raise ClipError(
            f"{folder} has no {HEADER}: refined poses are written as a copy of a clip folder, "
            "which `hoigs prepare` makes"
        )
    if out.exists() and not options.overwrite:
        raise ClipError(f"{out} is there already; --overwrite (overwrite=True) replaces it")
    refuse_to_overwrite(out)
    require_clip(folder)
    source = read_clip(folder, registry, options.width)
    if not source.bodies or source.provenance.get(POSES_EXACT) is True:
        why = "nobody is in it" if not source.bodies else "it declares its poses to be exact"
        raise ClipError(f"{folder} has no body poses to refine: {why}")
    steps = options.steps or round(min(max(VISITS * len(source), LEAST), MOST))
    people = _trained(source, steps, options, registry, progress)
    tracks = {name: _refined(person, source, name, steps) for name, person in people.items()}
    moved = {
        name: float((_joints(track, body) - _joints(source.bodies[name], body)).norm(dim=-1).mean())
        for name, track in tracks.items()
        for body in [people[name].body]
    }
    _write(folder, out, tracks)
    return RefinedPoses(out, steps, moved)


def _trained(
    clip: Clip,
    steps: int,
    options: RefineOptions,
    registry: Registry,
    progress: Progress,
) -> dict[str, SkinnedBody]:
    """The deformation of every person of the clip, on the CPU, trained on all its frames."""
    settings = [*SETTINGS, f"train.steps={steps}", *options.overrides]
    spec = Spec.load("hoigs", overrides=settings, registry=registry)
    every = replace(clip, split={"train": list(range(len(clip))), "test": []}, held_out=None)
    torch.manual_seed(spec.train.seed)
    model = compose(spec, every, registry).to(pick_device(options.device))
    people = {name: model.entity(name).deformation for name in clip.bodies}
    for name, person in people.items():
        if not isinstance(person, SkinnedBody) or person.refinement is None:
            raise SpecError(
                f"the deformation of {name} refines no poses; take one that has refine_poses, as "
                "deformation:hexplane-skinning, and set that to true"
            )
    density = compose_density(spec, every, registry)
    trainer = Trainer(model, every, spec.train, density=density)
    trainer.train(lambda report: progress(report.step / steps, "refining poses"))
    model.eval().to("cpu")
    return {name: person for name, person in people.items() if isinstance(person, SkinnedBody)}


@torch.no_grad()
def _refined(person: SkinnedBody, clip: Clip, name: str, steps: int) -> BodyTrack:
    """A person's track with the poses, and the betas of all frames, that were learned.

    Images show an error of each frame's own, and put another in its place. Where there was none to
    show, poses would tremble: changes are smoothed over time by as little as keeps them from it.
    """
    track = clip.bodies[name]
    poses = {moment.index: person.pose(moment) for moment in clip.moments}
    frames = sorted(poses)  # not all of the track's are in the clip
    betas = poses[frames[0]].betas
    changes = {
        field: torch.stack([getattr(poses[i], field) for i in frames])
        - getattr(track.poses, field)[frames]
        for field in POSE
    }
    most = _trembling(track, person.body)
    refined, width = track, 0.0
    for width in SMOOTHED:
        refined = replace(track, poses=_changed(track.poses, changes, frames, width * clip.fps))
        refined = replace(refined, poses=refined.poses.replace(betas=betas))
        if _trembling(refined, person.body) <= most:
            break
    text = f"{track.provenance}; refined on the images of all frames, test frames among them"
    text += f", with changes that are smoothed over {width:g} s" if width else ""
    return replace(refined, provenance=f"{text} ({steps} steps)")


def _changed(
    poses: BodyPose, changes: Mapping[str, Tensor], frames: Sequence[int], width: float
) -> BodyPose:
    """Poses with changes of some frames, smoothed by a normal distribution `width` frames wide."""
    from scipy import ndimage  # on use: it takes a while to import

    fields: dict[str, Any] = {}
    for field, change in changes.items():
        fields[field] = getattr(poses, field).clone()
        own = change.numpy()
        smoothed = ndimage.gaussian_filter1d(own, width, axis=0, mode="nearest") if width else own
        fields[field][frames] += torch.from_numpy(smoothed)
    return poses.replace(**fields)


def _trembling(track: BodyTrack, body: BodyModel) -> float:
    """Median second difference of the body's joints, metres: that of what moves is not in it."""
    at = _joints(track, body)[:, :BODY_JOINTS]
    if len(at) < 3:
        return 0.0
    return float((at[2:] - 2 * at[1:-1] + at[:-2]).norm(dim=-1).median())


@torch.no_grad()
def _joints(track: BodyTrack, body: BodyModel) -> Float[Tensor, "F J 3"]:
    """World."""
    _, joints = body.shaped(track.poses.betas)
    return transform_points(body.skinning_transforms(track.poses), joints)


def _write(folder: Path, out: Path, tracks: Mapping[str, BodyTrack]) -> None:
    """`folder` with other body tracks, as `out`, which appears when it is whole."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.absolute().parent) as parent:
        made = Path(parent) / out.name
        shutil.copytree(folder, made, copy_function=_linked)
        for name, track in tracks.items():
            path = made / "bodies" / f"{name}.npz"
            path.unlink()  # a link to the other clip's file
            save_body(path, track)
        header = json.loads((made / HEADER).read_text())
        provenance = header.setdefault("provenance", {})
        for k, (name, track) in enumerate(tracks.items()):
            provenance[f"body {name}" if k else "body"] = track.provenance
        (made / HEADER).unlink()
        write_whole(made / HEADER, json.dumps(header, indent=2) + "\n")
        require_clip(made)
        replace_folder(made, out)


def _linked(source: str, target: str) -> None:
    """A hard link, or a copy where there are none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)

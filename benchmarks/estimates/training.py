"""Short trainings on prepared clips, their scores, and pictures of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import Image

REGIONS = ("human_object", "object", "full")


@dataclass(frozen=True)
class Training:
    """How to train. pictures: a folder for pictures of the runs."""

    steps: int
    width: int
    device: str = "cpu"
    seed: int = 0
    pictures: Path | None = None


def trained(clip: Path, run: Path, how: Training, truth: Any = None) -> dict[str, Any]:
    """PSNR by region of test frames and held-out cameras, with the body poses of test frames as the
    clip has them ("given"), interpolated from training frames, and blended from both.

    Args:
        truth: a clip of the same frames whose pixels and masks are scored in place of the clip's.
    """
    from hoigs.evaluation.evaluate import score
    from hoigs.training.session import Session

    session = Session.open(
        clip, "hoigs", out=run, overwrite=True, device=how.device,
        overrides=[
            f"train.steps={how.steps}", f"train.width={how.width}",
            "train.preview_every=0", f"train.seed={how.seed}",
        ],
    )  # fmt: skip
    start = time.perf_counter()
    session.train()
    seconds = time.perf_counter() - start
    found: dict[str, Any] = {"train_s": round(seconds, 1)}
    if how.pictures:
        draw_views(session, how.pictures / f"{run.name.removesuffix('.run')}.png")
    scored = session.clip
    if truth is not None:
        pixels = truth.resized(scored.cameras[0].width).store
        scored = replace(scored, store=pixels, kinds=truth.kinds)
    for poses in ("given", "interpolated", "blended"):
        scores = score(session.trainer.model, scored, timing_frames=0, test_pose=poses)
        found[f"{poses} poses"] = {
            view.name: {r: _value(scores.score(r, "psnr", view.name)) for r in REGIONS}
            for view in scores.views
        }
    return found


def draw_views(session: Any, file: Path) -> None:
    """Three test frames and three held-out views: the image above, the drawn one below."""
    import torch

    clip, model = session.clip, session.trainer.model.eval()
    chosen = [(clip, p) for p in clip.split["test"]]
    if clip.held_out is not None:
        chosen += [(clip.held_out, p) for p in clip.held_out.split["test"]]
    columns = []
    for views in (chosen[: len(clip.split["test"])], chosen[len(clip.split["test"]) :]):
        for source, position in views[:: max(1, len(views) // 3)][:3]:
            frame = source[position]
            with torch.no_grad():
                drawn = model.render(
                    frame.moment.to(model.device), frame.camera.to(model.device)
                ).color.clamp(0, 1)
            columns.append(torch.cat((frame.rgb.cpu(), drawn.cpu())))
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * torch.cat(columns, 1)).byte().numpy()).save(file)


def _value(score: Any) -> float | str:
    return round(float(score), 2) if isinstance(score, float) else f"not computed: {score}"

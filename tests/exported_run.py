"""A run to export and to film: a built-in clip at 64 pixels, trained for a few steps."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

TINY = (
    "builtin:lift-and-swing?frames=12&width=64&height=64&fps=3&edge_samples=4&held_out_views=3"
    "&test_frames=3&scene_points=2000&object_points=300"
)


@cache
def tiny_run() -> Path:
    """The folder of the run; made once a test session."""
    from hoigs.training.session import Session

    out = Path(mkdtemp(prefix="hoigs-run-")) / "run"
    small = [
        "model.human.points=1500",
        "train.steps=4",
        "train.preview_every=0",
        "train.log_every=1",
    ]
    Session.open(TINY, "hoigs", out=out, overrides=small).train()
    return out

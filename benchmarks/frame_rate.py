"""Frames a second of a hoigs model, all included: deformation, raster and both, three ways.

    python benchmarks/frame_rate.py --json frame-rate.json
    python benchmarks/frame_rate.py --run runs/mine
    python benchmarks/frame_rate.py --device cpu --size 64x36 --splats 800 300 100 --sweep 5

A sweep draws the clip from its first to its last time, between frames too, each frame with another
camera; its inputs start on the host, as an application has them. Sweeps of the ways are
interleaved, so that whatever else the machine does falls on all alike: compare within one run only.

    plain    SceneModel.render, a moment and a camera of numbers
    cached   Playback without a graph: what does not depend on time computed once
    graph    Playback as it is on CUDA: two graphs a frame
    film     Playback.film: on CUDA several frames at once (no halves to time)

`deform_ms` and `raster_ms` are medians over frames by CUDA events (on a CPU by the clock), which
also count the time that a device waits for launches; `frame_ms` is the wall time of a sweep without
any waiting in between over its frames, the median over rounds, and `fps` is from that.
`first_frame_ms` is from the call to the finished image, one frame at a time.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.at_size import (
    Size,
    add_size,
    clip_name,
    clock,
    machine,
    middle,
    spec_overrides,
    write,
)
from hoigs.core.errors import RenderError
from hoigs.core.model.scene import SceneModel
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.viewing.playback import Playback

View = tuple[Moment, Camera]
KEPT = 8  # views from which a playback is made


@dataclass
class Way:
    """One way to draw, in two halves, and what it took."""

    deform: Callable[[Moment, Camera], Any]
    draw: Callable[[Any, Camera], Any]
    play: Playback | None = None
    film_frames: list[float] = field(default_factory=list)
    splits: list[tuple[float, float]] = field(default_factory=list)
    frames: list[float] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)


def between(low: View, high: View, r: float) -> View:
    """A view between two of a clip: bodies, camera and time all move on."""
    first, second = low[0], high[0]
    poses = {}
    for name, pose in first.poses.items():
        other = second.poses[name]
        parts = {
            f: torch.lerp(getattr(pose, f), getattr(other, f), r)
            for f in ("global_orient", "body", "left_hand", "right_hand", "transl")
        }
        poses[name] = replace(pose, **parts)
        assert isinstance(poses[name], BodyPose)
    time = first.time + r * (second.time - first.time)
    a, b = low[1].world_to_camera, high[1].world_to_camera
    turn, _, across = torch.linalg.svd(torch.lerp(a[:3, :3], b[:3, :3], r))
    view = a.clone()
    view[:3, :3] = turn @ across
    view[:3, 3] = torch.lerp(a[:3, 3], b[:3, 3], r)
    return Moment(time, first.index, poses), replace(low[1], world_to_camera=view)


def film(clip: Clip, size: Size, frames: int) -> list[View]:
    """So many views, evenly over the clip's time."""
    given = [
        (m, c.resized(size.width, size.height))
        for m, c in zip(clip.moments, clip.cameras, strict=True)
    ]
    given.sort(key=lambda view: view[0].time)
    views = []
    for i in range(frames):
        place = i / max(frames - 1, 1) * (len(given) - 1)
        k = min(int(place), len(given) - 2)
        views.append(between(given[k], given[k + 1], place - k))
    return views


def ways(model: SceneModel, views: list[View]) -> tuple[dict[str, Way], dict[str, str]]:
    """What works here, and why not the rest."""
    device, raster = model.device, model.rasterizer
    found = {
        "plain": Way(
            lambda m, c: model(m.to(device)).joined(),
            lambda gaussians, c: raster.render(gaussians, c.to(device)),
        )
    }
    left_out = {}
    some = views[:: max(1, len(views) // KEPT)]
    for mode in ("cached", "graph"):
        try:
            play = Playback(model, some, mode=mode)  # type: ignore[arg-type]
        except RenderError as error:
            left_out[mode] = str(error)
            continue
        found[mode] = Way(play.deform, lambda _, c, play=play: play.draw(), play)  # type: ignore[misc]
    return found, left_out


@torch.no_grad()
def sweep(way: Way, views: list[View], device: torch.device, *, timed: bool) -> None:
    """Draw all views: once without waiting in between, and once frame by frame."""
    cuda = device.type == "cuda"
    marks = []
    start = clock(device)
    for moment, camera in views:
        if cuda:
            events = [torch.cuda.Event(enable_timing=True) for _ in range(3)]
            events[0].record()
            state = way.deform(moment, camera)
            events[1].record()
            way.draw(state, camera)
            events[2].record()
            marks.append(events)
        else:
            times = [clock(device)]
            state = way.deform(moment, camera)
            times.append(clock(device))
            way.draw(state, camera)
            times.append(clock(device))
            marks.append(times)
    elapsed = clock(device) - start
    alone = []
    for moment, camera in views[:: max(1, len(views) // 30)]:
        begun = clock(device)
        way.draw(way.deform(moment, camera), camera)
        alone.append(clock(device) - begun)
    if not timed:
        return
    way.frames.append(elapsed / len(views))
    way.latencies += alone
    for first, second, third in marks:
        if cuda:
            way.splits.append((first.elapsed_time(second), second.elapsed_time(third)))
        else:
            way.splits.append((second - first, third - second))


def measure(model: SceneModel, views: list[View], rounds: int) -> dict[str, Any]:
    device = model.device
    found, left_out = ways(model, views)
    for number in range(rounds + 1):
        for way in found.values():
            sweep(way, views, device, timed=number > 0)
            if way.play is not None:
                start = clock(device)
                for _ in way.play.film(views):
                    pass
                if number > 0:
                    way.film_frames.append((clock(device) - start) / len(views))
    rows: dict[str, Any] = {}
    for name, way in found.items():
        frame = middle(way.frames)
        rows[name] = {
            "deform_ms": middle([a for a, _ in way.splits]),
            "raster_ms": middle([b for _, b in way.splits]),
            "total_ms": middle([a + b for a, b in way.splits]),
            "frame_ms": frame,
            "fps": round(1000 / frame, 1),
            "first_frame_ms": middle(way.latencies),
            "rounds_ms": [round(x, 4) for x in way.frames],
        }
    best = list(found.values())[-1]
    if best.film_frames:
        frame, rounds_ms = middle(best.film_frames), [round(x, 4) for x in best.film_frames]
        rows["film"] = {"frame_ms": frame, "fps": round(1000 / frame, 1), "rounds_ms": rounds_ms}
    return {"ways": rows, "left_out": left_out}


def load(options: argparse.Namespace, size: Size) -> tuple[SceneModel, Clip, str]:
    from hoigs.core.model.compose import compose
    from hoigs.core.spec.schema import Spec
    from hoigs.runs.clip_source import read_clip
    from hoigs.runs.loaded_run import LoadedRun

    if options.run is not None:
        run = LoadedRun.open(options.run, device=options.device)
        return run.model, run.clip, f"{options.run.name}, {run.step} steps"
    splats = tuple(options.splats)
    # pictures are not looked at: a small clip has the poses, the cameras and enough points
    clip = read_clip(clip_name(480, 270, options.frames, splats))
    spec = Spec.load("hoigs", overrides=spec_overrides(splats, options.overrides))
    model = compose(spec, clip).to(options.device).eval()
    model.set_progress(1.0)
    return model, clip, "untrained, scene opacity 0.7"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_size(parser)
    parser.add_argument("--run", type=Path, help="a trained run in place of an untrained model")
    parser.add_argument("--sweep", type=int, default=200, help="frames in a sweep")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=24, help="of the built-in clip")
    options = parser.parse_args()
    size = Size.parse(options.size)
    model, clip, what = load(options, size)
    views = film(clip, size, options.sweep)
    with torch.no_grad():
        moment, camera = (x.to(model.device) for x in views[len(views) // 2])
        seen = model.render(moment, camera)
    report = {
        "machine": machine(model.device),
        "model": what,
        "size": options.size,
        "splats": model.count(),
        "drawn_in_the_middle": int((seen.info["radii"] > 0).sum()),
        "mean_alpha_in_the_middle": round(float(seen.alpha.mean()), 3),
        "sweep": options.sweep,
        **measure(model, views, options.rounds),
    }
    print(f"{what}; {options.size}; {sum(model.count().values())} splats: {model.count()}")
    print(f"{'way':8}{'deform':>10}{'raster':>10}{'total':>10}{'frame':>10}{'fps':>9}{'alone':>10}")
    filmed = report["ways"].get("film")
    for name, row in report["ways"].items():
        if row is filmed:
            print(f"{name:8}{'':30}{row['frame_ms']:10.3f}{row['fps']:9.1f}")
            continue
        print(
            f"{name:8}{row['deform_ms']:10.3f}{row['raster_ms']:10.3f}{row['total_ms']:10.3f}"
            f"{row['frame_ms']:10.3f}{row['fps']:9.1f}{row['first_frame_ms']:10.3f}"
        )
    for name, why in report["left_out"].items():
        print(f"{name:8}{why}")
    write(report, options.json)


if __name__ == "__main__":
    main()

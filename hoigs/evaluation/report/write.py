"""write_report: one HTML file with the renders, scores, curves and provenance of a run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import hoigs
from hoigs.core.model.scene import SceneModel
from hoigs.core.reporting import Progress, default_progress
from hoigs.core.spec.loader import load_yaml
from hoigs.core.system.files import write_whole
from hoigs.core.values.clip import Clip
from hoigs.evaluation.report import curves, media, sections
from hoigs.evaluation.report.media import ERROR_FULL, depth_colors, error_colors
from hoigs.evaluation.scores import Evaluation, Table, score_table, size_table, timing_table
from hoigs.runs.run_folder import RunFolder

BESIDE = ("*.yaml", "*.json", "*.jsonl", "renders/*", "exports/*/export.json")  # what is linked


def write_report(
    run_folder: Path | str,
    model: SceneModel,
    clip: Clip,
    evaluation: Evaluation,
    *,
    progress: Progress | None = None,
) -> Path:
    """Write `report.html` into a run folder, and return its path.

    The page is self-contained and loads nothing from the network. It includes the run's
    metrics.jsonl, spec.yaml and provenance.json where they exist, and links to the run's files.

    Raises:
        HoigsError: metrics.jsonl is damaged.
    """
    folder = Path(run_folder)
    report = progress or default_progress()
    records = RunFolder(folder).read_metrics()
    was_training = model.training
    model.eval()
    body = []
    steps: list[tuple[str, Callable[[], str]]] = [
        ("playback", lambda: _hero(model, clip)),
        ("comparisons", lambda: _compared(model, clip, evaluation)),
        ("orbit", lambda: _space(model, clip)),
        ("commands", lambda: _further(folder)),
        ("scores", lambda: _scores(evaluation)),
        ("curves", lambda: _training(records)),
        ("cost", lambda: _cost(evaluation)),
        ("faults", lambda: _faults(folder)),
        ("provenance", lambda: _origin(folder)),
    ]
    for i, (name, make) in enumerate(steps):
        report(i / len(steps), name)
        body.append(make())
    model.train(was_training)
    page = Template(_asset("page.html")).substitute(
        title=escape(clip.name),
        lead=escape(_lead(model, clip)),
        made=_made(folder, model),
        style=_asset("style.css"),
        script=_asset("script.js"),
        tiles=sections.tiles(evaluation, records),
        sections="\n".join(body),
        version=escape(hoigs.__version__),
        created=escape(evaluation.created),
    )
    path = folder / "report.html"
    write_whole(path, page)
    report(1.0, "")
    return path


def _lead(model: SceneModel, clip: Clip) -> str:
    """One sentence on what was reconstructed."""
    kinds = {name: model.entity(name).kind for name in model.entities}
    cast = [name if name == kind else f"{name} ({kind})" for name, kind in kinds.items()]
    listed = " and ".join([", ".join(cast[:-1]), cast[-1]]) if len(cast) > 1 else cast[0]
    camera = clip.cameras[0]
    return (
        f"{len(clip)} frames of video, {camera.width}×{camera.height} at {clip.fps:g} a second, "
        f"as moving 3D Gaussians: {listed}."
    )


def _made(folder: Path, model: SceneModel) -> str:
    """The method, and the command that trained it where the run has one."""
    run, method, command = RunFolder(folder), "", ""
    if run.spec.is_file():
        text = run.spec.read_text(encoding="utf-8")
        method = str(load_yaml(text, str(run.spec)).data.get("name", ""))
    if run.provenance.is_file():
        command = run.read_provenance().get("command", "")
    parts = [f"{n}: {type(model.entity(n).deformation).__name__}" for n in model.entities]
    for kind, module in (("interaction", model.interaction), ("decoder", model.decoder)):
        if module is not None:
            parts.append(f"{kind}: {type(module).__name__}")
    return sections.made(method, parts, without_home(command))


def without_home(text: str) -> str:
    """Text with `~` in place of the home folder, which often holds a person's name."""
    home = re.escape(str(Path.home()).strip("/"))
    return re.sub(rf"(?:(?:\.\./)+|(?<![\w.~-])/){home}(?![\w.-])", "~", text)


def in_shell(folder: Path) -> str:
    """A folder as a word of commands that a shell runs in the present one; `~` is the home."""
    path, home, here = folder.resolve(), Path.home().resolve(), Path.cwd()
    if path.is_relative_to(here) and path != here:
        return shlex.quote(str(path.relative_to(here)))
    if path.is_relative_to(home) and path != home:
        return f"~/{shlex.quote(str(path.relative_to(home)))}"
    return shlex.quote(str(path))


def _hero(model: SceneModel, clip: Clip) -> str:
    captions = ("The video", "The reconstruction, from the same camera")
    moving = media.playback(model, clip)
    return f"<div class='hero'>{sections.player(moving, captions, playing=True)}</div>"


def _compared(model: SceneModel, clip: Clip, evaluation: Evaluation) -> str:
    comparisons = media.comparisons(model, clip, evaluation)
    if not comparisons:
        return _section("Frames outside training", "The clip has none.", "")
    sequence = media.scored_sequence(model, clip, evaluation)
    error = sections.color_bar("Absolute error", error_colors(), "0", f"{ERROR_FULL:g}")
    unseen = all(view.protocol.split == "test" for view in evaluation.views)
    text = _section(
        "Frames outside training" if unseen else "Frame by frame",
        ("None of these images took part in training. " if unseen else "")
        + "Drag the line between them; choose a frame below.",
        sections.comparer(comparisons, error),
    )
    if not sequence.pictures:  # a clip may be scored by held-out cameras alone
        return text
    player = sections.player(sequence, ("The video", "The reconstruction", error))
    return text + _section("In a row", "The frames that were scored, in their order.", player)


def _further(folder: Path) -> str:
    run = in_shell(folder)
    there = [path.relative_to(folder).as_posix() for kind in BESIDE for path in folder.glob(kind)]
    links = sections.files(sorted(there)) if there else ""
    commands = {
        "view RUN": "from any side, in the browser",
        "view RUN --html run.html": "the same as one file to send",
        "render RUN --path bullet-time": "a film: the moment stands still, the camera moves",
        "render RUN --compare": "a film beside the video",
        "export RUN --format ply --out scene.ply": "one moment for viewers of Gaussians",
        "export RUN --format usd --out scene.usd": "all moments for Blender, Houdini and others",
    }
    lines = [(f"hoigs {words.replace('RUN', run)}", what) for words, what in commands.items()]
    return _section("Look further", "", links + sections.commands(lines))


def _space(model: SceneModel, clip: Clip) -> str:
    position = media.key_position(clip)
    index = clip.moments[position].index
    orbit, (near, far) = media.frozen_orbit(model, clip, position)
    depth = sections.color_bar("Depth", depth_colors(), f"{near:.2f} m", f"{far:.2f} m")
    return _section(
        "One moment from other views",
        f"Frame {index} is stopped while the camera swings 20° to each side of where it was.",
        sections.player(orbit, ("Colour", depth), playing=True),
    ) + _section(
        "Entities on their own",
        "Every entity is a model of its own and can be drawn alone, moved or left out.",
        sections.apart(media.cutouts(model, clip, position)),
    )


def _scores(evaluation: Evaluation) -> str:
    tables = "".join(sections.table(score_table(view)) for view in evaluation.views)
    bars = "".join(curves.frame_bars(view) for view in evaluation.views if view.frames)
    return _section(
        "Scores",
        "Each number stands with the protocol that it was measured by.",
        sections.legend() + tables + f"<div class='curves'>{bars}</div>",
    )


def _training(records: Sequence[dict[str, Any]]) -> str:
    if not records:
        return _section("Training", "metrics.jsonl is absent or empty: no curves.", "")
    plots = [curves.loss_curve(records)]
    if any(r.get("psnr") for r in records):
        plots.append(curves.psnr_curve(records))
    if any(r.get("counts") for r in records):
        plots.append(curves.count_curve(records))
    return _section("Training", "", f"<div class='curves'>{''.join(plots)}</div>")


def _cost(evaluation: Evaluation) -> str:
    tables = (timing_table(evaluation.timing), size_table(evaluation.sizes))
    return _section(
        "Time and size",
        "",
        sections.time_bar(evaluation.timing) + "".join(sections.table(t) for t in tables),
    )


def _faults(folder: Path) -> str:
    """The clip's defects with their remedies; empty if there are none."""
    run = RunFolder(folder)
    found = run.read_provenance().get("clip_faults") if run.provenance.is_file() else None
    if not found:
        return ""
    rows = [(fault["what"], fault["do"]) for fault in found]
    return _section(
        "What is wrong with the clip",
        "Training tolerated these defects.",
        sections.table(Table("", ("found", "what to do, and what was done"), rows, ()), words=True),
    )


def _origin(folder: Path) -> str:
    parts = []
    provenance = folder / "provenance.json"
    if provenance.is_file():
        parts.append(sections.provenance(RunFolder(folder).read_provenance(), without_home))
    spec = folder / "spec.yaml"
    if spec.is_file():
        title = "spec.yaml, resolved: it makes this run again"
        parts.append(sections.document(title, without_home(spec.read_text())))
    absent = [file.name for file in (provenance, spec) if not file.is_file()]
    return _section("Provenance", f"Absent: {', '.join(absent)}." if absent else "",
                    "".join(parts))  # fmt: skip


def _section(title: str, lead: str, content: str) -> str:
    words = f"<p class='intro'>{escape(lead)}</p>" if lead else ""
    return f"<section><h2>{escape(title)}</h2>{words}{content}</section>"


def _asset(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")

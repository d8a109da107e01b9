"""Files of an answer: spec.yaml, needs.md, needs.json, and a plot of error against parameters."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hoigs.core.errors import HoigsError
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.files import SUFFIXES
from hoigs.core.spec.loader import load_overrides
from hoigs.core.spec.schema import Spec
from hoigs.core.system.files import name_from
from hoigs.core.system.safe_replace import Layout, one_of, require_replaceable
from hoigs.studies.needs.result import (
    AFTER,
    FINAL,
    SETTLES,
    UNSEEN,
    Answer,
    Needs,
    Step,
    summary_line,
)
from hoigs.studies.plots import DPI, STYLE, color_of, framed, marker_of, scale

# The answer as a readable spec: what it extends, and each changed key with a reason.

BY_HAND = "given by --set"
SETTLED = "with constant rates a short training ends off its optimum"


def spec_text(needs: Needs, given: Sequence[str], folder: Path) -> str:
    """Text of the spec file of an answer, for `folder`.

    Args:
        given: settings of the user for the base spec; the file has them too.
    """
    base = needs.base
    if base.endswith(SUFFIXES):
        base = os.path.relpath(Path(base).resolve(), folder.resolve())
        base = base if "/" in base else f"./{base}"
    # a clip's name is free text, a spec's is not
    name = f"{needs.spec.name.partition('@')[0]}-needs-{name_from(needs.clip, 'clip')}"
    lines = [
        f"# What the clip {needs.clip} needs of {needs.base}, chosen by `hoigs study needs` on "
        f"{len(needs.frames)} training frames held back.",
        f"extends: {json.dumps(base)}",
        f"name: {json.dumps(name)}",
        f"summary: {json.dumps('no more model than ' + needs.clip + ' needs')}",
    ]
    return "\n".join([*lines, *_block(_changes(needs, given), (), _comments(needs, given))]) + "\n"


def _changes(needs: Needs, given: Sequence[str]) -> dict[str, Any]:
    """The given settings, changed by the overrides that the search chose.

    Settings that were given for a component are kept where that component is, as in the search.
    """
    tree = load_overrides(list(given)).data
    start = needs.start.model_dump(mode="json")
    for key, value in needs.overrides.items():
        *path, last = key.split(".")
        node, was = tree, start
        for step in path:
            node, was = node.setdefault(step, {}), was[step]
        own, before = node.get(last), was.get(last)
        if isinstance(own, dict) and isinstance(value, dict) and isinstance(before, dict):
            value = {**own, **value} if value.get("use") == before.get("use") else value
        node[last] = value
    return tree


def checked_spec(path: Path, needs: Needs, registry: Registry | None) -> Spec:
    """The spec that was written, read back.

    Raises:
        SpecError: it is invalid.
        RuntimeError: it is not the spec of the answer.
    """
    spec = Spec.load(path, registry=registry)
    if spec.hash() != needs.spec.hash():
        raise RuntimeError(f"{path} does not read back as the spec that was found")
    return spec


def _comments(needs: Needs, given: Sequence[str]) -> dict[str, str]:
    """The reason of each key, from the last search space that has set it."""
    comments = {SETTLES: SETTLED}
    comments |= {setting.partition("=")[0].strip(): BY_HAND for setting in given}
    for answer in needs.answers:
        for key in (*answer.overrides, *answer.afterwards):
            comments[key] = summary_line(answer)
    return comments


def _block(
    tree: Mapping[str, Any], place: tuple[str, ...], comments: Mapping[str, str]
) -> list[str]:
    """A block of YAML; values below a commented key stand on its line."""
    lines, indent = [], "  " * len(place)
    for key, value in tree.items():
        here = (*place, key)
        dotted = ".".join(here)
        deeper = isinstance(value, dict) and any(c.startswith(f"{dotted}.") for c in comments)
        if dotted in comments:
            lines.append(f"{indent}# {comments[dotted]}")
        if deeper and dotted not in comments:
            lines += [f"{indent}{key}:", *_block(value, here, comments)]
        else:
            lines.append(f"{indent}{key}: {_flow(value)}")
    return lines


def _flow(value: Any) -> str:
    """A value on one line, as specs are written by hand."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(v)}" for key, v in value.items()) + "}"
    return json.dumps(value)


# Error against parameters: a panel for each search space, its candidates as points.

WIDTH, HEIGHT = 4.8, 3.0  # inches of a panel
COLUMNS = 3


def draw(needs: Needs, *paths: Path) -> None:
    """Write the plot to every path, in the format of its suffix."""
    with matplotlib.rc_context(STYLE):
        figure = _figure(needs)
        for path in paths:
            figure.savefig(path, format=path.suffix.removeprefix("."), dpi=DPI)


def _figure(needs: Needs) -> Figure:
    answers = [a for a in needs.answers if any(s.score for s in a.steps)]
    columns = max(1, min(COLUMNS, len(answers)))
    rows = max(1, math.ceil(len(answers) / columns))
    title = f"What {needs.clip} needs: error on training frames held back, by trained parameters"
    note = "trained parameters of the trial (star: chosen; pale: rejected early, after fewer steps)"
    figure = framed(title, [note], columns * WIDTH, rows * HEIGHT)
    for number, answer in enumerate(answers, 1):
        _panel(figure.add_subplot(rows, columns, number), answer)
    return figure


def _panel(axes: Axes, answer: Answer) -> None:
    """Points and axes of one search space."""
    shown = _shown(answer)
    longest = max(s.steps for s in shown)
    for i, step in enumerate(shown):
        parameters, error, spread = _point(step)
        taken = step.candidate is answer.chosen
        axes.errorbar(
            [parameters], [error], yerr=[spread], capsize=2, color=color_of(i),
            marker="*" if taken else marker_of(i), markersize=13 if taken else 6,
            alpha=1.0 if step.steps == longest else 0.45, zorder=3, linestyle="none",
            label=step.candidate.name,
        )  # fmt: skip
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    axes.set_title(answer.title, size=10, loc="left")
    axes.set_ylabel("RMSE, grey levels of 255", size=8)
    axes.tick_params(labelsize=8, which="both")
    axes.margins(0.15)
    scale(axes, "x", [_point(s)[0] for s in shown])
    scale(axes, "y", [_point(s)[1] for s in shown])


def _shown(answer: Answer) -> list[Step]:
    return [s for s in answer.steps if s.score is not None]


def _point(step: Step) -> tuple[int, float, float]:
    """Parameters, RMSE over the region, and its change by one standard error of the paired
    difference to the chosen candidate (0 for that one itself)."""
    assert step.score is not None
    error = 255 * math.sqrt(step.score.mse)
    spread = step.over_chosen.error if step.over_chosen else 0.0
    return step.score.parameters, error, error * (10 ** (spread / 20) - 1)


FILES = ("spec.yaml", "needs.md", "needs.json", "needs.png", "needs.svg")
# its files are replaced one by one, and the table after the training goes through a `.part`
ANSWER = Layout(
    what="answer of `hoigs study needs`",
    maker="`hoigs study needs`",
    required=FILES,
    files=one_of(*map(re.escape, FILES), r"\.needs\.(md|json)(\.\d+)?\.part"),
    folders=one_of(),
)


def require_new(folder: Path, overwrite: bool, inputs: Iterable[Path | str] = ()) -> None:
    """Refuse a folder that already has an answer, before hours are spent on another.

    Args:
        overwrite: allow a complete answer there, with no other file beside it.
        inputs: files and folders that the new answer is made from; none may be inside the folder.

    Raises:
        HoigsError: the folder has an answer, or a file of one of its names.
    """
    there = [name for name in FILES if (folder / name).exists()]
    if there and not overwrite:
        raise HoigsError(
            f"{folder}: has {', '.join(there)} already; choose another --out, or --overwrite"
        )
    if there:
        require_replaceable(folder, ANSWER, inputs=map(Path, inputs))


def write_needs(
    needs: Needs, folder: Path, *, given: Sequence[str] = (), registry: Registry | None = None
) -> list[Path]:
    """Write all files, each under a temporary name first; the spec is read back and compared.

    Args:
        given: settings of the user for the base spec.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scratch = folder / f".needs.{os.getpid()}.part"
    scratch.mkdir()
    try:
        # the spec's `extends` may be a path from where it is to stand
        (folder / ".spec.part.yaml").write_text(spec_text(needs, given, folder), encoding="utf-8")
        checked_spec(folder / ".spec.part.yaml", needs, registry)
        (folder / ".spec.part.yaml").rename(scratch / "spec.yaml")
        (scratch / "needs.md").write_text(page(needs), encoding="utf-8")
        (scratch / "needs.json").write_text(json.dumps(as_data(needs), indent=1), encoding="utf-8")
        draw(needs, scratch / "needs.png", scratch / "needs.svg")
        for name in FILES:
            (scratch / name).replace(folder / name)
    finally:
        (folder / ".spec.part.yaml").unlink(missing_ok=True)
        shutil.rmtree(scratch)
    return [folder / name for name in FILES]


def page(needs: Needs) -> str:
    """needs.md: a line and a table for each search space, then the method and its cost."""
    lines = [f"# What {needs.clip} needs", ""]
    lines += [f"- {summary_line(answer)}" for answer in needs.answers]
    for answer in needs.answers:
        if answer.steps:
            lines += ["", f"## {answer.title}", "", *_table(answer)]
    return "\n".join([*lines, "", "## How it was chosen", "", *method(needs)]) + "\n"


def _table(answer: Answer) -> list[str]:
    lines = [
        "| candidate | held-back PSNR, dB | gain over chosen, dB | parameters | steps | verdict |",
        "|---|---:|---:|---:|---:|---|",
    ]
    return [*lines, *(" | ".join(["", *row(answer, step), ""]).strip() for step in answer.steps)]


def row(answer: Answer, step: Step) -> list[str]:
    """Cells of one candidate: name, PSNR, gain over the chosen, parameters, steps, verdict."""
    if step.score is None:
        why = f"not tried: {step.problem.splitlines()[0]}" if step.problem else answer.skipped
        return [step.candidate.name, "–", "–", "–", "–", why]
    score = step.score
    over = "0" if step.over_chosen is None else str(step.over_chosen).removesuffix(" dB")
    verdict = "chosen" if step.candidate is answer.chosen else "rejected"
    if step.useless is not None:
        verdict += f"; where it is the truth, the best gains {step.useless}"
    cells = [f"{score.mean:.2f}", over, f"{score.parameters:,}", str(step.steps)]
    return [step.candidate.name, *cells, verdict]


def method(needs: Needs) -> list[str]:
    """Frames, criterion and cost, in sentences."""
    chosen = needs.settings
    rule = (
        f"the cheapest candidate within one standard error of the best, or within "
        f"{chosen.least:g} dB{_tolerances(needs)}"
    )
    total = needs.budget.limit + (FINAL + AFTER) * needs.full
    frames = ", ".join(map(str, needs.frames))
    return [
        f"- Held back: {len(needs.frames)} training frames (positions {frames}). Test frames were "
        "sealed: reading one is an error.",
        f"- Criterion: {rule}. ± is the standard error of the paired differences over these frames "
        "alone: another seed of the training is not in it.",
        f"- A rigid motion whose refit with the knots of a cheaper candidate moves nothing by "
        f"{UNSEEN:g} pixel gets that candidate, whatever its score on these few frames.",
        "- Each candidate is trained alone, in its own region. Those rejected early were trained "
        "for fewer steps, and are compared with the chosen one at that step.",
        f"- Search: {needs.budget.spent:.0f} of {needs.budget.limit:.0f} steps; "
        f"with the final training and pruning the limit is "
        f"{total / needs.full:.3g} x {needs.full} = {total:.0f}. Wall time: {needs.seconds:.0f} s, "
        f"where a full training would take about {needs.full_seconds:.0f} s "
        f"({needs.seconds / needs.full_seconds:.2f} of it).",
    ]


def _tolerances(needs: Needs) -> str:
    """Tolerances that search spaces declare: "; interaction 0.5 dB; object beyond what …"."""
    spaces = {a.space.name: a.space for a in needs.answers if a.steps}.values()
    own = [f"; {space.name} {space.least:g} dB" for space in spaces if space.least is not None]
    own += [
        f"; {space.name} beyond what the same freedom gains where the cheaper one is the truth"
        for space in spaces
        if space.calibrated
    ]
    return "".join(own)


def as_data(needs: Needs) -> dict[str, Any]:
    """JSON values."""
    return {
        "format": "hoigs-needs",
        "version": 2,
        "clip": needs.clip,
        "base": needs.base,
        "overrides": needs.overrides,
        "settings": asdict(needs.settings),
        "held_back": list(needs.frames),
        "full_steps": needs.full,
        "spent": needs.budget.spent,
        "limit": needs.budget.limit,
        "entries": needs.budget.entries,
        "seconds": needs.seconds,
        "full_seconds": needs.full_seconds,
        "answers": [_answer(answer) for answer in needs.answers],
    }


def _answer(answer: Answer) -> dict[str, Any]:
    candidates = [
        {
            "name": step.candidate.name,
            "overrides": step.candidate.overrides,
            "afterwards": step.candidate.afterwards,
            "steps": step.steps,
            "seconds": step.seconds,
            "score": None if step.score is None else asdict(step.score),
            "over_chosen": None if step.over_chosen is None else asdict(step.over_chosen),
            "useless": None if step.useless is None else asdict(step.useless),
            "problem": step.problem,
        }
        for step in answer.steps
    ]
    return {
        "search_space": answer.space.name,
        "block": answer.block,
        "chosen": answer.chosen.name if answer.chosen else None,
        "because": summary_line(answer),
        "skipped": answer.skipped,
        "refitted": answer.refitted,
        "candidates": candidates,
    }

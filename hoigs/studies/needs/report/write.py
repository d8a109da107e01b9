"""Files of an answer: spec.yaml, needs.md, needs.json, and a plot of error against parameters."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.files.safe_replace import Layout, one_of, require_replaceable
from hoigs.core.registry.registry import Registry
from hoigs.studies.needs.refit import UNSEEN
from hoigs.studies.needs.report.plot import draw
from hoigs.studies.needs.report.spec import checked_spec, spec_text
from hoigs.studies.needs.result import Answer, Needs, Step, summary_line

FILES = ("spec.yaml", "needs.md", "needs.json", "needs.png", "needs.svg")
# its files are replaced one by one, and the table after the training goes through a `.part`
ANSWER = Layout(
    what="answer of `hoigs needs`",
    maker="`hoigs needs`",
    required=FILES,
    files=one_of(*map(re.escape, FILES), r"\.needs\.(md|json)\.\d+\.part"),
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
    cells = [f"{score.mean:.2f}", over, f"{score.parameters:,}", str(step.steps)]
    return [
        step.candidate.name,
        *cells,
        "chosen" if step.candidate is answer.chosen else "rejected",
    ]


def method(needs: Needs) -> list[str]:
    """Frames, criterion and cost, in sentences."""
    chosen = needs.settings
    rule = (
        f"the cheapest candidate within one standard error of the best, or within "
        f"{chosen.least:g} dB{_tolerances(needs)}"
        if chosen.criterion == "one-se"
        else "the candidate of the least BIC"
    )
    total = needs.full * chosen.budget
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
        f"{chosen.budget:g} x {needs.full} = {total:.0f}. Wall time: {needs.seconds:.0f} s, "
        f"where a full training would take about {needs.full_seconds:.0f} s "
        f"({needs.seconds / needs.full_seconds:.2f} of it).",
    ]


def _tolerances(needs: Needs) -> str:
    """Tolerances that search spaces declare: "; interaction 0.5 dB; object 0.6 dB for every …"."""
    spaces = {a.space.name: a.space for a in needs.answers if a.steps}.values()
    own = [f"; {space.name} {space.least:g} dB" for space in spaces if space.least is not None]
    own += [
        f"; {space.name} {space.min_gain:g} dB for every doubling of parameters"
        for space in spaces
        if space.min_gain > 0
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

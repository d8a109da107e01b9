"""The answer on disk: spec.yaml, needs.md, needs.json, and a plot of error against parameters."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hoigs.core.errors import HoigsError
from hoigs.core.registry import Registry
from hoigs.studies.needs.plot import draw
from hoigs.studies.needs.refit import UNSEEN
from hoigs.studies.needs.search import Answer, Needs, Step, told
from hoigs.studies.needs.write_spec import checked_spec, spec_text

FILES = ("spec.yaml", "needs.md", "needs.json", "needs.png", "needs.svg")


def require_new(folder: Path, overwrite: bool) -> None:
    """HoigsError if an answer is there already, before hours go into another."""
    there = [name for name in FILES if (folder / name).exists()]
    if there and not overwrite:
        raise HoigsError(
            f"{folder}: has {', '.join(there)} already; choose another --out, or --overwrite"
        )


def write_needs(
    needs: Needs, folder: Path, *, given: Sequence[str] = (), registry: Registry | None = None
) -> list[Path]:
    """Write all files, each under a temporary name first; the spec is read back and compared.

    Args:
        given: settings that the user had laid over the base spec.
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
    """needs.md: an answer a line, a table a ladder, what it cost."""
    lines = [f"# What {needs.clip} needs", ""]
    lines += [f"- {told(answer)}" for answer in needs.answers]
    for answer in needs.answers:
        if answer.steps:
            lines += ["", f"## {answer.title}", "", *_table(answer)]
    return "\n".join([*lines, "", "## How it was chosen", "", *method(needs)]) + "\n"


def _table(answer: Answer) -> list[str]:
    lines = [
        "| rung | PSNR held back, dB | against the chosen, dB | parameters | steps | verdict |",
        "|---|---:|---:|---:|---:|---|",
    ]
    return [*lines, *(" | ".join(["", *row(answer, step), ""]).strip() for step in answer.steps)]


def row(answer: Answer, step: Step) -> list[str]:
    """Cells of one rung: name, PSNR, gain over the chosen rung, parameters, steps, verdict."""
    if step.score is None:
        why = f"not tried: {step.problem.splitlines()[0]}" if step.problem else answer.skipped
        return [step.rung.name, "–", "–", "–", "–", why]
    score = step.score
    over = "0" if step.over_chosen is None else str(step.over_chosen).removesuffix(" dB")
    cells = [f"{score.mean:.2f}", over, f"{score.parameters:,}", str(step.steps)]
    return [step.rung.name, *cells, "taken" if step.rung is answer.chosen else "refused"]


def method(needs: Needs) -> list[str]:
    """In sentences: the frames, the criterion, what was spent."""
    chosen = needs.settings
    rule = (
        f"the cheapest rung within one standard error of the best, or within {chosen.least:g} dB"
        f"{_tolerances(needs)}"
        if chosen.criterion == "one-se"
        else "the rung of the least BIC"
    )
    total = needs.full * chosen.budget
    frames = ", ".join(map(str, needs.frames))
    return [
        f"- Held back: {len(needs.frames)} training frames (positions {frames}). Test frames were "
        "sealed: reading one is an error.",
        f"- Criterion: {rule}. ± is the standard error of the paired differences over these frames "
        "alone: another seed of the training is not in it.",
        f"- A rigid motion whose refit with the knots of a cheaper rung moves nothing by "
        f"{UNSEEN:g} pixel gets that rung, whatever these few frames say.",
        "- Each rung is trained alone, in its own region. Rungs refused early were trained for "
        "fewer steps; they stand against the chosen one as it was then.",
        f"- Search: {needs.ledger.spent:.0f} steps' worth of the {needs.ledger.limit:.0f} that it "
        f"may cost; with the final training it keeps within "
        f"{chosen.budget:g} x {needs.full} = {total:.0f}. By the clock: {needs.seconds:.0f} s, "
        f"where a full training would take about {needs.full_seconds:.0f} s "
        f"({needs.seconds / needs.full_seconds:.2f} of it).",
    ]


def _tolerances(needs: Needs) -> str:
    """What ladders ask for themselves: "; interaction 0.5 dB; object 0.6 dB a doubling …"."""
    ladders = {a.ladder.name: a.ladder for a in needs.answers if a.steps}.values()
    own = [f"; {ladder.name} {ladder.least:g} dB" for ladder in ladders if ladder.least is not None]
    own += [
        f"; {ladder.name} {ladder.price:g} dB for every doubling of parameters"
        for ladder in ladders
        if ladder.price > 0
    ]
    return "".join(own)


def as_data(needs: Needs) -> dict[str, Any]:
    """JSON values."""
    return {
        "format": "hoigs-needs",
        "version": 1,
        "clip": needs.clip,
        "base": needs.base,
        "overrides": needs.overrides,
        "settings": asdict(needs.settings),
        "held_back": list(needs.frames),
        "full_steps": needs.full,
        "spent": needs.ledger.spent,
        "limit": needs.ledger.limit,
        "entries": needs.ledger.entries,
        "seconds": needs.seconds,
        "full_seconds": needs.full_seconds,
        "answers": [_answer(answer) for answer in needs.answers],
    }


def _answer(answer: Answer) -> dict[str, Any]:
    rungs = [
        {
            "name": step.rung.name,
            "overrides": step.rung.overrides,
            "afterwards": step.rung.afterwards,
            "steps": step.steps,
            "seconds": step.seconds,
            "score": None if step.score is None else asdict(step.score),
            "over_chosen": None if step.over_chosen is None else asdict(step.over_chosen),
            "problem": step.problem,
        }
        for step in answer.steps
    ]
    return {
        "ladder": answer.ladder.name,
        "block": answer.block,
        "chosen": answer.chosen.name if answer.chosen else None,
        "because": told(answer),
        "skipped": answer.skipped,
        "refitted": answer.refitted,
        "rungs": rungs,
    }

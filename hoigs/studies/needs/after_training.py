"""After the training: prune the model, tune it, compress it, and add a table to the answer."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from hoigs.core.registry.registry import default_registry
from hoigs.core.system.files import write_whole
from hoigs.runs.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from hoigs.runs.options import RunOptions
from hoigs.runs.run_folder import RunFolder
from hoigs.studies.needs.compress import Compacted, compress
from hoigs.studies.needs.prune import Cut, Pruning
from hoigs.studies.needs.result import AFTER
from hoigs.studies.needs.search_space import StepBudget
from hoigs.studies.needs.trial import Scores, Trained, Validator, sealed_view, selection_frames

LEAST = 40  # steps of budget that pruning needs, however short the training
HEADING = "## After the training"


@dataclass(frozen=True)
class After:
    """Result of pruning and compressing a trained run.

    Attributes:
        before, after: scores of the trained and of the pruned model. spent, limit: budget, steps.
        parameters: trained parameters, before and after. seconds: of pruning and compressing.
        search_s, train_s, full_s: seconds of the search, of the training, and of one training of
            the full spec at the measured pace; None where they were not measured.
    """

    cuts: tuple[Cut, ...]
    before: Scores
    after: Scores
    compacted: Compacted
    spent: float
    limit: float
    parameters: tuple[int, int]
    seconds: float
    search_s: float | None = None
    train_s: float | None = None
    full_s: float | None = None

    @property
    def whole_cost(self) -> float | None:
        """Wall time of search, training and pruning, in full trainings."""
        if self.search_s is None or self.train_s is None or self.full_s is None:
            return None
        return (self.search_s + self.train_s + self.seconds) / self.full_s


def finish(
    run: Path,
    compact: Path,
    *,
    options: RunOptions,
    overwrite: bool = False,
    report: Callable[[str], None] = lambda line: None,
    clock: tuple[float, float, float] | None = None,
) -> After:
    """Prune a trained run in place and write a compressed copy of it.

    Test frames are sealed where cuts are scored, and tuning uses training frames only.

    The run's model, spec.yaml and provenance are replaced together, by one rename; its metrics
    stay. Training cannot be resumed from it.

    Args:
        compact: folder of the compressed copy. options: how the run is opened.
        clock: seconds of search, training and a full training.

    Raises:
        HoigsError: no such run, files in it that hoigs did not write, or `compact` exists.
    """
    began = time.perf_counter()
    RunFolder(run).refuse_existing(overwrite=True)  # before the work: it is replaced after it
    RunFolder(compact).refuse_existing(overwrite, [run])
    loaded = options.open(run)
    registry = default_registry(plugin_files=options.plugins)
    view = sealed_view(loaded.clip)
    positions = selection_frames(view.split["train"])
    budget = StepBudget(max(AFTER * loaded.spec.train.steps, LEAST))
    validator = Validator(view, positions, budget)
    start = Trained(loaded.spec, loaded.model, loaded.clip, registry)
    parameters = _parameters(start)
    pruning = Pruning(start, validator, report=report)
    pruned = pruning.run()
    _replace(RunFolder(run), pruned)
    compacted = compress(
        run, out=compact, clip=options.clip, positions=positions, device=options.device,
        plugins=options.plugins, overwrite=overwrite,
    )  # fmt: skip
    report(str(compacted))
    search_s, train_s, full_s = clock or (None, None, None)
    return After(
        tuple(pruning.cuts), pruning.first, pruning.now, compacted, budget.spent, budget.limit,
        (parameters, _parameters(pruned)), time.perf_counter() - began, search_s, train_s, full_s,
    )  # fmt: skip


def _parameters(trained: Trained) -> int:
    return sum(p.numel() for p in trained.model.parameters() if p.requires_grad)


def _replace(run: RunFolder, pruned: Trained) -> None:
    """Replace the run by one with the pruned model, atomically."""
    old = load_checkpoint(latest_checkpoint(run.checkpoints))
    tensors = {f"model.{k}": v for k, v in pruned.model.state_dict().items()}
    tensors |= {f"cameras.{k}": v for k, v in old.part("cameras").items()}
    meta = {key: old.meta[key] for key in ("format", "version", "step", "time_s", "skipped")}
    meta |= {
        "counts": pruned.model.count(),
        "spec_name": pruned.spec.name,
        "model_hash": pruned.spec.model_hash(),
    }
    new = RunFolder(run.path.with_name(f".{run.path.name}.pruned.{os.getpid()}.part"))
    provenance = run.read_provenance() | {"spec_hash": pruned.spec.hash(), "pruned": True}
    try:
        new.create(pruned.spec.dump(), provenance)
        shutil.copyfile(run.metrics, new.metrics)
        new.keep_clip_of(run)
        Checkpoint({k: v.detach().clone() for k, v in tensors.items()}, meta).save(new.checkpoints)
        run.replace_by(new, overwrite=True)
    finally:
        shutil.rmtree(new.path, ignore_errors=True)


def table(after: After) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Columns and rows: one a cut, then the whole model, then the compact file."""
    columns = ("this scene needs", "of", "", "dB", "because")
    rows: list[tuple[str, ...]] = [
        (f"{cut.after:,}", f"{cut.before:,}", f"{cut.unit}: {cut.what}",
         "–" if cut.drop is None else f"{-cut.drop:+.3f}", cut.why)
        for cut in after.cuts
    ]  # fmt: skip
    lost = after.before.drop_to(after.after)
    many, few = after.parameters
    rows.append((f"{few:,}", f"{many:,}", "trained parameters: the whole model", f"{-lost:+.3f}",
                 "all of the above, and tuned"))  # fmt: skip
    c = after.compacted
    rows.append(
        (f"{c.bytes_after / 1e6:.3f}", f"{c.bytes_before / 1e6:.3f}", "MB: on disk, quantised",
         f"{-c.drop:+.3f}", "8 and 16 bits a number are enough")
    )  # fmt: skip
    return columns, rows


def sentences(after: After) -> list[str]:
    """What the numbers of the table mean, and what each part cost."""
    frames = ", ".join(map(str, after.compacted.frames))
    found = [
        "dB: in the worst of three regions (people and objects; objects; background), on frames "
        f"{frames}, which were held back from the search but not from the final training.",
        f"Pruning and tuning: {after.spent:.0f} of {after.limit:.0f} steps.",
    ]
    whole = after.whole_cost
    if whole is not None:
        assert after.search_s is not None and after.train_s is not None
        found.append(
            f"Wall time: search {after.search_s:.0f} s, training {after.train_s:.0f} s, "
            f"pruning and compression {after.seconds:.0f} s: {whole:.2f} full trainings of "
            f"{after.full_s:.0f} s."
        )
    return found


def add_to_answer(after: After, folder: Path) -> None:
    """Add the table to needs.md and needs.json of the answer, or replace an earlier one."""
    page, data = folder / "needs.md", folder / "needs.json"
    columns, rows = table(after)
    lines = ["| " + " | ".join(columns) + " |", "|---:|---:|---|---:|---|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    lines += ["", *(f"- {sentence}" for sentence in sentences(after))]
    text = page.read_text(encoding="utf-8").partition(HEADING)[0].rstrip()
    write_whole(page, "\n".join([text, "", HEADING, "", *lines, ""]))
    record = json.loads(data.read_text(encoding="utf-8"))
    write_whole(data, json.dumps(record | {"after": as_data(after)}, indent=1))


def as_data(after: After) -> dict[str, Any]:
    """JSON values."""
    compacted = after.compacted
    return {
        "cuts": [asdict(cut) for cut in after.cuts],
        "psnr": {"trained": dict(after.before.psnr), "pruned": dict(after.after.psnr),
                 "compact": dict(compacted.after.psnr)},
        "frames": list(compacted.frames),
        "parameters": list(after.parameters),
        "bytes": [compacted.bytes_before, compacted.bytes_after],
        "spent": after.spent,
        "limit": after.limit,
        "seconds": {"search": after.search_s, "train": after.train_s, "after": after.seconds,
                    "full": after.full_s},
        "full_trainings": after.whole_cost,
        "threads": torch.get_num_threads(),
    }  # fmt: skip

"""After the winner is trained: pruned, tuned, compressed, and told in the same table."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from hoigs.core.registry import default_registry
from hoigs.studies.needs.compact_run import Compacted, compact_run, put_in_place
from hoigs.studies.needs.halving import Ledger
from hoigs.studies.needs.judge import Judge, Look
from hoigs.studies.needs.prune import Cut, Pruning
from hoigs.studies.needs.search import AFTER
from hoigs.studies.needs.selection import sealed_view, selection_frames
from hoigs.studies.needs.trained import Trained
from hoigs.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from hoigs.training.run_folder import RunFolder
from hoigs.training.session import LoadedRun

LEAST = 40  # steps' worth that pruning needs, however short the training
HEADING = "## After the training"


@dataclass(frozen=True)
class After:
    """What became of a trained run.

    Attributes:
        before, after: looks at the model as trained and as pruned. spent, limit: steps' worth.
        parameters: trained numbers, before and after. seconds: of pruning and compressing.
        search_s, train_s, full_s: seconds of the search, of the training, and of one training of
            the full spec at the pace that the search measured; None where nobody measured them.
    """

    cuts: tuple[Cut, ...]
    before: Look
    after: Look
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
        """Full trainings that everything took by the clock."""
        if self.search_s is None or self.train_s is None or self.full_s is None:
            return None
        return (self.search_s + self.train_s + self.seconds) / self.full_s


def finish(
    run: Path,
    compact: Path,
    *,
    clip: Path | str | None = None,
    device: str = "cpu",
    plugins: Sequence[Path] = (),
    overwrite: bool = False,
    report: Callable[[str], None] = lambda line: None,
    clock: tuple[float, float, float] | None = None,
) -> After:
    """Prune a trained run in place and write its compact twin.

    Test frames are sealed where cuts are judged, and tuning trains on training frames alone.

    The run's model, spec.yaml and provenance are replaced together, by one rename; its metrics
    stay. What training would need to go on is gone then.

    Args:
        compact: folder of the twin. clock: seconds of search, training and a full training.

    Raises:
        HoigsError: no such run, or `compact` is there already.
    """
    began = time.perf_counter()
    RunFolder(compact).refuse_existing(overwrite)
    loaded = LoadedRun.open(run, clip=clip, device=device, plugins=plugins)
    registry = default_registry(plugin_files=plugins)
    view = sealed_view(loaded.clip)
    positions = selection_frames(view.split["train"])
    ledger = Ledger(max(AFTER * loaded.spec.train.steps, LEAST))
    judge = Judge(view, positions, ledger)
    start = Trained(loaded.spec, loaded.model, loaded.clip, registry)
    many = _trained_numbers(start)
    pruning = Pruning(start, judge, report=report)
    pruned = pruning.run()
    _replace(RunFolder(run), pruned)
    compacted = compact_run(
        run, compact, clip=clip, positions=positions, device=device, plugins=plugins,
        overwrite=overwrite,
    )  # fmt: skip
    report(str(compacted))
    search_s, train_s, full_s = clock or (None, None, None)
    return After(
        tuple(pruning.cuts), pruning.first, pruning.now, compacted, ledger.spent, ledger.limit,
        (many, _trained_numbers(pruned)), time.perf_counter() - began, search_s, train_s, full_s,
    )  # fmt: skip


def _trained_numbers(trained: Trained) -> int:
    return sum(p.numel() for p in trained.model.parameters() if p.requires_grad)


def _replace(run: RunFolder, pruned: Trained) -> None:
    """The run with the pruned model, under a temporary name first."""
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
        Checkpoint({k: v.detach().clone() for k, v in tensors.items()}, meta).save(new.checkpoints)
        put_in_place(new, run)
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
    rows.append((f"{few:,}", f"{many:,}", "trained numbers: the whole model", f"{-lost:+.3f}",
                 "all of the above, and tuned"))  # fmt: skip
    c = after.compacted
    rows.append(
        (f"{c.bytes_after / 1e6:.3f}", f"{c.bytes_before / 1e6:.3f}", "MB: on disk, quantised",
         f"{-c.drop:+.3f}", "8 and 16 bits a number are enough")
    )  # fmt: skip
    return columns, rows


def sentences(after: After) -> list[str]:
    """What the numbers of the table are, and what everything cost."""
    frames = ", ".join(map(str, after.compacted.frames))
    said = [
        f"dB: in the worse of two regions (people and things; background), on frames {frames}, "
        "which were held back from the search; the final training has seen them.",
        f"Pruning and tuning: {after.spent:.0f} steps' worth of {after.limit:.0f}.",
    ]
    whole = after.whole_cost
    if whole is not None:
        assert after.search_s is not None and after.train_s is not None
        said.append(
            f"By the clock: search {after.search_s:.0f} s, training {after.train_s:.0f} s, after "
            f"it {after.seconds:.0f} s: {whole:.2f} full trainings of {after.full_s:.0f} s."
        )
    return said


def add_to_answer(after: After, folder: Path) -> None:
    """Put the table into needs.md and needs.json of the search's answer.

    An earlier table of the same answer is replaced.
    """
    page, data = folder / "needs.md", folder / "needs.json"
    columns, rows = table(after)
    lines = ["| " + " | ".join(columns) + " |", "|---:|---:|---|---:|---|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    lines += ["", *(f"- {sentence}" for sentence in sentences(after))]
    text = page.read_text(encoding="utf-8").partition(HEADING)[0].rstrip()
    _write(page, "\n".join([text, "", HEADING, "", *lines, ""]))
    record = json.loads(data.read_text(encoding="utf-8"))
    _write(data, json.dumps(record | {"after": as_data(after)}, indent=1))


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


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)

"""write_page: a run as one HTML file with a player, thinned to a size where one is given."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import torch

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.model.compose import compose_bodies
from hoigs.core.model.exporter import ExportRequest, require_own_colors
from hoigs.core.model.standing import in_known_world
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.files import write_whole
from hoigs.plugins.exporters.carried import Entity, collect
from hoigs.plugins.exporters.gltf_4d import Gltf4dConfig, losses, motion_glb
from hoigs.runs.loaded_run import LoadedRun

FEWEST = 0.02  # share of the Gaussians below which a size is refused
SEARCHES = 3  # tries to find the share of Gaussians that is kept


@dataclass(frozen=True)
class Page:
    """A page that was written.

    Attributes:
        gaussians, of: stored, and in the run.
        left_out: sentences on what the file does not have.
    """

    path: Path
    megabytes: float
    gaussians: int
    of: int
    left_out: Sequence[str]

    def __str__(self) -> str:
        return f"{self.path}: {self.megabytes:.1f} MB. " + " ".join(self.left_out)


def write_page(
    loaded: LoadedRun,
    path: Path | str,
    *,
    max_mb: float | None = None,
    entities: Sequence[str] = (),
    progress: Progress | None = None,
) -> Page:
    """Write a run to one HTML file that needs neither a server nor a network.

    It is a player and the run as `exporter:gltf-4d` writes it.

    Args:
        max_mb: of the file, in units of 10^6 bytes: colours first lose their change with the
            direction, then the Gaussians that cover least are left out. None stores all.
        entities: names; all by default.

    Raises:
        HoigsError: an entity is unknown, a decoder makes the pictures of the run, the size cannot
            be reached, or the disk is full.
    """
    path, report = Path(path), progress or no_progress
    if path.suffix.lower() not in (".html", ".htm"):
        raise HoigsError(f"{path}: expected a name that ends in .html")
    require_own_colors(loaded.model, f"the page {path.name}")
    request = _request(loaded, entities)
    with torch.no_grad():
        whole = collect(request, Gltf4dConfig().modes, report)
    budget = None if max_mb is None else int(max_mb * 1e6)
    page, text = _fitting(_Attempts(loaded, request, whole, path), budget, report)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text)
    except OSError as error:
        raise HoigsError(f"{path} cannot be written: {error.strerror or error}") from error
    return page


def _request(loaded: LoadedRun, entities: Sequence[str]) -> ExportRequest:
    """All moments of the clip, of these entities."""
    names = loaded.model.names()
    for name in entities:
        if name not in names:
            near = did_you_mean(name, names)
            raise HoigsError(f"--entities {name}: this run has {', '.join(names)}{near}")
    bodies = compose_bodies(loaded.spec, loaded.clip)
    device = loaded.model.device
    return ExportRequest(
        loaded.model, in_known_world(loaded.clip, bodies),
        tuple(m.to(device) for m in loaded.clip.moments), tuple(entities),
        bodies={n: b.to(device) for n, b in bodies.items()},
    )  # fmt: skip


@dataclass(frozen=True)
class _Attempts:
    """Makes pages of a share of the Gaussians, those that cover most."""

    loaded: LoadedRun
    request: ExportRequest
    whole: Sequence[Entity]
    path: Path

    def __call__(self, share: float, sh: bool) -> tuple[Page, str]:
        kept = [_thinned(entity, share) for entity in self.whole]
        count, total = (sum(len(e.carried) for e in some) for some in (kept, self.whole))
        left = self._left_out(count, total, sh)
        data = motion_glb(self.request, kept, sh=sh)
        text = _page(f"{self.loaded.spec.name} on {self.loaded.clip.name}", data, left)
        return Page(self.path, len(text.encode()) / 1e6, count, total, left), text

    def _left_out(self, count: int, total: int, sh: bool) -> list[str]:
        """Sentences on what the page has not."""
        sentences = [f"{k}: {v}." for k, v in losses(self.request, self.whole).items()]
        if not sh:
            sentences.append("Colours do not change with the direction.")
        if count < total:
            sentences.append(
                f"{count:,} of {total:,} Gaussians ({100 * count / total:.0f} %), those that cover "
                "most: the others are left out."
            )
        else:
            sentences.append(f"All {total:,} Gaussians.")
        missing = [n for n in self.loaded.model.entities if n not in self.request.entities]
        if missing:
            sentences.append(f"Without {', '.join(missing)}.")
        return sentences


def _fitting(
    attempt: Callable[[float, bool], tuple[Page, str]], budget: int | None, report: Progress
) -> tuple[Page, str]:
    """The fullest page within the budget that few tries find: a size is nearly linear in the share
    of the Gaussians.

    Raises:
        HoigsError: even the fewest are too large.
    """
    report(0.9, "packing")
    made = attempt(1.0, True)
    if budget is None or made[0].megabytes * 1e6 <= budget:
        return made
    made = attempt(1.0, False)
    if made[0].megabytes * 1e6 <= budget:
        return made
    low, best = FEWEST, attempt(FEWEST, False)
    high, most = 1.0, made[0].megabytes * 1e6
    least = best[0].megabytes * 1e6
    if least > budget:
        raise HoigsError(
            f"--max-mb {budget / 1e6:g}: with {100 * FEWEST:.0f} % of the Gaussians the file still "
            f"has {least / 1e6:.2f} MB; allow more, or give fewer --entities"
        )
    for i in range(SEARCHES):
        share = low + (high - low) * 0.99 * (budget - least) / (most - least)
        report(0.9 + 0.03 * i, f"{100 * share:.0f} % of the Gaussians")
        made = attempt(share, False)
        size = made[0].megabytes * 1e6
        if size <= budget:
            low, least, best = share, size, made
        else:
            high, most = share, size
    return best


def _thinned(entity: Entity, share: float) -> Entity:
    """The Gaussians that cover most."""
    part = entity.carried
    if share >= 1.0 or not len(part):
        return entity
    count = max(1, round(share * len(part)))
    rows = part.importance().topk(count).indices.sort().values
    return replace(entity, carried=part.only(rows))


def _page(title: str, data: bytes, left_out: Sequence[str]) -> str:
    """The text of the file."""
    folder = files("hoigs.viewing.player")
    text = folder.joinpath("player.html").read_text(encoding="utf-8")
    header = {"title": title, "leftOut": list(left_out)}
    parts = {
        "/*STYLE*/": folder.joinpath("player.css").read_text(encoding="utf-8"),
        "/*HEADER*/": json.dumps(header).replace("<", "\\u003c"),
        "/*DATA*/": base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii"),
        "/*SCRIPT*/": folder.joinpath("player.js").read_text(encoding="utf-8"),
    }
    for mark, part in parts.items():
        text = text.replace(mark, part)
    return text

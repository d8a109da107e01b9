"""A preparation in a process of its own, which writes what happens as lines of JSON.

It is started by `jobs.Job` as `python -m hoigs.viewing.annotate.worker JSON`. The clicks are
read from their file beside the video, as `hoigs prepare` reads them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from hoigs.core.clip_folder.format import is_clip_folder
from hoigs.core.errors import HoigsError
from hoigs.core.system.environments import EnvironmentAbsentError
from hoigs.preparation.estimates.plan import EstimatorPlan
from hoigs.preparation.kept import PLAN
from hoigs.preparation.options import PrepareOptions
from hoigs.preparation.prepare import prepare, prepare_until

TRACKED = "object_masks"  # the stage after which all masks are there


def run(
    video: Path, out: Path, options: dict[str, Any], whole: bool, yes: bool, replace: bool
) -> None:
    """Masks alone, or the whole clip."""
    share = 1.0 if whole else _share(TRACKED)

    def progress(done: float, what: str) -> None:
        _say(done=min(1.0, done / share), text=what)

    def announce(plan: EstimatorPlan) -> None:
        rows = {"plan": plan.rows()} if plan.choices else {}
        _say(**rows, notes=plan.notes)

    given = PrepareOptions.model_validate({**options, "overwrite": replace})
    how: dict[str, Any] = {
        "options": given, "yes": yes, "announce": announce, "progress": progress
    }  # fmt: skip
    if not whole:
        prepare_until(TRACKED, video, out, **how)
        return
    report = prepare(video, out, **how)
    _say(rows=report.rows(), warnings=list(report.warnings))


def _share(stage: str) -> float:
    """How much of a whole preparation is done after a stage, 0..1."""
    names = list(PLAN)
    weights = [PLAN[name].weight for name in names]
    return sum(weights[: names.index(stage) + 1]) / sum(weights)


def _say(**event: Any) -> None:
    print(json.dumps(event), flush=True)


def main() -> None:
    given = json.loads(sys.argv[1])
    out = Path(given.pop("out"))
    try:
        run(Path(given.pop("video")), out, **given)
    except EnvironmentAbsentError as error:
        _say(error=str(error), absent=True)
    except HoigsError as error:
        _say(error=str(error), exists=is_clip_folder(out) and not given["replace"])
    else:
        _say(finished=True)


if __name__ == "__main__":
    main()

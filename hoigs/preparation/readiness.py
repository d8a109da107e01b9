"""Before work begins: environments and weights that the plan needs are there, or are fetched."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping

from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import Estimator
from hoigs.core.progress import Progress
from hoigs.preparation.estimator_plan import HUB_LICENCES, EstimatorPlan
from hoigs.preparation.options import Place

Consent = Callable[[str], bool]  # a question to whether the answer is yes


def agree(question: str) -> bool:
    """A Consent that answers yes."""
    return True


def get_ready(
    plan: EstimatorPlan,
    estimators: Mapping[Place, Estimator],
    consent: Consent | None,
    progress: Progress,
) -> None:
    """Installs environments that are absent, and asks before weights are downloaded.

    Raises:
        HoigsError: without consent, with the command that gives it.
    """
    needed = {e.environment.name: e.environment for e in estimators.values()
              if e.environment is not None and not e.commands()}  # fmt: skip
    for environment in needed.values():
        if environment.installed:
            continue
        question = (
            f"This needs {environment.summary}. hoigs installs it once into {environment.folder}; "
            f"`hoigs estimators remove {environment.name}` removes it. Install it now?"
        )
        if consent is None or not consent(question):
            environment.python()  # raises, with what to do
        environment.install(progress)
    wanted = _not_cached(plan)
    if wanted:
        question = (
            f"These networks are downloaded from the Hugging Face hub: {', '.join(wanted)}; "
            f"licences: {HUB_LICENCES}. Download them?"
        )
        if os.environ.get("HF_HUB_OFFLINE", "0").lower() in ("1", "true", "yes", "on"):
            raise HoigsError(
                f"--estimators hub: HF_HUB_OFFLINE is set and {', '.join(wanted)} are not in the "
                "hub's cache; use --estimators offline, or unset it"
            )
        if consent is None or not consent(question):
            raise HoigsError(
                f"--estimators hub needs {', '.join(wanted)}, which are not in the hub's cache; "
                "add --yes to download them, or use --estimators offline"
            )


def _not_cached(plan: EstimatorPlan) -> list[str]:
    """Checkpoints of the plan's networks that have to be downloaded."""
    settings = [spec.settings for spec in plan.specs().values()]
    names = {s[key] for s in settings for key in ("checkpoint", "detector") if key in s}
    if not names:
        return []
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError as error:
        raise HoigsError(
            f"--estimators hub needs transformers ({error}); pip install 'hoigs[estimators]'"
        ) from error
    return sorted(n for n in names if not isinstance(try_to_load_from_cache(n, "config.json"), str))

"""Before work begins: environments and weights that the plan needs are there, or are fetched."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from hoigs.core.environments import hub
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import Estimator
from hoigs.core.progress import Progress
from hoigs.preparation.estimates.plan import HUB_LICENCES, EstimatorPlan
from hoigs.preparation.options.prepare_options import Place

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
    if not wanted:
        return
    names = ", ".join(wanted)
    question = (
        f"These networks are downloaded from the Hugging Face hub: {names}; licences: "
        f"{HUB_LICENCES}. Download them?"
    )
    if hub.offline():
        raise HoigsError(
            f"--estimators hub: HF_HUB_OFFLINE is set and {names} are not whole in the hub's "
            "cache; use --estimators offline, or unset it"
        )
    if consent is None or not consent(question):
        raise HoigsError(
            f"--estimators hub needs {names}, which are not whole in the hub's cache (licences: "
            f"{HUB_LICENCES}); add --yes to download them, or use --estimators offline"
        )
    for done, name in enumerate(wanted):
        progress(done / len(wanted), f"downloading {name}")
        hub.fetched(name)


def _not_cached(plan: EstimatorPlan) -> list[str]:
    """Checkpoints of the plan's networks that have to be downloaded."""
    settings = [spec.settings for spec in plan.specs().values()]
    names = {s[key] for s in settings for key in ("checkpoint", "detector") if key in s}
    return sorted(name for name in names if hub.cached(name) is None)

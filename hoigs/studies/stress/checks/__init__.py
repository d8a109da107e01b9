"""Direct checks by name: `check` of hoigs' own code, `per_spec` of one composed model."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.studies.stress.case import CheckResult

if TYPE_CHECKING:
    from hoigs.studies.stress.bench import Bench

# name of a check in a case -> module of this package and function
CHECKS = {
    f"{module}:{function}": (module, function)
    for module, functions in {
        "motion": ("sparse_knots", "slerp_signs", "slerp_ends", "bar_keeps_its_length",
                   "last_frame", "turns_near_zero", "beyond_one"),
        "camera": ("extent_of_a_static_camera", "depth_factor_found", "scale_about_the_camera",
                   "front_of_a_ball", "cut_masks", "near_plane", "principal_point",
                   "lens_removed"),
        "human": ("twisted_covariances", "hand_convention_found", "gender_refused",
                  "fitted_poses_are_declared"),
        "interaction": ("bounded_pose", "all_masked", "soft_gate", "held_object", "shapes",
                        "shuffled", "near_and_far"),
        "density": ("explosion_capped", "late_reset_refused", "not_all_pruned"),
        "data": ("broken_step_skipped", "broken_depth_masked", "matched_by_name"),
        "published": ("opacity_over_time", "penalty_of_the_table"),
    }.items()
    for function in functions
}  # fmt: skip
PER_SPEC = {
    f"composed:{function}": ("composed", function)
    for function in (
        "before_the_first_frame", "beyond_the_last_frame", "unused_rows", "large_first_splats",
        "static_camera", "empty_and_full_masks", "motion_rate", "two_forwards",
    )
}  # fmt: skip


def check(name: str) -> Callable[[], CheckResult]:
    """A check of hoigs' own code by its name in a case."""
    found: Callable[[], CheckResult] = _load(name, CHECKS)
    return found


def per_spec(name: str) -> Callable[[Bench], CheckResult]:
    """A check of a composed model by its name in a case."""
    found: Callable[[Bench], CheckResult] = _load(name, PER_SPEC)
    return found


def _load(name: str, known: dict[str, tuple[str, str]]) -> Callable[..., CheckResult]:
    if name not in known:
        raise HoigsError(f"no check {name!r}{did_you_mean(name, known)}")
    module, function = known[name]
    loaded: Callable[..., CheckResult] = getattr(
        importlib.import_module(f"{__name__}.{module}"), function
    )
    return loaded

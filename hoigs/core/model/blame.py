"""Failures of a plugin's component, and what it gives in a wrong shape, with its name."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ParamSpec, TypeVar

from torch import Tensor

from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.interfaces.body import PART_NAMES
from hoigs.core.interfaces.features import FeatureExtractor
from hoigs.core.interfaces.interaction import InteractionModule
from hoigs.core.values.tokens import POSE_JOINTS, Residual, Tokens

Args = ParamSpec("Args")
Result = TypeVar("Result")


def name_of(part: object) -> str:
    """The class of a component, as its plugin names it: "acme_bounce.Bounce"."""
    return f"{type(part).__module__}.{type(part).__qualname__}"


def call(
    part: object, role: str, work: Callable[Args, Result], *args: Args.args, **more: Args.kwargs
) -> Result:
    """`work(*args)`, a method of `part`; what a component from elsewhere raises gets its name.

    Exceptions of hoigs' own components pass unchanged.

    Args:
        role: of the part, for the message: "deformation of 'object'".

    Raises:
        PluginError: a component that is not of hoigs raised something.
    """
    try:
        return work(*args, **more)
    except HoigsError:
        raise
    except Exception as error:
        if type(part).__module__.partition(".")[0] == "hoigs":
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        raise PluginError(
            f"{role}: {name_of(part)} raised {type(error).__name__}: {error} "
            f"({Path(last.filename).name}:{last.lineno}); this is a fault of the plugin that it "
            "came with (HOIGS_TRACEBACK=1 shows where)"
        ) from error


def require_tokens(features: FeatureExtractor, name: str, tokens: Tokens, gaussians: int) -> None:
    """Raise PluginError when tokens of the entity `name` have a wrong shape, or are not as many as
    the features declare."""
    found, count = tuple(tokens.features.shape), len(tokens.positions)
    who = f"features of {name!r}: {name_of(features)}"
    if found != (count, features.width) or tuple(tokens.positions.shape) != (count, 3):
        raise PluginError(
            f"{who} gave features {list(found)} at positions {list(tokens.positions.shape)}, "
            f"expected [M, {features.width}], its width, and [M, 3]"
        )
    declared = {"gaussian": gaussians, "part": len(PART_NAMES), "any": count}[features.tokens]
    if count != declared:
        raise PluginError(
            f"{who} declares tokens {features.tokens!r}, that is {declared} here, and gave {count}"
        )


def require_residuals(
    module: InteractionModule,
    residuals: Mapping[str, Residual],
    tokens: Mapping[str, Tokens],
    features: Mapping[str, FeatureExtractor],
    gaussians: Mapping[str, int],
) -> None:
    """Raise PluginError when a residual has another shape than what it corrects: torch would
    broadcast [1, 3], and of any other shape the deformation that applies it would be blamed.

    Args:
        features: by entity. gaussians: number of each entity's.
    """
    who = f"interaction: {name_of(module)}"
    for name, residual in residuals.items():
        if name not in gaussians:
            raise PluginError(
                f"{who} corrects {name!r}; the entities are {', '.join(map(repr, gaussians))}"
            )
        count = gaussians[name]
        if not _has(residual.pose, POSE_JOINTS):
            raise PluginError(
                f"{who} corrects the pose of {name!r} by {_shape(residual.pose)}, expected "
                f"[{POSE_JOINTS}, 3]"
            )
        if _has(residual.means, count):
            continue
        why = ""
        if name in tokens and _has(residual.means, len(tokens[name].features)):
            why = (
                f": the features of {name!r}, {name_of(features[name])}, gave "
                f"{len(tokens[name].features)} tokens, and this interaction needs a token for each "
                "Gaussian; take other features or another interaction"
            )
        raise PluginError(
            f"{who} moves the means of {name!r} by {_shape(residual.means)}, expected "
            f"[{count}, 3], a row for each Gaussian{why}"
        )


def _has(part: Tensor | None, rows: int) -> bool:
    return part is None or tuple(part.shape) == (rows, 3)


def _shape(part: Tensor | None) -> list[int]:
    return [] if part is None else list(part.shape)

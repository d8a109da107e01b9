"""Failures of a plugin's component, with its name."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from hoigs.core.errors import HoigsError, PluginError

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

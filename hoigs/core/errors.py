"""Errors that say what was expected, what came, where, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class HoigsError(Exception):
    """A mistake in the input that a user can mend; the CLI prints it and exits with 2."""


class SpecError(HoigsError):
    """A spec file that cannot be used; the message starts with file:line:column and the key."""


class PluginError(HoigsError):
    """A component that is unknown, broken, conflicting or lacks an extra."""


class ClipError(HoigsError):
    """A clip folder that is absent, partial or inconsistent."""


class CheckpointError(HoigsError):
    """A checkpoint that is damaged or belongs to another spec."""


class CameraError(HoigsError):
    """A broken camera: NaN, skew, a pose that is not rigid, or optics that do not exist."""


class RenderError(HoigsError):
    """Gaussians, a camera or a request that a rasterizer cannot draw."""


class NotFiniteError(HoigsError):
    """A tensor holds NaN or infinity; the message names it."""


class DerivativeError(HoigsError):
    """A second derivative of kernels that have the first only; the message names what has both."""


class Interrupted(KeyboardInterrupt):
    """Work that was stopped by Ctrl-C or SIGTERM; the message says how to go on.

    Attributes:
        code: the exit code that shells expect, 128 + the signal's number.
    """

    def __init__(self, message: str, signal_number: int) -> None:
        super().__init__(message)
        self.code = 128 + signal_number


def require_type(owner: str, argument: str, value: object, expected: type) -> None:
    """Raise TypeError, naming the argument and both types, when `value` is no `expected`."""
    if not isinstance(value, expected):
        kind = "the class" if isinstance(value, type) else "of type"
        raise TypeError(
            f"{owner}: {argument} is {kind} {class_name(value)}, expected {expected.__name__}"
        )


def class_name(part: object) -> str:
    """The name of a class, or of the class of an instance."""
    return part.__name__ if isinstance(part, type) else type(part).__name__


def did_you_mean(name: str, valid: Iterable[str], count: int = 1) -> str:
    """`; did you mean "x"?` with the nearest of `valid`, or "" when nothing is near.

    A kind that all have ("builtin:") is not compared: it would make any two of them alike.
    """
    valid, kind = list(valid), name[: name.rfind(":") + 1]
    shared = kind if all(other.startswith(kind) for other in valid) else ""
    rests = [other.removeprefix(shared) for other in valid]
    found = difflib.get_close_matches(name.removeprefix(shared), rests, n=count, cutoff=0.6)
    near = [shared + rest for rest in found]
    return "; did you mean " + " or ".join(f'"{n}"' for n in near) + "?" if near else ""

"""What a browser may send to the viewer: its camera, keys, and values of the panel's controls.

viser applies every message of a client to its camera and controls without checks. A number that is
not finite, an unknown option or a huge canvas size would reach the viewer and other browsers. So
each message is validated by a schema before viser gets it: numbers are clamped to the bounds of
their control, and unknown messages are dropped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, StrictBool, StrictStr, TypeAdapter

LARGEST = 1 << 20  # bytes of a message
FOV = (0.01, 3.0)  # vertical angle, radians
CANVAS = (16, 4096)  # pixels of a side
NEAREST = 1e-6  # metres to the target, lengths of directions: less has no direction


def _within(bound: float) -> Any:
    """Numbers from -bound to bound: neither NaN nor words, bools or lists."""
    return Field(strict=True, ge=-bound, le=bound, allow_inf_nan=False)


_Length = Annotated[float, _within(1e6)]  # metres
_Plain = Annotated[float, _within(1e18)]
_Vector = tuple[_Length, _Length, _Length]


class _Camera(BaseModel):
    type: Literal["ViewerCameraMessage"]
    wxyz: tuple[_Plain, _Plain, _Plain, _Plain]
    position: _Vector
    look_at: _Vector
    up_direction: _Vector
    fov: _Plain
    near: _Plain
    far: _Plain
    image_width: _Plain
    image_height: _Plain


class _Value(BaseModel):
    value: StrictBool | _Plain | StrictStr | tuple[_Plain, _Plain, _Plain]


class _Update(BaseModel):
    type: Literal["GuiUpdateMessage"]
    uuid: StrictStr
    updates: _Value


class _Command(BaseModel):
    type: Literal["CommandTriggerMessage"]
    uuid: StrictStr


_MESSAGE: TypeAdapter[_Camera | _Update | _Command] = TypeAdapter(
    Annotated[_Camera | _Update | _Command, Field(discriminator="type")]
)


def checked(raw: bytes | str, control: Callable[[str], Any]) -> bytes | None:
    """A message with every value in its bounds; None if it has no place here.

    Args:
        raw: as it came. control: viser's handle of an id, or None.
    """
    import msgspec
    from viser import CommandHandle

    if isinstance(raw, str):
        return None
    try:
        message = _MESSAGE.validate_python(msgspec.msgpack.decode(raw))
    except (msgspec.DecodeError, ValueError, RecursionError):
        return None
    good: BaseModel | None
    match message:
        case _Camera():
            good = _bounded(message)
        case _Command():  # a key
            good = message if isinstance(control(message.uuid), CommandHandle) else None
        case _:
            good = _offered(message, control)
    return None if good is None else msgspec.msgpack.encode(good.model_dump())


def _bounded(camera: _Camera) -> _Camera | None:
    """A camera that can be drawn from; None without a direction."""
    length = math.hypot(*camera.wxyz)
    apart = math.dist(camera.position, camera.look_at)
    if min(length, apart, math.hypot(*camera.up_direction)) < NEAREST:
        return None
    w, x, y, z = (value / length for value in camera.wxyz)
    camera.wxyz = (w, x, y, z)
    camera.fov = min(max(camera.fov, FOV[0]), FOV[1])
    width, height = max(camera.image_width, 1.0), max(camera.image_height, 1.0)
    shrink = min(1.0, CANVAS[1] / max(width, height))
    camera.image_width = max(round(shrink * width), CANVAS[0])
    camera.image_height = max(round(shrink * height), CANVAS[0])
    return camera


def _offered(update: _Update, control: Callable[[str], Any]) -> _Update | None:
    """A value that the control could have given; None otherwise."""
    from viser import (
        GuiButtonGroupHandle,
        GuiButtonHandle,
        GuiCheckboxHandle,
        GuiDropdownHandle,
        GuiRgbHandle,
        GuiSliderHandle,
    )

    handle, value = control(update.uuid), update.updates.value
    match handle, value:
        case ((GuiButtonHandle() | GuiCheckboxHandle()), bool()):
            return update
        case ((GuiDropdownHandle() | GuiButtonGroupHandle()), str()) if value in handle.options:
            return update
        case GuiSliderHandle(), float():
            update.updates.value = min(max(value, float(handle.min)), float(handle.max))
            return update
        case GuiRgbHandle(), (_, _, _):
            r, g, b = (float(min(max(round(channel), 0), 255)) for channel in value)
            update.updates.value = (r, g, b)
            return update
    return None  # no control, or of a kind that the panel does not have

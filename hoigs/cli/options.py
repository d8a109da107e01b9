"""Flags of the command line, made from the options of a verb."""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Callable
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer

from hoigs.core.options import Flag, Options, fields_of

_EMPTY = inspect.Parameter.empty


def flags(options: type[Options]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the flags of its parameter `options`, which receives those that were given."""

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        fields = {name: flag for name, _, flag in fields_of(options)}
        own = inspect.signature(command, eval_str=True).parameters
        made = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=_EMPTY if field.is_required() else field.default,
                annotation=_flag(name, field.annotation, field.metadata, field.description or ""),
            )
            for name, field, flag in fields_of(options)
            if flag is None or flag.names
        ]
        others = [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for name, parameter in own.items()
            if name != "options"
        ]
        every = [*others, *made]

        @functools.wraps(command)
        def called(**values: Any) -> None:
            given = {name: values.pop(name) for name in fields if name in values}
            unset = {parameter.name: parameter.default for parameter in made}
            set_ = {k: v for k, v in given.items() if v not in (None, [], ()) and v != unset[k]}
            places = {name: Flag.names_of(name, fields[name])[0] for name in set_}
            command(**values, options=options.of(None, set_, command.__name__, places))

        called.__signature__ = inspect.Signature(every)  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in every}
        return called

    return decorated


def _flag(name: str, annotation: Any, marks: list[Any], text: str) -> Any:
    """The type of an option on the command line, with its typer.Option."""
    kind, marks = _simple(annotation, marks)
    found = next((mark for mark in marks if isinstance(mark, Flag)), None)
    names = Flag.names_of(name, found)
    least = next((mark.ge for mark in marks if getattr(mark, "ge", None) is not None), None)
    shown = " ".join(text.split()) + (" Repeatable." if get_origin(annotation) is tuple else "")
    if found is not None and found.kind is not None:
        kind = found.kind | None
    option = typer.Option(*names, help=shown, min=least, hidden=found is not None and found.hidden)
    return Annotated[kind, option]


def _simple(annotation: Any, marks: list[Any]) -> tuple[Any, list[Any]]:
    """A type that typer knows: of a union the first, or None; of a tuple a list.

    Also the marks of `Annotated` inside.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        inside = [m for a in arguments[1:] for m in getattr(a, "metadata", [a])]
        return _simple(arguments[0], [*marks, *inside])
    if origin in (Union, types.UnionType):
        kind, marks = _simple(arguments[0], marks)
        return (kind | None if type(None) in arguments else kind), marks
    if origin is tuple:
        kind, marks = _simple(arguments[0], marks)
        return list[kind] | None, marks
    return (str if origin is Literal else annotation), marks

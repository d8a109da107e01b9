"""Options of a verb, declared once as the fields of a class.

The Python function takes them as keywords (`verb`), the command line as flags
(`hoigs.cli.options`), a run's provenance keeps those that were given, and the documentation lists
them by the same descriptions.
"""

from __future__ import annotations

import functools
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from pydantic import ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.registry.settings import spelled
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document, Place

Result = TypeVar("Result")


SHORT = {"out": "-o", "format": "-f", "width": "-w", "device": "-d", "spec": "-s", "jobs": "-j"}


class Flag:
    """How the command line writes an option, where that is not --its-name.

    Args:
        names: declarations, "--set" or "--eval/--no-eval"; none: the option has no flag.
        hidden: leave it out of --help.
        kind: type of what is written, where the option's own validator reads another one.
    """

    def __init__(self, *names: str, hidden: bool = False, kind: type | None = None) -> None:
        self.names, self.hidden, self.kind = names, hidden, kind

    @staticmethod
    def names_of(option: str, flag: Flag | None) -> tuple[str, ...]:
        """How an option is written, with one letter where it has one; empty without a flag."""
        if flag is not None:
            return flag.names
        return (f"--{option.replace('_', '-')}", *filter(None, [SHORT.get(option)]))


class Options(ComponentConfig):
    """Base of the options of a verb: every field has a default, or is required, and a description.

    They never change; `changed` makes others.
    """

    model_config = ConfigDict(frozen=True)

    shown: ClassVar[tuple[str, ...] | None] = None
    """The options that have a flag, in their order; None: all."""

    @classmethod
    def of(
        cls,
        options: Self | None,
        settings: Mapping[str, Any],
        verb: str = "",
        places: Mapping[str, str] | None = None,
    ) -> Self:
        """`options`, or the defaults, with `settings` laid over them.

        Args:
            verb: what they are of, and places: where each setting was given, for messages.

        Raises:
            HoigsError: `options` are of another verb, or a setting is unknown or of the wrong type.
        """
        verb = verb or cls.__name__
        if options is not None and not isinstance(options, cls):
            raise HoigsError(
                f"{verb}: options must be {cls.__name__}, got {type(options).__name__}"
            )
        values = {**(options.given() if options is not None else {}), **settings}
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            where: dict[Place, str] = {(name,): place for name, place in (places or {}).items()}
            document = Document(f"{verb}:", values, values=where)
            raise HoigsError("\n".join(explain(error, cls, document, ()))) from error

    def given(self) -> dict[str, Any]:
        """The options that were set, by name."""
        return {name: getattr(self, name) for name in sorted(self.model_fields_set)}

    def changed(self, **settings: Any) -> Self:
        """These options with other values for some."""
        return self.of(self, settings)

    def part(self, of: type[Other]) -> Other:
        """Those of these options that another verb has too."""
        shared = {k: v for k, v in self.given().items() if k in of.model_fields}
        return of.model_validate(shared)

    def record(self, *without: str) -> dict[str, Any]:
        """What differs from the defaults, as JSON holds it, for a run's provenance."""
        return {
            name: _plain(value)
            for name, value in self.given().items()
            if name not in without and value != type(self).model_fields[name].default
        }

    def words(self) -> list[str]:
        """What differs from the defaults, as words of a command line."""
        found: list[str] = []
        for name, field, flag in fields_of(type(self)):
            value = getattr(self, name)
            for names in Flag.names_of(name, flag)[:1]:
                yes, _, no = names.partition("/")
                if value != field.default and isinstance(value, bool):
                    found.append(yes if value else no)
                elif value != field.default:
                    parts = value if isinstance(value, tuple) else (value,)
                    found += [word for part in parts for word in (yes, str(part))]
        return found


Other = TypeVar("Other", bound=Options)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def fields_of(options: type[Options]) -> Iterator[tuple[str, FieldInfo, Flag | None]]:
    """Name, field and flag of every option, those that several verbs share last."""
    shared = {name for base in options.__mro__[1:] for name in getattr(base, "model_fields", ())}
    names = sorted(options.model_fields, key=shared.__contains__)
    if (shown := options.shown) is not None:
        names.sort(key=lambda name: shown.index(name) if name in shown else len(shown))
    for name in names:
        field = options.model_fields[name]
        flag = next((m for m in field.metadata if isinstance(m, Flag)), None)
        yield name, field, flag if shown is None or name in shown else Flag()


def verb(
    options: type[Options], *positional: str
) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Let a function be called with its options as keywords, or as one object `options`.

    The function has its subject first (a clip, a run), then `options`, then callbacks. Signature
    and docstring of the result have every option.

    Args:
        positional: options that may also be given by place, after the subject.
    """

    def decorated(function: Callable[..., Result]) -> Callable[..., Result]:
        own = inspect.signature(function).parameters
        subjects = list(own)[: list(own).index("options")]
        places = [*subjects, *positional]
        valid = [*own, *options.model_fields]
        label = function.__qualname__

        @functools.wraps(function)
        def called(*args: Any, **settings: Any) -> Result:
            if len(args) > len(places):
                raise TypeError(f"{label}() takes at most {len(places)} arguments by place")
            for name, value in zip(places, args, strict=False):
                if name in settings:
                    raise TypeError(f"{label}() has {name} twice")
                settings[name] = value
            for name in settings:
                if name not in valid:
                    hint = did_you_mean(name, valid) or f" (it has {', '.join(valid)})"
                    raise HoigsError(f"{label}: there is no option {name!r}{hint}")
            passed = {name: settings.pop(name) for name in own if name in settings}
            whole = passed.pop("options", None)
            if settings or not isinstance(whole, options):
                whole = options.of(whole, settings, label)
            return function(**passed, options=whole)

        called.__signature__ = _signature(own, options, places)  # type: ignore[attr-defined]
        called.__doc__ = _documented(function.__doc__ or "", options)
        called.options = options  # type: ignore[attr-defined]
        return called

    return decorated


def _signature(
    own: Mapping[str, inspect.Parameter], options: type[Options], places: list[str]
) -> inspect.Signature:
    """Subject, options by place, and keywords: options, the object of all, and callbacks."""
    fields = {
        name: inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.is_required() else field.default,
            annotation=spelled(field.annotation).replace("path", "Path"),
        )
        for name, field in _listed(options)
    }
    whole = own["options"].replace(
        annotation=f"{options.__name__} | None", default=None, kind=inspect.Parameter.KEYWORD_ONLY
    )
    every = {**fields, **own, "options": whole}
    first = [every[name].replace(kind=inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in places]
    callbacks = [own[name] for name in own if name not in (*places, "options")]
    rest = [f for name, f in fields.items() if name not in places and name not in own]
    rest = [*rest, *callbacks, whole]
    return inspect.Signature([*first, *rest])


def _listed(options: type[Options]) -> list[tuple[str, FieldInfo]]:
    """The options that a signature has; the others can be given as keywords, too."""
    shown = options.shown or options.model_fields
    return [(name, field) for name, field, _ in fields_of(options) if name in shown]


FLAG = re.compile(r"--([a-z][a-z-]*)")


def _keyword(flag: re.Match[str]) -> str:
    """`max_mb`, of "--max-mb"."""
    return f"`{flag[1].replace('-', '_')}`"


def _documented(text: str, options: type[Options]) -> str:
    """A docstring whose section Args has the options too."""
    lines = inspect.cleandoc(text).split("\n")
    if "Args:" not in lines:
        place = next((i for i, line in enumerate(lines) if line == "Raises:"), len(lines))
        lines[place:place] = [*([""] if place == len(lines) else []), "Args:", ""]
    start = lines.index("Args:") + 1
    end = next((i for i in range(start, len(lines)) if not lines[i].strip()), len(lines))
    entries = [
        entry
        for name, field in _listed(options)
        for entry in textwrap.wrap(
            f"{name}: {FLAG.sub(_keyword, field.description or '')}",
            96,
            initial_indent="    ",
            subsequent_indent="        ",
        )
    ]
    whole = f"    options: all of these as one object, {options.__name__}."
    lines[end:end] = [*entries, whole]
    return "\n".join(lines)

"""Configurable: how a class that a spec can name is built from its settings."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, ClassVar, Self

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import did_you_mean

Parameters = dict[str, inspect.Parameter]


class _Signature:
    """`__signature__` of a component: the arguments of its constructor and its settings."""

    def __get__(self, instance: object | None, owner: type[Configurable]) -> inspect.Signature:
        if instance is not None or not takes_settings(owner):
            raise AttributeError("__signature__")  # inspect then reads the constructor's own
        given = _constructor(owner)
        only = inspect.Parameter.KEYWORD_ONLY
        shown = [p for p in given.values() if p.kind is not only]
        for name, field in owner.Config.model_fields.items():
            if name not in given:
                default = field.get_default(call_default_factory=True, validated_data={})
                default = inspect.Parameter.empty if field.is_required() else default
                shown.append(
                    inspect.Parameter(name, only, default=default, annotation=field.annotation)
                )
        shown += [p for p in given.values() if p.kind is only]
        return inspect.Signature(shown)


class Configurable:
    """The base of every interface: settings are declared once, in `Config`.

    A class with settings names its ComponentConfig as `Config` and takes one, or None, as the
    argument `config` of its constructor, the first. Callers give the settings themselves:
    `CubicHermite(keyframes=17, track=track)`, or the config: `CubicHermite(config, track=track)`.
    An argument of the constructor takes precedence over a setting of its name. Further arguments of
    a constructor come from the BuildContext (a body, a track, a clip), so a class that needs it
    overrides `from_config`. A class that names no `Config` gets its settings as keywords.

    Constructors raise TypeError for an argument that they do not have, naming the nearest that they
    do, and for a `config` of another class; pydantic's ValidationError, a ValueError, for a setting
    whose value is not valid.
    """

    Config: ClassVar[type[ComponentConfig]] = ComponentConfig
    __signature__ = _Signature()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        own = cls.__dict__.get("__init__")
        if own is not None and "config" in inspect.signature(own).parameters:
            cls.__init__ = _taking_settings(own)  # type: ignore[method-assign]

    @classmethod
    def from_config(cls, config: Any, context: Any) -> Self:
        """An instance with the settings `config`.

        Args:
            config: a `Config`, or for a class without one any ComponentConfig.
            context: the BuildContext: the clip, the body or the track of the entity that is built.
        """
        del context
        build: Any = cls  # its constructor is the subclass's
        return build(**config.model_dump()) if cls.Config is ComponentConfig else build(config)


def takes_settings(cls: type[Configurable]) -> bool:
    """Whether the constructor takes a `Config`, or its settings one by one."""
    return cls.Config is not ComponentConfig and "config" in _constructor(cls)


def _constructor(cls: type) -> Parameters:
    """Arguments of a class's constructor; those that it passes on to a base as `**given` are the
    base's."""
    found: Parameters = {}
    for base in cls.__mro__:
        own = base.__dict__.get("__init__")
        if own is None:
            continue
        parameters = list(inspect.signature(own).parameters.values())[1:]
        passes_on = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters)
        variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        for p in parameters:
            if p.kind not in variable:
                found.setdefault(p.name, p)
        if not passes_on:
            break
    return found


def _taking_settings(init: Callable[..., None]) -> Callable[..., None]:
    """A constructor that takes a config, which can also be given setting by setting."""

    needed = inspect.signature(init).parameters["config"].default is inspect.Parameter.empty

    @functools.wraps(init)
    def build(self: Any, *args: Any, **kwargs: Any) -> None:
        cls, known = type(self), _constructor(type(self))
        fields = cls.Config.model_fields
        settings = {k: kwargs.pop(k) for k in list(kwargs) if k in fields and k not in known}
        valid = [*(k for k in known if k != "config"), *(k for k in fields if k not in known)]
        unknown = [k for k in kwargs if k not in known]
        if unknown and cls.__init__ is build:
            raise TypeError(
                f"{cls.__name__} has no argument {unknown[0]!r}"
                f"{did_you_mean(unknown[0], valid)} (it has {', '.join(valid) or 'none'})"
            )
        config = args[0] if args else kwargs.get("config")
        if config is not None and not isinstance(config, cls.Config):
            raise TypeError(
                f"{cls.__name__}: config, the first argument, is of type {type(config).__name__}, "
                f"expected {cls.Config.__name__} or None; name the others: "
                f"{', '.join(f'{k}=' for k in valid)}"
            )
        if settings or (needed and config is None):
            if config is not None:
                raise TypeError(
                    f"{cls.__name__} is given a config and {', '.join(settings)}: settings belong "
                    "in one of them"
                )
            args, kwargs = args[1:], {k: v for k, v in kwargs.items() if k != "config"}
            args = (cls.Config(**settings), *args)
        init(self, *args, **kwargs)

    return build

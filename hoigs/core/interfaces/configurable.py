"""Configurable: how a class that a spec can name is built from its settings."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar, Self

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import did_you_mean


class Configurable:
    """The base of every interface: settings are declared once, in `Config`.

    A class with settings names its ComponentConfig as `Config` and takes one as the argument
    `config` of its constructor. Whoever calls the constructor may give the settings by name
    instead: `CubicHermite(keyframes=17, track=track)` is
    `CubicHermite(CubicHermite.Config(keyframes=17), track=track)`. Further arguments of a
    constructor come from the BuildContext (a body, a track, a clip), so a class that needs it
    overrides `from_config`; they take precedence over settings of the same name. A class that names
    no `Config` gets its settings as keywords.
    """

    Config: ClassVar[type[ComponentConfig]] = ComponentConfig

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = cls.__dict__.get("__init__")
        if own is not None and "config" in inspect.signature(own).parameters:
            cls.__init__ = _with_settings(own)  # type: ignore[method-assign]
        if cls.Config is not ComponentConfig:
            cls.__signature__ = _signature(cls)  # type: ignore[attr-defined]

    def __getstate__(self) -> dict[str, Any]:
        """What is copied or pickled: not the graph that a forward pass left in attributes."""
        return {name: _without_graph(value) for name, value in self.__dict__.items()}

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


def _with_settings(own: Callable[..., None]) -> Callable[..., None]:
    """A constructor that also takes the fields of `Config` as keywords."""

    @functools.wraps(own)
    def constructor(self: Any, config: Any = None, *others: Any, **given: Any) -> None:
        kind = type(self)
        if config is not None and not isinstance(config, ComponentConfig):
            raise TypeError(
                f"{kind.__name__}: config: expected a {kind.Config.__name__}, got "
                f"{type(config).__name__}; name the argument that it is for"
            )
        arguments = _arguments(kind)
        settings = {k: given.pop(k) for k in list(given) if k not in arguments}
        if settings:
            known = kind.Config.model_fields
            for name in settings:
                if name not in known:
                    hint = did_you_mean(name, [*arguments, *known])
                    raise TypeError(f"{kind.__name__} has no argument {name!r}{hint}")
            if config is not None:
                raise TypeError(
                    f"{kind.__name__}: {', '.join(settings)} and a config; put all into one of them"
                )
            config = kind.Config(**settings)
        own(self, config, *others, **given)

    return constructor


def _arguments(kind: type) -> dict[str, inspect.Parameter]:
    """The named arguments of a constructor and of those that it passes others on to."""
    found: dict[str, inspect.Parameter] = {}
    for base in kind.__mro__:
        own = base.__dict__.get("__init__")
        if own is None or not issubclass(base, Configurable):
            continue
        parameters = inspect.signature(inspect.unwrap(own)).parameters
        for name, parameter in list(parameters.items())[1:]:
            if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                found.setdefault(name, parameter)
        if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            break
    return found


def _signature(kind: type[Configurable]) -> inspect.Signature:
    """What the constructor takes: its own arguments, then the settings by name."""
    arguments = _arguments(kind)
    keyword = inspect.Parameter.KEYWORD_ONLY
    shown = [p for n, p in arguments.items() if n == "config"]
    shown += [p.replace(kind=keyword) for n, p in arguments.items() if n != "config"]
    for name, field in kind.Config.model_fields.items():
        if "config" in arguments and name not in arguments:
            default = inspect.Parameter.empty if field.is_required() else field.get_default()
            shown.append(
                inspect.Parameter(name, keyword, default=default, annotation=field.annotation)
            )
    return inspect.Signature(shown)


def _without_graph(value: Any) -> Any:
    """A value of an attribute; emptied if it holds a tensor that a computation made."""
    if not _has_graph(value):
        return value
    return {} if isinstance(value, dict) else None


def _has_graph(value: Any) -> bool:
    if isinstance(value, dict):
        return any(map(_has_graph, value.values()))
    if isinstance(value, list | tuple):
        return any(map(_has_graph, value))
    if is_dataclass(value) and not isinstance(value, type):
        return any(_has_graph(getattr(value, f.name, None)) for f in fields(value))
    return getattr(value, "grad_fn", None) is not None

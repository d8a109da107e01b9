"""Configurable: how a class that a spec can name is built from its settings."""

from __future__ import annotations

from typing import Any, ClassVar, Self

from hoigs.core.config import ComponentConfig


class Configurable:
    """The base of every interface: settings are declared once, in `Config`.

    A class with settings names its ComponentConfig as `Config` and takes one as the first argument
    of its constructor: `CubicHermite(CubicHermite.Config(keyframes=17), track=track)`. Further
    arguments of a constructor come from the BuildContext (a body, a track, a clip), so a class that
    needs it overrides `from_config`. A class that names no `Config` gets its settings as keywords.
    """

    Config: ClassVar[type[ComponentConfig]] = ComponentConfig

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

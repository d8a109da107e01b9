"""ClipReader: a folder on disk, in some layout, to a Clip."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from hoigs.core.interfaces.configurable import Configurable
from hoigs.core.values.clip import Clip


class ClipReader(Configurable, ABC):
    """One dataset layout.

    Attributes:
        allow_faults: accept faults that training can do without, and list them in `Clip.faults`.
            Readers may still refuse some; set before `read`.
        general: this layout is part of others; where another reader recognises the folder too, that
            one reads it.
    """

    allow_faults: bool = False
    general: ClassVar[bool] = False

    def __init__(self, config: Any = None) -> None:
        """`config`: a `Config`; by default one with its defaults."""
        self.config = config or self.Config()

    @abstractmethod
    def matches(self, folder: Path) -> bool:
        """Whether `folder` looks like this layout, complete or not."""

    @abstractmethod
    def read(self, folder: Path) -> Clip:
        """The clip, lazily.

        Raises:
            ClipError: naming every absent or inconsistent file and who makes it.
        """

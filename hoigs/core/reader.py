"""ClipReader: a folder on disk, in some layout, to a Clip."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from hoigs.core.clip import Clip

if TYPE_CHECKING:
    from hoigs.core.context import BuildContext


class ClipReader(ABC):
    """One dataset layout.

    Attributes:
        allow_faults: let pass what training can go on without, named in `Clip.faults`. Readers may
            refuse it all the same; set before `read`.
        general: a layout that others contain: where another reader knows a folder too, it reads.
    """

    allow_faults: bool = False
    general: ClassVar[bool] = False

    @classmethod
    def from_config(cls, config: Any, context: BuildContext) -> Self:
        return cls(**config.model_dump())

    @abstractmethod
    def matches(self, folder: Path) -> bool:
        """Whether `folder` looks like this layout, complete or not."""

    @abstractmethod
    def read(self, folder: Path) -> Clip:
        """The clip, lazily.

        Raises:
            ClipError: naming every absent or inconsistent file and who makes it.
        """

"""A plugin with three readers that each look for a file; loaded by path, as --plugin does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.reader import ClipReader
from hoigs.core.registry.component import Component, hookimpl
from hoigs.core.values.clip import Clip


class Settings(ComponentConfig):
    model: Path | None = None
    rate: float = 1.0
    ids: list[int] = Field(default_factory=list)


class First(ClipReader):
    sign = "first.txt"

    def __init__(
        self, model: Path | None = None, rate: float = 1.0, ids: Sequence[int] = ()
    ) -> None:
        self.model, self.rate, self.ids = model, rate, list(ids)

    def matches(self, folder: Path) -> bool:
        return (folder / self.sign).is_file()

    def read(self, folder: Path) -> Clip:
        raise AssertionError("only the choice is tested")


class Second(First):
    sign = "second.txt"


class Wide(First):
    general = True
    sign = "wide.txt"


@hookimpl
def hoigs_components() -> Iterator[Component]:
    for name in ("First", "Second", "Wide"):
        key = f"reader:{name.lower()}"
        yield Component(key, f"{__name__}:{name}", config=f"{__name__}:Settings", summary="a toy")

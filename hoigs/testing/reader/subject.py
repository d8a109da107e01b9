"""ReaderSubject: a reader with its settings, and a folder in its layout if there is one."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.reader import ClipReader
from hoigs.testing.checks import CheckList, ComponentSubject
from hoigs.testing.material.clip import write_tiny_clip

if TYPE_CHECKING:
    from hoigs.testing.runner import Options

IMAGES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class ReaderSubject(ComponentSubject[ClipReader]):
    """The component under check.

    Attributes:
        given: a folder in the reader's layout; None uses a clip folder of hoigs.
    """

    given: Path | None = None

    def reader(self) -> ClipReader:
        return self.cls.from_config(self.config, BuildContext())

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A copy of a clip in its layout, which a check may damage."""
        with tempfile.TemporaryDirectory() as root:
            folder = Path(root) / "clip"
            if self.given is not None:
                shutil.copytree(self.given, folder)
            else:
                write_tiny_clip(folder)
            yield folder

    @cached_property
    def has_folder(self) -> bool:
        if self.given is not None:
            return True
        with self.folder() as folder:
            return bool(self.reader().matches(folder))


CHECKS: CheckList[ReaderSubject] = CheckList("C")


def subject(cls: type[ClipReader], config: Any, options: Options) -> ReaderSubject:
    made = ReaderSubject(cls, config, options.folder)
    made.reader()
    return made


def has_folder(subject: ReaderSubject) -> str | None:
    if subject.has_folder:
        return None
    return "it does not read the clip folder of hoigs: pass a clip in its layout (folder=…)"


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def images_of(folder: Path) -> list[Path]:
    return [path for path in files_of(folder) if path.suffix.lower() in IMAGES]


def has_image_files(subject: ReaderSubject) -> str | None:
    if not subject.has_folder:
        return has_folder(subject)
    with subject.folder() as folder:
        return None if images_of(folder) else "its layout has no image files"

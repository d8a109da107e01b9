"""Folders beside a clip that a killed writer left: nobody reads them, the next run removes them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

RECORD = "writing.json"


class Leftovers:
    """What the writing of one clip leaves beside it if the process is killed.

    Only folders are removed that a run noted before it filled them, or whose names and contents
    are those of a half-replaced clip.

    Args:
        clip: the folder to be made. work: where notes are kept; one process at a time owns it.
    """

    def __init__(self, clip: Path, work: Path) -> None:
        self.clip, self._record = clip, work / RECORD

    def note(self, temporary: Path) -> None:
        """This folder is being filled; called before anything large is in it."""
        half = self._record.with_name("." + RECORD)
        half.write_text(json.dumps({"temporary": temporary.name}), encoding="utf-8")
        half.replace(self._record)

    def remove(self) -> None:
        """Removes what was noted and is still there, and clips that a whole one has replaced."""
        beside = self.clip.parent
        if self._record.is_file():
            name = json.loads(self._record.read_text(encoding="utf-8"))["temporary"]
            folder = beside / name
            if name.startswith(f".{self.clip.name}.") and folder.is_dir():
                shutil.rmtree(folder)
            self._record.unlink()
        if self.clip.is_dir():
            for folder in beside.glob(f".{self.clip.name}.old.*"):
                if [p.name for p in folder.iterdir()] in ([], ["clip"]):
                    shutil.rmtree(folder)

"""Temporary folders beside a clip that a killed process left: the next run removes them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

RECORD = "writing.json"


class Cleanup:
    """Removes what the writing of one clip leaves beside it if the process is killed.

    Only folders are removed that a run registered before it filled them, or whose names and
    contents are those of a half-replaced clip.

    Args:
        clip: the folder to be made. work: the work folder, which one process at a time uses.
    """

    def __init__(self, clip: Path, work: Path) -> None:
        self.clip, self._record = clip, work / RECORD

    def register(self, temporary: Path) -> None:
        """To be called before anything large is in this temporary folder."""
        part = self._record.with_name("." + RECORD)
        part.write_text(json.dumps({"temporary": temporary.name}), encoding="utf-8")
        part.replace(self._record)

    def remove(self) -> None:
        """Removes the registered folder, if it is there, and clips that a new one has replaced."""
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

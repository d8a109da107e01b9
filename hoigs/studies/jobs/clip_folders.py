"""The clips of a study: folder, label and digest of each."""

from __future__ import annotations

from pathlib import Path

from hoigs.core.errors import ClipError
from hoigs.studies.jobs.job import digest_folder


class ClipFolders:
    """Folder, label and digest of each clip, found once."""

    def __init__(self) -> None:
        self.known: dict[str, tuple[Path, str, str]] = {}

    def get(self, clip: str) -> tuple[Path, str, str]:
        """Of a CLIP argument; a built-in clip is generated unless it is cached.

        Raises:
            ClipError: a clip that does not exist.
        """
        from hoigs.runs.clip_source import clip_folder, clip_name

        if clip not in self.known:
            folder = clip_folder(clip)
            if not folder.is_dir():
                raise ClipError(f"{clip}: no such clip folder; `hoigs prepare` makes one")
            folder = folder.resolve()
            self.known[clip] = (folder, clip_name(clip), digest_folder(folder))
        return self.known[clip]

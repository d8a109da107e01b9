"""Readers with one mistake each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import FrameStore
from hoigs.plugins.readers.clip import ClipFolderReader


class Stumbles(ClipFolderReader):
    def matches(self, folder):
        return any(p.name == "clip.json" for p in Path(folder).iterdir())


class LeavesACache(ClipFolderReader):
    def matches(self, folder):
        if Path(folder).is_dir():
            (Path(folder) / ".cache").write_text("seen")
        return super().matches(folder)


class FallsOver(ClipFolderReader):
    def read(self, folder):
        if not Path(folder).exists():
            raise FileNotFoundError(folder)
        return super().read(folder)


class OneAtATime(ClipFolderReader):
    def read(self, folder):
        try:
            return super().read(folder)
        except ClipError as error:
            first = [line for line in str(error).splitlines() if line.startswith("  ")][:1]
            raise ClipError(f"{folder}: {''.join(first)}") from error


class Wrapped(FrameStore):
    def __init__(self, store) -> None:
        self.store = store

    def image(self, position):
        return self.store.image(position)

    def mask(self, entity, position):
        return self.store.mask(entity, position)

    def depth(self, position):
        return self.store.depth(position)


class Floats(Wrapped):
    def image(self, position):
        return self.store.image(position).float()


class FloatPixels(ClipFolderReader):
    def read(self, folder):
        clip = super().read(folder)
        return replace(clip, store=Floats(clip.store))


class SecondsForTimes(ClipFolderReader):
    def read(self, folder):
        clip = super().read(folder)
        return replace(clip, moments=[replace(m, time=2 * m.time) for m in clip.moments])


class Eager(ClipFolderReader):
    def read(self, folder):
        clip = super().read(folder)
        for position in range(len(clip)):
            clip.store.image(position)
        return clip


class LeavesAnIndex(ClipFolderReader):
    def read(self, folder):
        clip = super().read(folder)
        (Path(folder) / "index.txt").write_text("read")
        return clip


class Decoding(Wrapped):
    def __init__(self, store) -> None:
        super().__init__(store)

        def decode(position):
            return store.image(position)

        self.decode = decode

    def image(self, position):
        return self.decode(position)


class KeepsAFunction(ClipFolderReader):
    def read(self, folder):
        clip = super().read(folder)
        return replace(clip, store=Decoding(clip.store))


MUTANTS = {
    "C01": Stumbles,
    "C02": LeavesACache,
    "C03": FallsOver,
    "C04": OneAtATime,
    "C05": FloatPixels,
    "C06": SecondsForTimes,
    "C07": Eager,
    "C08": LeavesAnIndex,
    "C09": KeepsAFunction,
}

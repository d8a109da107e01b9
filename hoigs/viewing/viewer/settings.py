"""Settings: what a person has chosen in the panel; the drawing thread reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hoigs.viewing.viewer.pictures.panes import Layout
from hoigs.viewing.viewer.pictures.run_drawing import Look


@dataclass
class Settings:
    """Every control but the clock's.

    Attributes:
        mode, entities, interaction, background: as in `Look`.
        layout, other: how a second picture is shown, and which: "video" or "run".
        share: see `panes.joined`.
        video: whether the camera is the video's; a drag of the mouse ends it.
        follow: an entity that the camera moves along with, or None.
        overlays: names that are switched on. see_through: draw them over everything.
    """

    mode: str
    entities: set[str]
    interaction: bool = True
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    layout: Layout = "one"
    other: str = "video"
    share: float = 0.5
    video: bool = True
    follow: str | None = None
    overlays: set[str] = field(default_factory=set)
    see_through: bool = False

    @staticmethod
    def initial(modes: Sequence[str], entities: Sequence[str]) -> Settings:
        return Settings(modes[0], set(entities))

    @property
    def look(self) -> Look:
        return Look(self.mode, frozenset(self.entities), self.interaction, self.background)

    @property
    def needs_video(self) -> bool:
        """Whether what is shown exists only from the camera of the video."""
        compared = self.layout != "one" and self.other == "video"
        return compared or self.mode == "error to the video"

    def key(self) -> tuple[object, ...]:
        """Everything that changes the picture."""
        return (
            self.look, self.layout, self.other, self.share, self.video, self.see_through,
            frozenset(self.overlays),
        )  # fmt: skip

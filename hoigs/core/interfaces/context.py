"""BuildContext: what a component may need, besides its config, when a spec is composed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hoigs.core.interfaces.body import BodyModel
    from hoigs.core.interfaces.rasterizer import Rasterizer
    from hoigs.core.values.clip import BodyTrack, Clip, ObjectTrack


@dataclass(frozen=True)
class BuildContext:
    """Given to `from_config`; fields that do not apply are None.

    Attributes:
        entity: name of the entity being built ("" for scene-wide parts).
        clip: the clip being reconstructed.
        body, body_track: for a human. object_track: for an object.
        bodies: body of every modelled human, by entity, for components attached to them.
        rasterizer: the spec's, for initializers that draw.
        seed: for anything random.
    """

    entity: str = ""
    clip: Clip | None = None
    body: BodyModel | None = None
    body_track: BodyTrack | None = None
    object_track: ObjectTrack | None = None
    bodies: Mapping[str, BodyModel] = field(default_factory=dict)
    rasterizer: Rasterizer | None = None
    seed: int = 0

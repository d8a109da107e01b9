from __future__ import annotations

import pytest
from pydantic import ValidationError

from hoigs.synthesis import SceneKnobs


def test_unknown_knobs_and_impossible_values_are_refused() -> None:
    with pytest.raises(ValidationError, match="swing_degree"):
        SceneKnobs.model_validate({"object": {"swing_degree": 3}})
    with pytest.raises(ValidationError, match="motion"):
        SceneKnobs.model_validate({"object": {"motion": "juggled"}})
    with pytest.raises(ValidationError, match=r"edge_samples \(2\) is below samples \(4\)"):
        SceneKnobs(edge_samples=2)


def test_every_knob_changes_the_digest() -> None:
    seen = {SceneKnobs().digest()}
    for change in ({"frames": 65}, {"camera": {"height": 1.5}}, {"noise": {"depth_scale": 1.1}},
                   {"object": {"tilt_degrees": 5}}, {"cloth_thickness": 0.02}):  # fmt: skip
        seen.add(SceneKnobs.model_validate(change).digest())
    assert len(seen) == 6
    assert SceneKnobs().digest() in seen and SceneKnobs().digest("v2") not in seen


def test_tiny_takes_changes() -> None:
    knobs = SceneKnobs.tiny(frames=5, object={"motion": "static"})
    assert (knobs.frames, knobs.width, knobs.object.motion) == (5, 64, "static")

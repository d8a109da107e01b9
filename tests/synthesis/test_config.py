from __future__ import annotations

import pytest
from pydantic import ValidationError

from hoigs.synthesis import SceneConfig


def test_unknown_settings_and_impossible_values_are_refused() -> None:
    with pytest.raises(ValidationError, match="swing_degree"):
        SceneConfig.model_validate({"object": {"swing_degree": 3}})
    with pytest.raises(ValidationError, match="motion"):
        SceneConfig.model_validate({"object": {"motion": "juggled"}})
    with pytest.raises(ValidationError, match=r"edge_samples \(2\) is below samples \(4\)"):
        SceneConfig(edge_samples=2)


def test_every_setting_changes_the_digest() -> None:
    seen = {SceneConfig().digest()}
    for change in ({"frames": 65}, {"camera": {"height": 1.5}}, {"noise": {"depth_scale": 1.1}},
                   {"object": {"tilt_degrees": 5}}, {"cloth_thickness": 0.02}):  # fmt: skip
        seen.add(SceneConfig.model_validate(change).digest())
    assert len(seen) == 6
    assert SceneConfig().digest() in seen and SceneConfig().digest("v2") not in seen


def test_tiny_takes_changes() -> None:
    config = SceneConfig.tiny(frames=5, object={"motion": "static"})
    assert (config.frames, config.width, config.object.motion) == (5, 64, "static")

"""Constructors of components take their settings, and show them."""

from __future__ import annotations

import inspect

import pytest

import hoigs as h
from hoigs.core.registry.registry import default_registry
from hoigs.testing.material import object_track

TRACK = object_track()


def test_settings_are_arguments_beside_the_constructors_own() -> None:
    made = h.CubicHermite(keyframes=17, opacity="constant", track=TRACK)
    assert made.keyframes == 17 and made.config == h.CubicHermite.Config(
        keyframes=17, opacity="constant"
    )
    assert made.input_space == "canonical"  # `track` is the object's track, not the setting
    same = h.CubicHermite(h.CubicHermite.Config(keyframes=17, opacity="constant"), track=TRACK)
    assert same.config == made.config


def test_the_signature_lists_them() -> None:
    shown = inspect.signature(h.CubicHermite).parameters
    assert next(iter(shown)) == "config"
    assert {"keyframes", "keyframe_step", "num_frames", "track", "cameras"} <= set(shown)
    assert shown["keyframe_step"].default == 4
    assert shown["track"].default is None  # the constructor's, not the setting's True
    required = inspect.signature(h.SmplxBody).parameters["path"]
    assert required.default is inspect.Parameter.empty


def test_every_component_that_takes_a_config_shows_its_settings() -> None:
    registry = default_registry()
    for key in sorted(registry.keys()):
        cls = registry.get(key)
        shown = inspect.signature(cls).parameters
        if "config" in shown:
            assert set(registry.config_class(key).model_fields) <= set(shown), key


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda: h.CubicHermite(TRACK), ("config", "ObjectTrack", "CubicHermiteConfig", "track=")),
        (lambda: h.CubicHermite(keyframe=3), ("CubicHermite", "'keyframe'", '"keyframes"')),
        (lambda: h.CubicHermite(h.CubicHermite.Config(), keyframes=3), ("keyframes",)),
        (lambda: h.CrossAttention({"width": 3}), ("dict", "CrossAttentionConfig")),
    ],
)
def test_wrong_arguments_are_named(make, facts) -> None:
    with pytest.raises(TypeError) as caught:
        make()
    for fact in facts:
        assert fact in str(caught.value)


def test_a_wrong_value_is_named() -> None:
    with pytest.raises(ValueError, match="width"):
        h.CrossAttention(width=-1)


class Config(h.ComponentConfig):
    size: int = 2


class Base(h.DeformationModel):
    Config = Config

    def __init__(self, config: Config | None = None, *, hidden: int = 1) -> None:
        super().__init__()
        self.config, self.hidden = config or self.Config(), hidden

    def forward(self, canonical, moment, residual=None):
        return canonical


class Narrower(Base):
    """Gives an argument of its base itself."""

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config, hidden=7)


def test_a_subclass_may_give_arguments_of_its_base() -> None:
    made = Narrower(size=5)
    assert (made.config.size, made.hidden) == (5, 7)
    with pytest.raises(TypeError, match="hidden"):
        Narrower(hidden=3)

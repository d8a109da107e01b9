"""The ports of examples/papers: short, right by the conformance checks, and started as they say."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import hoigs as h
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.model.compose import compose_objectives
from hoigs.core.registry.manager import PluginManager
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.schema import Spec
from hoigs.testing import decoder, deformation
from hoigs.testing.checks import run_checks
from hoigs.testing.material import OBJECT, object_track, tiny_clip
from hoigs.testing.runner import Options

PAPERS = Path(__file__).parents[1] / "examples" / "papers"
STG, SOM = PAPERS / "spacetime_gaussians.py", PAPERS / "shape_of_motion.py"


def _registry() -> Registry:
    """One of its own: what a user's file adds to that of the process stays there."""
    manager = PluginManager()
    manager.load_installed()
    for path in (STG, SOM):
        manager.load_file(path)
    return Registry(manager)


REGISTRY = _registry()


@pytest.mark.parametrize("file", [STG, SOM], ids=lambda file: file.stem)
def test_a_port_is_an_afternoon_long(file):
    assert len(file.read_text().splitlines()) <= 150


@pytest.mark.parametrize(
    ("key", "kit"),
    [
        ("deformation:spacetime-polynomial", deformation),
        ("deformation:se3-bases", deformation),
        ("decoder:spacetime-features", decoder),
    ],
)
def test_conforms(key, kit):
    made = kit.subject(REGISTRY.get(key), REGISTRY.config_class(key)(), Options())
    report = run_checks(kit.CHECKS, made)
    assert report.ok and report.run > 10, report


def test_spacetime_opacity_peaks_at_its_own_time():
    module = runpy.run_path(str(STG))["SpacetimePolynomial"]()
    canonical = h.Gaussians.from_points(torch.zeros(1, 3), scales=0.1, opacity=0.8)
    cloud = h.Entity(canonical, module)
    module.center.data.fill_(0.6)
    module.log_sharpness.data.fill_(np.log(2.0))
    module.motion.data[0, 1, 0] = 1.0  # b_2: 1 m (t - mu)^2
    with torch.no_grad():
        at = {time: cloud(h.Moment(time)) for time in (0.1, 0.6)}
    torch.testing.assert_close(at[0.6].opacities, torch.tensor([0.8]))
    torch.testing.assert_close(at[0.1].opacities, 0.8 * torch.tensor([-2 * 0.25]).exp())
    assert float(at[0.1].means[0, 0]) == pytest.approx(0.25)


def test_bases_start_with_the_motion_that_is_known():
    track = object_track()
    context = BuildContext(OBJECT, tiny_clip(), object_track=track)
    cls = REGISTRY.get("deformation:se3-bases")
    first = int(track.observed.nonzero()[0])
    points = track.points @ track.rotations[first].mT + track.translations[first]
    moving = h.Entity(h.Gaussians.from_points(points), cls.from_config(cls.Config(), context))
    for position in (0, 5):
        with torch.no_grad():
            means = moving(h.Moment(position / (len(track.translations) - 1))).means
        wanted = track.points @ track.rotations[position].mT + track.translations[position]
        torch.testing.assert_close(means, wanted, atol=1e-4, rtol=0)


def test_tracks_of_a_clip_are_where_its_points_are_seen(tmp_path):
    clip = replace(tiny_clip(), kinds={OBJECT: "object"}, bodies={})
    runpy.run_path(str(SOM))["write_tracks"](clip, tmp_path / "tracks.npz", 5)
    found = np.load(tmp_path / "tracks.npz")
    assert found["xy"].shape == (len(clip), 5, 2) and found["visible"].dtype == bool
    settings = [f"objectives.tracks.path={tmp_path / 'tracks.npz'}"]
    spec = Spec.load(PAPERS / "shape-of-motion.yaml", overrides=settings, registry=REGISTRY)
    (term,) = compose_objectives(spec, clip, REGISTRY)
    assert term.name == "tracks" and term.weight == 2.0

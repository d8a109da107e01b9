"""Every built-in component conforms; settings without defaults are set here."""

from __future__ import annotations

import pytest

from hoigs.core.registry.registry import default_registry
from hoigs.testing import Options, Outcome
from hoigs.testing.plugin import probe_targets
from hoigs.testing.runner import KINDS, Candidate

REGISTRY = default_registry()
HUMAN = "deformation:hexplane-skinning"
SMALL = {  # smaller, but the same code
    "deformation:hexplane-field": {"channels": 2, "resolution": 8, "width": 16, "multires": [1, 2]},
    HUMAN: {"resolution": 16, "channels": 4, "width": 16},
    "deformation:triplane-avatar": {"resolution": 16, "channels": 4, "width": 16},
    "deformation:mlp": {"width": 32, "depth": 4},
    "deformation:se3-field": {"width": 32},
    "deformation:static-dynamic": {"width": 32},
    "density:adc": {"cap": 300},
    "density:absgrad": {"cap": 300},
    "density:mcmc": {"cap": 300},
    "density:budget": {"count": 300},
}
PLANES = {"channels": 4, "resolution": 6, "multires": [1, 2], "width": 12}
TABLE = {"embedding": 5, "table": 8, "rows": 9, "coarse_rows": 3, "width": 12, "neighbours": 4}
SE3 = {"width": 12, "depth": 3, "skip": 2}
FREQUENCIES = {"position_frequencies": 3, "time_frequencies": 3}
HEADS = ["means", "scales", "rotations", "opacity", "sh"]
FIELDS = [  # in settings that change what they compute
    ("deformation:hexplane-field", PLANES | {"time_resolution": 5, "depth": 2, "heads": HEADS}),
    (
        "deformation:hexplane-field",
        PLANES | {"time_resolution": 9, "time_span": "half", "turning": "added"},
    ),
    ("deformation:embedded", TABLE | {"depth": 2, "heads": HEADS}),
    ("deformation:embedded", TABLE | {"turning": "added", "table_smoothness": "last-row"}),
    ("deformation:se3-field", SE3 | {"elastic_points": 9}),
    ("deformation:se3-field", SE3 | {"ambient": 2, "ambient_depth": 2, "ambient_width": 8}),
    (
        "deformation:mlp",
        FREQUENCIES
        | {"width": 12, "depth": 4, "track": False, "zero_heads": False}
        | {"space": "activated", "turning": "added"},
    ),
]
# rasterizers are in tests/rasterizers/test_conformance.py; these need a user's file
ELSEWHERE = {"body:smplx", "body:smpl", "body:smplh", "objective:tracks"}
KEYS = [
    key
    for key in sorted(REGISTRY.keys())
    if key.partition(":")[0] in set(KINDS) - {"rasterizer"} and key not in ELSEWHERE
]


@pytest.fixture(scope="module", autouse=True)
def _imported_at_once() -> None:
    probe_targets(REGISTRY.component(key).target.partition(":")[0] for key in KEYS)


@pytest.mark.parametrize(
    ("key", "settings"),
    [(key, SMALL.get(key, {})) for key in KEYS]
    + [  # as the spec hoigs has them
        ("interaction:cross-attention", {"places": "hands"}),
        (HUMAN, SMALL[HUMAN] | {"free_attributes": "all", "nonrigid": True, "light": True}),
        (HUMAN, SMALL[HUMAN] | {"free_attributes": "all", "nonrigid": "shading", "light": True}),
        ("deformation:tracked-chs", {"light": True, "opacity": "constant"}),
        *FIELDS,
    ],
)
def test_conforms(key, settings) -> None:
    report = Candidate(key, Options(settings), REGISTRY).report()
    assert report.ok, report
    assert report.run - report.count(Outcome.EXPECTED_FAILURE) == report.count(Outcome.PASSED)

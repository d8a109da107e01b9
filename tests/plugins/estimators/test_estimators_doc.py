"""docs/reference/estimators.md: every block of options parses and builds, the paper's table too."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import pytest
import yaml
from estimator_cases import frame, request

from hoigs.core.errors import SpecError
from hoigs.core.interfaces.estimator import (
    EntityMasks,
    EntityRequest,
    Estimates,
    Estimator,
    LazyFrames,
    checked,
)
from hoigs.core.registry.registry import default_registry
from hoigs.core.reporting import no_progress
from hoigs.core.spec.schema import Spec
from hoigs.plugins.estimators.command import CommandEstimator
from hoigs.plugins.estimators.masks_files import MasksFilesEstimator
from hoigs.preparation.estimates.installed import installed_estimators, load_options

DOC = (Path(__file__).parents[3] / "docs/reference/estimators.md").read_text()
BLOCKS = re.findall(r"```yaml\n(.*?)```", DOC, re.S)
NAMED = {b.split()[1]: yaml.safe_load(b) for b in BLOCKS if b.startswith("# ")}
MASKS = ("samurai", "sam2", "trackanything", "maskrcnn")
DEPTH = ("metric3d", "videodepthanything", "depthcrafter")


def built(options: dict, folder: Path) -> dict[str, Estimator]:
    """Options as `hoigs prepare --options FILE` reads them, and the estimators that they name."""
    path = folder / "options.yaml"
    path.write_text(yaml.safe_dump(options))
    return installed_estimators(load_options(path).estimators)


@pytest.mark.parametrize("block", BLOCKS)
def test_every_block_of_options_builds(tmp_path, block):
    options = yaml.safe_load(block)
    estimators = built(options, tmp_path)
    assert set(estimators) == set(options["estimators"])
    for kind, estimator in estimators.items():
        assert kind in estimator.provides


@pytest.mark.parametrize(("masks", "depth"), list(product(MASKS, DEPTH)))
def test_every_row_of_the_papers_table_builds(tmp_path, masks, depth):
    one, other = NAMED[masks], NAMED[depth]
    options = one | {"estimators": one["estimators"] | other["estimators"]}
    estimators = built(options, tmp_path)
    assert set(estimators) == {"masks", "depth"}
    assert "masks" in estimators["masks"].provides and "depth" in estimators["depth"].provides
    if masks == "trackanything":
        assert isinstance(estimators["masks"], MasksFilesEstimator)
        assert estimators["masks"].config.names == {"human": 1, "object": 2}
    assert isinstance(estimators["depth"], CommandEstimator)
    # metres and disparity are not mixed up
    assert estimators["depth"].readers[0].config.kind == (
        "metric" if depth == "metric3d" else "disparity"
    )


def test_the_table_names_all_choices():
    assert set(NAMED) == {*MASKS, *DEPTH}


def test_all_estimators_are_in_the_doc():
    keys = default_registry().keys("estimator")
    assert len(keys) == 9
    for key in keys:
        assert f"`{key}`" in DOC, key


def test_the_example_works(tmp_path):
    code = re.search(r"```python\n(.*?)```", DOC, re.S).group(1)
    names = {
        "Estimator": Estimator, "LazyFrames": LazyFrames, "Estimates": Estimates,
        "EntityMasks": EntityMasks, "no_progress": no_progress,
    }  # fmt: skip
    exec(code, names)
    video, estimator = request(tmp_path, entities=(EntityRequest("object"),)), names["Threshold"]()
    masks = checked(estimator.estimate(video), video, estimator).masks
    assert (masks.entities["object"][1] == (frame(1).mean(-1) > 200)).all()


def test_an_estimator_initializes_no_object():
    with pytest.raises(SpecError, match=r'"estimator:masks-files" is no initializer \(known: '):
        Spec.load("hoigs", overrides=["model.object.initializer.use=estimator:masks-files"])

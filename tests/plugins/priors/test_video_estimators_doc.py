"""docs/reference/estimators.md: every block of options parses and builds, the paper's table too."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import pytest
import yaml
from video_support import frame, request

from hoigs.core.compose import compose
from hoigs.core.errors import SpecError
from hoigs.core.registry import default_registry
from hoigs.core.spec import Spec
from hoigs.core.video_prior import (
    EntityMasks,
    EntityRequest,
    Evidence,
    LazyFrames,
    VideoPrior,
    checked,
    no_progress,
)
from hoigs.plugins.priors.video_command import CommandPrior
from hoigs.plugins.priors.video_masks_files import MasksFilesPrior
from hoigs.preparation.settings import installed_priors, load_options

DOC = (Path(__file__).parents[3] / "docs/reference/estimators.md").read_text()
BLOCKS = re.findall(r"```yaml\n(.*?)```", DOC, re.S)
NAMED = {b.split()[1]: yaml.safe_load(b) for b in BLOCKS if b.startswith("# ")}
MASKS = ("samurai", "sam2", "trackanything", "maskrcnn")
DEPTH = ("metric3d", "videodepthanything", "depthcrafter")


def built(options: dict, folder: Path) -> dict[str, VideoPrior]:
    """Options as `hoigs prepare --options FILE` reads them, and the priors that they name."""
    path = folder / "options.yaml"
    path.write_text(yaml.safe_dump(options))
    return installed_priors(load_options(path))


@pytest.mark.parametrize("block", BLOCKS)
def test_every_block_of_options_builds(tmp_path, block):
    options = yaml.safe_load(block)
    priors = built(options, tmp_path)
    assert set(priors) == set(options["priors"])
    for kind, prior in priors.items():
        assert kind in prior.provides


@pytest.mark.parametrize(("masks", "depth"), list(product(MASKS, DEPTH)))
def test_every_row_of_the_papers_table_builds(tmp_path, masks, depth):
    one, other = NAMED[masks], NAMED[depth]
    options = one | {"priors": one["priors"] | other["priors"]}
    priors = built(options, tmp_path)
    assert set(priors) == {"masks", "depth"}
    assert "masks" in priors["masks"].provides and "depth" in priors["depth"].provides
    if masks == "trackanything":
        assert isinstance(priors["masks"], MasksFilesPrior)
        assert priors["masks"].names == {"human": 1, "object": 2}
    assert isinstance(priors["depth"], CommandPrior)
    # metres and disparity are not mixed up
    assert priors["depth"].readers[0].kind == ("metric" if depth == "metric3d" else "disparity")


def test_the_table_names_all_choices():
    assert set(NAMED) == {*MASKS, *DEPTH}


def test_all_video_priors_are_in_the_doc():
    registry = default_registry()
    keys = [o.component for o in registry.manager.offers if o.key.startswith("prior:")]
    video = [c.key for c in keys if ".video_" in c.target]
    assert len(video) == 8
    for key in video:
        assert f"`{key}`" in DOC, key


def test_the_example_prior_works(tmp_path):
    code = re.search(r"```python\n(.*?)```", DOC, re.S).group(1)
    names = {
        "VideoPrior": VideoPrior, "LazyFrames": LazyFrames, "Evidence": Evidence,
        "EntityMasks": EntityMasks, "no_progress": no_progress,
    }  # fmt: skip
    exec(code, names)
    video, prior = request(tmp_path, entities=(EntityRequest("object"),)), names["Threshold"]()
    masks = checked(prior.estimate(video), video, prior).masks
    assert (masks.entities["object"][1] == (frame(1).mean(-1) > 200)).all()


def test_a_video_prior_makes_no_object(clip):
    spec = Spec.load("hoigs", overrides=["model.object.prior.use=prior:masks-files"])
    with pytest.raises(SpecError, match=r"prior:masks-files speaks of videos, for `hoigs prepare`"):
        compose(spec, clip)

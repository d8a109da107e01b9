"""hoigs.auto from the search to the compressed twin, without a command line."""

from __future__ import annotations

import json

import pytest
from small_models import GIVEN, NAME

import hoigs
from hoigs.core.errors import HoigsError


@pytest.mark.slow
def test_auto_searches_trains_prunes_and_compresses(tmp_path, monkeypatch):
    monkeypatch.setenv("HOIGS_CACHE", str(tmp_path / "cache"))
    out, lines, order = tmp_path / "mine", [], []
    made = hoigs.auto(
        NAME, out=out, overrides=(*GIVEN, "train.steps=24"), rasterizer="warp", device="cpu",
        evaluate=False, on_found=order.append, on_start=order.append, report=lines.append,
    )  # fmt: skip
    assert order == [made.needs, made.run.session], "the search is known before the training"
    assert made.run.path == out and made.run.evaluated is None
    assert made.needs is not None and made.run.session.spec.model_hash() == (
        made.needs.spec.model_hash()
    )
    answers = {answer.space.name: answer for answer in made.needs.answers}
    assert answers["human"].chosen.name == "planes" and not answers["human"].steps
    assert answers["scene splats"].chosen is None, "fewer splats are for --smallest"
    data = json.loads((made.answer / "needs.json").read_text())
    assert data["after"]["bytes"][1] == made.after.compacted.bytes_after
    full, small = hoigs.open_run(out, device="cpu"), hoigs.open_run(made.compact, device="cpu")
    assert full.model.count() == small.model.count() and full.provenance["pruned"]
    assert lines[0] == f"what {full.clip.name} needs of hoigs:" and f"pruning {out}:" in lines

    with pytest.raises(HoigsError, match="pruned"):
        hoigs.auto(NAME, out=out, resume=True)
    with pytest.raises(HoigsError, match="--auto"):
        hoigs.auto(NAME, out=tmp_path / "other", resume=True)
    with pytest.raises(HoigsError, match="already exists"):
        hoigs.auto(NAME, out=out)


def test_needs_refuses_what_it_does_not_know(tmp_path):
    for wrong, words in (({"share": 0.5}, "share.*0.5"), ({"least": -1.0}, "least.*-1")):
        with pytest.raises(HoigsError, match=words):
            hoigs.needs(NAME, out=tmp_path / "answer", **wrong)
    assert not (tmp_path / "answer").exists()

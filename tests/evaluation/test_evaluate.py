"""Scores of a model that is known to be right, and of ones spoiled in known ways."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hoigs.core.model.scene import SceneModel
from hoigs.core.values.clip import Clip, ObjectTrack
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.protocol import NotComputed
from hoigs.evaluation.scores import METRICS
from hoigs.metrics.psnr import psnr
from hoigs.metrics.regions import REGIONS

QUICK = {"timing_frames": 0}


def number(value: float | NotComputed) -> float:
    assert isinstance(value, float), value
    return value


def test_the_truth_scores_at_the_limit_of_eight_bits(model: SceneModel, clip: Clip) -> None:
    evaluation = score(model, clip, **QUICK)
    assert [view.name for view in evaluation.views] == ["test frames", "held-out cameras"]
    for region in REGIONS:
        # the clip is rounded to 8 bits: an error of 1/sqrt(12) steps is 58.9 dB
        assert 57.0 < number(evaluation.score(region, "psnr")) < 61.0
        assert number(evaluation.score(region, "ssim")) > 0.999
        assert number(evaluation.score(region, "depth", "held-out cameras")) < 1e-4
    rounded = score(model, clip, pixels="8-bit", **QUICK)
    assert number(rounded.score("full", "psnr")) == pytest.approx(100.0)
    assert rounded.views[0].protocol.pixels == "8-bit"


def test_the_mean_is_the_mean_of_the_frames(model: SceneModel, clip: Clip) -> None:
    model.entity("wall").sh.data += 0.3
    evaluation = score(model, clip, **QUICK)
    expected = []
    for position in clip.split["test"]:
        frame = clip[position]
        with torch.no_grad():
            color = model.render(frame.moment, frame.camera).color.clamp(0, 1)
        expected.append(float(psnr(color, frame.rgb)))
    assert number(evaluation.score("full", "psnr")) == pytest.approx(np.mean(expected))
    assert [f.index for f in evaluation.views[0].frames] == list(clip.split["test"])


def test_damage_shows_in_its_own_region(model: SceneModel, clip: Clip) -> None:
    model.entity("ball").sh.data += 1.0
    evaluation = score(model, clip, **QUICK)
    assert number(evaluation.score("object", "psnr")) < 20
    assert number(evaluation.score("human", "psnr")) > 35
    assert number(evaluation.score("object", "psnr")) < number(
        evaluation.score("interaction", "psnr")
    )
    assert number(evaluation.score("background", "psnr")) > 30


def test_depth_error_is_in_metres(model: SceneModel, clip: Clip) -> None:
    for name in model.entities:
        model.entity(name).means.data[:, 2] += 0.1
    evaluation = score(model, clip, **QUICK)
    assert number(evaluation.score("background", "depth")) == pytest.approx(0.1, abs=0.02)
    relative = score(model, replace(clip, depth_kind="affine-disparity"), **QUICK)
    assert "affine-disparity" in str(relative.score("full", "depth"))


def test_what_cannot_be_computed_says_why(model: SceneModel, clip: Clip) -> None:
    evaluation = score(model, clip, held_out=False, **QUICK)
    assert len(evaluation.views) == 1
    assert "HOIGS_LPIPS_WEIGHTS" in str(evaluation.score("full", "lpips"))
    alone = replace(clip, kinds={"man": "human"}, held_out=None)
    evaluation = score(model, alone, **QUICK)
    assert "no object" in str(evaluation.score("object", "psnr"))
    assert "no object" in str(evaluation.score("interaction", "ssim"))
    with pytest.raises(KeyError, match="human_object"):
        evaluation.score("human_objet", "psnr")
    with pytest.raises(ValueError, match='did you mean "test"'):
        score(model, clip, split="tests", **QUICK)


def test_a_broken_render_is_reported_not_averaged(model: SceneModel, clip: Clip) -> None:
    class Broken(type(model.rasterizer)):  # type: ignore[misc]
        def render(self, gaussians, camera, request=None):
            output = super().render(gaussians, camera, request)
            return replace(output, color=output.color * torch.nan)

    model.rasterizer = Broken()
    evaluation = score(model, clip, **QUICK)
    assert "not finite" in str(evaluation.score("full", "psnr"))


def test_lpips_of_regions(model: SceneModel, clip: Clip, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
    arrays = {}
    for i, (out, inner, k) in enumerate(shapes):
        arrays[f"conv{i}_w"] = torch.randn(out, inner, k, k, generator=generator).half() * 0.02
        arrays[f"conv{i}_b"] = torch.zeros(out).half()
        arrays[f"lin{i}"] = torch.ones(out).half()
    weights = tmp_path / "alex.npz"
    np.savez(weights, **{k: v.numpy() for k, v in arrays.items()})
    model.entity("ball").sh.data += 1.0
    evaluation = score(model, clip, lpips_weights=weights, **QUICK)
    assert evaluation.views[0].protocol.lpips_net == "alex"
    assert number(evaluation.score("object", "lpips")) > number(
        evaluation.score("background", "lpips")
    )


def test_times_and_sizes(model: SceneModel, clip: Clip) -> None:
    shares: list[float] = []
    evaluation = score(
        model,
        clip,
        timing_frames=5,
        timing_warmup=2,
        progress=lambda done, text: shares.append(done),
    )
    timing = evaluation.timing
    assert not isinstance(timing, NotComputed)
    assert (timing.frames, timing.warmup) == (5, 2)
    assert 0 < timing.deform_ms < timing.total_ms
    assert 0 < timing.raster_ms < timing.total_ms
    assert 0 < timing.drawn <= 240
    assert shares == sorted(shares) and shares[-1] == 1.0
    sizes = {part.name: part for part in evaluation.sizes}
    assert sizes["man"].gaussians == 60
    # 3 means, 4 quats, 3 scales, 1 opacity, 3 colour, and the amplitude of the swing
    assert sizes["man"].parameters == 60 * 14 + 1
    assert sizes["man"].megabytes == pytest.approx(4e-6 * (60 * 14 + 1))


def test_a_spent_budget_is_confessed(model: SceneModel, clip: Clip) -> None:
    timing = score(model, clip, timing_frames=50, timing_budget_s=0.0).timing
    assert not isinstance(timing, NotComputed)
    assert timing.frames == 3 and "stopped" in timing.note


def test_json_holds_a_protocol_with_every_score(
    model: SceneModel, clip: Clip, tmp_path: Path
) -> None:
    evaluation = score(model, clip, timing_frames=3, timing_warmup=1, test_pose="fitted")
    evaluation.save(tmp_path / "evaluation.json")
    assert [p.name for p in tmp_path.iterdir()] == ["evaluation.json"]
    record = json.loads((tmp_path / "evaluation.json").read_text())
    assert len(record["scores"]) == 2 * len(REGIONS) * len(METRICS)
    for one in record["scores"]:
        assert one["protocol"]["region"] == one["region"]
        assert one["protocol"]["test_pose"] == "fitted"
        assert one["protocol"]["rasterizer"] == "TorchRasterizer"
        assert isinstance(one["value"], float) or one["value"]["not_computed"]
    by_view = {s["view"]: s["protocol"] for s in record["scores"]}
    assert by_view["test frames"]["unseen_times"] == 2
    assert by_view["held-out cameras"]["unseen_times"] == 1  # frame 4 was trained on
    assert record["timing"]["frames"] == 3


def test_tables_are_rectangular_and_explain_gaps(model: SceneModel, clip: Clip) -> None:
    alone = replace(clip, kinds={"man": "human"}, held_out=None)
    judged = score(model, alone, timing_frames=3, timing_warmup=0)
    scores, geometry, times, sizes = judged.tables()
    for table in (scores, geometry, times, sizes):
        assert all(len(row) == len(table.columns) for row in table.rows)
    assert "LPIPS ↓" not in scores.columns and any("lpips" in note for note in scores.notes)
    row = next(row for row in scores.rows if row[0] == "object")
    assert set(row[1:]) == {"0", "–"}
    assert any(note.startswith("object: not computed") for note in scores.notes)
    assert sizes.rows[-1][0] == "total" and sizes.rows[-1][2] == "240"


def test_scores_say_that_object_poses_are_given(model: SceneModel, clip: Clip) -> None:
    bare = replace(clip, objects={}, held_out=None)
    track = ObjectTrack(
        points=torch.zeros(1, 3), colors=torch.zeros(1, 3),
        rotations=torch.eye(3).expand(len(clip), 3, 3),
        translations=torch.zeros(len(clip), 3),
        observed=torch.ones(len(clip), dtype=torch.bool), provenance="test",
    )  # fmt: skip
    tracked = replace(bare, objects={"ball": track})
    for made, word, told in (
        (bare, "", "cameras, body poses given"),
        (tracked, "object poses: given", "cameras, body and object poses given"),
    ):
        protocol = score(model, made, **QUICK).views[0].protocol
        notes = " ".join(protocol.footnotes())
        assert word in notes and ("object poses" in notes) == bool(word)
        assert protocol.given() == told
    moved = replace(protocol, test_camera="fitted", test_pose="interpolated")
    assert moved.given() == "object poses given"
    assert replace(moved, object_poses="").given() == ""

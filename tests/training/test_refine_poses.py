"""Body poses of a clip, corrected by drawing all its frames."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from hoigs import refine_poses
from hoigs.core.errors import ClipError, SpecError
from hoigs.core.values.clip import Clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin_clip


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A clip with every pose given, and the same with errors of each frame's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        noise = {"pose_degrees": 3.0, "pose_metres": 0.03}
        exact, noisy = (
            builtin_clip(AnnyBody(), SceneConfig.tiny(width=96, height=96, **more))
            for more in ({}, {"noise": noise})
        )
    return exact, noisy


def across(clip: Clip, truth: Clip, body: AnnyBody) -> float:
    """Mean distance of the joints across the view, millimetres."""
    far = []
    for own, true, camera in zip(clip.moments, truth.moments, truth.cameras, strict=True):
        pair = (body(m.poses["human"]).joints for m in (own, true))
        apart = torch.sub(*(camera.to_camera(joints) for joints in pair))
        far.append(apart[:, :2].norm(dim=-1).mean())
    return 1000 * float(torch.stack(far).mean())


def test_joints_come_nearer_in_frames_of_either_split(
    clips: tuple[Path, Path], tmp_path: Path
) -> None:
    exact, noisy = (ClipFolderReader().read(folder) for folder in clips)
    done = refine_poses(clips[1], tmp_path / "refined", steps=240, width=96, device="cpu")
    refined, body = ClipFolderReader().read(done.path), AnnyBody()
    assert across(refined, exact, body) < 0.85 * across(noisy, exact, body)
    assert done.moved["human"] > 0.005
    for position in (*refined.split["test"][:1], *refined.split["train"][:1]):
        before, after = (c.moments[position].poses["human"] for c in (noisy, refined))
        assert not torch.equal(before.body, after.body)
    assert "test frames among them" in refined.bodies["human"].provenance
    assert "refined" in str(refined.provenance["body"])
    # the other clip is as it was, and all but the body is shared with it
    again = ClipFolderReader().read(clips[1])
    assert torch.equal(again.bodies["human"].poses.body, noisy.bodies["human"].poses.body)
    assert torch.equal(refined.objects["object"].translations, noisy.objects["object"].translations)
    assert refined.split == noisy.split


def test_nothing_is_written_where_there_is_nothing_to_refine(
    clips: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(ClipError, match="exact"):
        refine_poses(clips[0], tmp_path / "out", steps=1)
    fixed = ["model.human.deformation.refine_poses=false"]
    with pytest.raises(SpecError, match="refines no poses"):
        refine_poses(clips[1], tmp_path / "out", steps=1, device="cpu", overrides=fixed)
    assert not any(tmp_path.iterdir())


def test_an_older_clip_is_replaced_only_with_overwrite(
    clips: tuple[Path, Path], tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(clips[1], mine)
    before = (mine / "bodies/human.npz").read_bytes()
    with pytest.raises(ClipError, match="--overwrite"):
        refine_poses(mine, mine, steps=1)
    assert (mine / "bodies/human.npz").read_bytes() == before
    refine_poses(mine, mine, steps=2, width=64, device="cpu", overwrite=True)
    assert (mine / "bodies/human.npz").read_bytes() != before
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_the_command_says_what_it_did(hoigs, clips: tuple[Path, Path], tmp_path: Path) -> None:
    outcome = hoigs(
        "refine", clips[1], "--out", tmp_path / "out", "--steps", 2, "--device", "cpu",
        "--width", 64,
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "joints moved by human" in outcome.out and str(tmp_path / "out") in outcome.out

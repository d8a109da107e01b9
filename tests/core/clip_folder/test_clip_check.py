"""The checker names every fault, where it is and what to do."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_clip_folder import HEIGHT, WIDTH, write

from hoigs.core.clip_folder.check import check_clip, require_clip, summarize, wrong
from hoigs.core.errors import ClipError
from hoigs.core.system.npz import load_arrays

ROOT = Path(__file__).parents[3]


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    write(tmp_path / "clip")
    return tmp_path / "clip"


def header(clip: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads((clip / "clip.json").read_text())
    change(content)
    (clip / "clip.json").write_text(json.dumps(content))


def arrays(path: Path, change: Callable[[dict[str, np.ndarray]], Any]) -> None:
    content = load_arrays(path)
    change(content)
    np.savez(path, **content)


def lines_of(clip: Path) -> list[str]:
    return [str(p) for p in check_clip(clip)]


def test_a_whole_clip_has_no_problem(clip: Path) -> None:
    assert check_clip(clip) == []
    assert require_clip(clip).frames == 8


HEADER_FAULTS = [
    (lambda h: h.update(version=3), "version 3; this hoigs reads version 1 and 2"),
    (lambda h: h.update(format="other"), '"format" is \'other\', expected "hoigs-clip"'),
    (lambda h: h.update(frames=0), "frames: Input should be greater than or equal to 1 (got 0)"),
    (lambda h: h.update(colour=1), "colour: Extra inputs are not permitted"),
    (lambda h: h.update(name="a\0b"), r"name: Value error, 'a\x00b'"),
    (lambda h: h.pop("width"), "width: Field required"),
    (lambda h: h["entities"]["ann"].update(kind="dog"), "entities.ann.kind: Input should be"),
    (lambda h: h["entities"]["ann"].pop("body"), "entities.ann: Value error, a human names its"),
    (lambda h: h["entities"].update({"../up": {"kind": "object"}}), "entity name '../up'"),
    (lambda h: h["split"].update(train=[]), "split.train is empty"),
    (lambda h: h["split"].update(test=[]), "split.test is empty"),
    (lambda h: h["split"].update(test=[1, 8]), "split names frames 8; the clip has 0..7"),
    (lambda h: h["split"].update(train=[0, 1], test=[1]), "frames 1 in both train and test"),
    (lambda h: h.update(depth_kind="feet"), "depth_kind: Input should be 'metric'"),
]


@pytest.mark.parametrize(("change", "message"), HEADER_FAULTS, ids=[m for _, m in HEADER_FAULTS])
def test_header_faults(clip: Path, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    header(clip, change)
    assert any(line.startswith("clip.json: ") and message in line for line in lines_of(clip))


def test_not_json(clip: Path) -> None:
    (clip / "clip.json").write_text("{")
    assert "not readable as JSON" in lines_of(clip)[0]
    (clip / "clip.json").write_text("[]")
    assert "expected a JSON object, got list" in lines_of(clip)[0]


def test_camera_count_unlike_frame_count(clip: Path) -> None:
    arrays(clip / "cameras.npz", lambda a: a.update(K=a["K"][:5]))
    assert lines_of(clip) == [
        "cameras.npz: K has shape [5, 3, 3], expected [F=8, 3, 3]: 5 entries for 8 frames"
    ]


def _set(name: str, index: Any, value: float) -> Callable[[dict[str, np.ndarray]], Any]:
    return lambda a: a[name].__setitem__(index, value)


ARRAY_FAULTS = [
    ("cameras.npz", _set("K", (3, 0, 0), np.nan), "K has 1 values that are NaN or infinite"),
    ("cameras.npz", _set("K", (3, 0, 0), -30), "K of frame 3 is not [[fx, 0, cx]"),
    ("cameras.npz", _set("world_to_camera", (2, 0, 0), 1.1), "frame 2 is not a rotation"),
    ("cameras.npz", _set("world_to_camera", (2, 2, 2), -1), "frame 2 is not a rotation"),
    ("cameras.npz", _set("world_to_camera", (2, 3, 0), 1), "frame 2: last row is not 0 0 0 1"),
    ("cameras.npz", lambda a: a.pop("K"), "has no array 'K'"),
    ("bodies/ann.npz", lambda a: a.update(body=a["body"][:, :20]), "expected [F=8, 21, 3]"),
    ("bodies/ann.npz", _set("transl", (0, 0), np.inf), "transl has 1 values"),
    (
        "bodies/ann.npz",
        lambda a: a.update(model=np.array("body:smplx")),
        "clip.json has body:anny",
    ),
    ("bodies/ann.npz", lambda a: a.update(hand_pose_convention=np.array("curled")), "'curled'"),
    (
        "objects/box.npz",
        _set("rotations", (1, 0, 1), 0.2),
        "rotations of frame 1 is not a rotation",
    ),
    ("objects/box.npz", lambda a: a["observed"].fill(False), "the object was never seen"),
    ("objects/box.npz", lambda a: a.update(colors=a["colors"][:2]), "colors has shape [2, 3]"),
    ("points.npz", lambda a: a.update(colors=a["colors"] * 255), "expected RGB in [0, 1]"),
    ("points.npz", lambda a: a.update(points=a["points"][:0], colors=a["points"][:0]), "is empty"),
    ("depth/00002.npz", lambda a: a["depth"][:4, :10].fill(np.nan), "40 NaN pixels; write 0"),
    ("depth/00002.npz", _set("depth", (0, 0), np.inf), "1 infinite pixels; write 0 where"),
    ("depth/00002.npz", _set("depth", (0, 0), -1), "1 negative pixels"),
    ("depth/00002.npz", lambda a: a.update(depth=a["depth"][:3]), "expected [14, 20]"),
    ("depth/00002.npz", lambda a: a.update(depth=a["depth"].astype(int)), "expected float32"),
    ("held_out/cameras.npz", lambda a: a.update(K=a["K"][:1]), "1 entries for 2 frames"),
    ("held_out/depth/00001.npz", _set("depth", (0, 0), np.nan), "1 NaN pixels"),
]


@pytest.mark.parametrize(
    ("path", "change", "message"), ARRAY_FAULTS, ids=[f"{p} {m}" for p, _, m in ARRAY_FAULTS]
)
def test_array_faults(
    clip: Path, path: str, change: Callable[[dict[str, np.ndarray]], Any], message: str
) -> None:
    arrays(clip / path, change)
    lines = lines_of(clip)
    assert len(lines) == 1
    assert lines[0].startswith(f"{path}: ") and message in lines[0]


@pytest.mark.parametrize(
    ("path", "maker"),
    [
        ("cameras.npz", "COLMAP"),
        ("images/00003.png", "hoigs prepare"),
        ("masks/box/00007.png", "your segmenter"),
        ("depth/00000.npz", "your depth network"),
        ("bodies/ann.npz", "landmarks"),
        ("objects/box.npz", "object-pose estimator"),
        ("points.npz", "COLMAP"),
        ("held_out/views.json", "ClipWriter.add_held_out"),
        ("held_out/masks/ann/00001.png", "your segmenter"),
        ("clip.json", "hoigs prepare"),
    ],
)
def test_absent_files_are_named_with_their_maker(clip: Path, path: str, maker: str) -> None:
    (clip / path).unlink()
    (line,) = lines_of(clip)
    assert line.startswith(f"{path} is absent: ") and maker in line


def test_every_fault_is_in_one_error(clip: Path) -> None:
    for i in (1, 3, 4, 5):
        (clip / f"masks/box/{i:05d}.png").unlink()
    (clip / "points.npz").unlink()
    with pytest.raises(ClipError) as error:
        require_clip(clip)
    assert "masks/box/{00001,00003-00005}.png (4 files) are absent" in str(error.value)
    assert "points.npz is absent" in str(error.value)


def test_image_and_mask_faults(clip: Path) -> None:
    Image.new("RGB", (WIDTH + 1, HEIGHT)).save(clip / "images/00001.png")
    Image.new("L", (WIDTH, HEIGHT - 1)).save(clip / "masks/ann/00002.png")
    Image.new("RGB", (WIDTH, HEIGHT)).save(clip / "masks/box/00000.png")
    (clip / "images/00004.png").write_bytes(b"not a picture")
    lines = lines_of(clip)
    assert "images/00001.png: is 21x14, expected 20x14" in lines
    assert "masks/ann/00002.png: is 20x13, expected 20x14" in lines
    assert "masks/box/00000.png: has mode RGB, expected one grey channel, 0 or 255" in lines
    assert any(line.startswith("images/00004.png: not a readable image") for line in lines)


@pytest.mark.parametrize(("value", "hint"), [(0, ""), (1, "brightest pixel is 1: write 255")])
def test_masks_empty_in_all_frames(clip: Path, value: int, hint: str) -> None:
    for path in (clip / "masks/box").iterdir():
        Image.new("L", (WIDTH, HEIGHT), value).save(path)
    (line,) = lines_of(clip)
    assert line.startswith('masks/box: "box" is seen in no frame') and hint in line


def test_pickles_are_refused(clip: Path) -> None:
    np.savez(clip / "points.npz", points=np.array([{}], dtype=object), colors=np.zeros((1, 3)))
    (line,) = lines_of(clip)
    assert "points.npz: not a readable npz without pickled objects" in line


def test_truncated_npz(clip: Path) -> None:
    content = (clip / "points.npz").read_bytes()
    (clip / "points.npz").write_bytes(content[: len(content) // 2])
    assert "points.npz: not a readable npz" in lines_of(clip)[0]


@pytest.mark.parametrize("name", ["images/00003.png", "masks/ann/00003.png"])
def test_half_copied_images_are_faults_like_absent_ones(clip: Path, name: str) -> None:
    """Training leaves their frames out, if it may."""
    content = (clip / name).read_bytes()
    (clip / name).write_bytes(content[: len(content) // 2])
    (problem,) = check_clip(clip)
    assert str(problem).startswith(f"{name}: not a readable image (")
    assert problem.severity == "fair"


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="is not a folder"):
        require_clip(tmp_path / "nowhere")


def test_summary_keeps_different_messages_apart() -> None:
    found = [wrong(f"depth/{i:05d}.npz", m) for i, m in ((0, "a"), (1, "a"), (2, "b"))]
    assert summarize(found) == ["depth/00000-00001.npz (2 files): a", "depth/00002.npz: b"]


def test_the_page_agrees_with_the_constants() -> None:
    script = runpy.run_path(str(ROOT / "scripts" / "clip_tables.py"))
    text = script["PAGE"].read_text(encoding="utf-8")
    assert script["with_tables"](text) == text, "run scripts/clip_tables.py"

"""The numbered examples run as a reader would run them, on the smallest clip."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
# SceneConfig.tiny() by name: the clip that other tests use
TINY = (
    "builtin:lift-and-swing?frames=12&width=64&height=64&fps=3&edge_samples=4&held_out_views=3"
    "&test_frames=3&scene_points=2000&object_points=300"
)


@pytest.fixture
def run(monkeypatch, capsys):
    """Run an example with arguments; what it prints."""

    def run(name: str, *args: object) -> str:
        (path,) = EXAMPLES.glob(f"{name}_*.py")
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, args)])
        capsys.readouterr()
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_every_example_is_run_here():
    numbers = {path.name[:2] for path in EXAMPLES.glob("[0-9]*.py")}
    assert numbers == set(re.findall(r'run\("(\d\d)"', Path(__file__).read_text()))


def test_composing_by_hand_trains(run):
    assert re.search(r"frame 6 drawn as \(64, 64, 3\) by \d+ splats", run("01", TINY, 3))


def test_rasterizers_agree(run):
    lines = [line.split() for line in run("02").splitlines() if "off the oracle" in line]
    assert {name.rstrip(":") for name, *_ in lines} == {"TorchRasterizer", "WarpRasterizer"}
    assert all(float(off) < 1e-5 for _, off, *_ in lines)


def test_a_spec_by_name(run):
    said = run("03", TINY)
    assert re.search(r"model.object.deformation +deformation:tracked-chs\n", said)
    error = float(re.search(r"mean error (\S+) of 1", said)[1])
    assert 0.01 < error < 0.5


def test_a_deformation_of_ones_own_learns(run):
    x, y, z = map(float, re.search(r"\[(.*)\]", run("04", 200))[1].split(","))
    assert abs(x - 0.3) < 0.02 and abs(y) < 0.02 and abs(z) < 0.05


def test_two_objects_are_both_corrected(run):
    corrected = dict(re.findall(r"(\w+) +corrected by up to (\S+)", run("05", TINY)))
    assert corrected.keys() == {"human", "box", "copy"}
    assert float(corrected["box"]) > 0 and float(corrected["human"]) > 0


def test_cameras_of_ones_own(run, tmp_path):
    from PIL import Image, ImageSequence

    said = run("06", TINY, tmp_path / "orbit.gif")
    assert "8 pictures" in said
    with Image.open(tmp_path / "orbit.gif") as gif:
        frames = [np.asarray(f.convert("RGB")) for f in ImageSequence.Iterator(gif)]
    pictures = np.stack(frames)
    assert pictures.shape[1:] == (64, 64, 3) and pictures.std() > 5
    assert (pictures[0] != pictures[2]).any()

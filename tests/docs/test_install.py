"""README, Dockerfile, environment.yml and messages install what pyproject.toml offers."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

from hoigs.core.errors import HoigsError

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NEEDED = "[prepare,view]"  # by the commands of README's first block
EXTRA = re.compile(r"(?:hoigs|['\"/.])\[([a-z][a-z,-]*)\]'?(?=[\s`.,)\"'|]|$)")


def extras(text: str) -> set[str]:
    return {name for group in EXTRA.findall(text) for name in group.split(",")}


PLACES = [ROOT / "README.md", ROOT / "Dockerfile", ROOT / "docs" / "howto" / "install.md"]


@pytest.mark.parametrize("path", PLACES, ids=lambda path: path.name)
def test_extras_that_are_named_exist(path: Path) -> None:
    text = path.read_text()
    assert {"prepare", "view"} <= extras(text) <= set(PROJECT["optional-dependencies"])


def test_messages_name_extras_that_exist() -> None:
    lines = [
        line
        for path in (ROOT / "hoigs").rglob("*.py")
        for line in path.read_text().splitlines()
        if "pip install" in line and "hoigs[" in line
    ]
    named = set().union(*map(extras, lines))
    assert {"prepare", "view", "ray"} <= named <= set(PROJECT["optional-dependencies"])


def test_the_environment_installs_the_same_as_readme() -> None:
    said = yaml.safe_load((ROOT / "environment.yml").read_text())
    (pip,) = (entry["pip"] for entry in said["dependencies"] if isinstance(entry, dict))
    assert f".{NEEDED}" in pip and "-c constraints.txt" in pip
    (python,) = (e for e in said["dependencies"] if str(e).startswith("python="))
    assert f">={python.partition('=')[2]}" == PROJECT["requires-python"]


def test_the_image_has_all_that_a_wheel_is_built_from(tmp_path: Path) -> None:
    """What the Dockerfile copies, and .dockerignore lets through, makes the whole wheel."""
    ignored = (ROOT / ".dockerignore").read_text().split()
    for line in (ROOT / "Dockerfile").read_text().splitlines():
        if not line.startswith("COPY "):
            continue
        *sources, target = shlex.split(line)[1:]
        for name in sources:
            assert f"!{name}" in ignored
            place = tmp_path / target.strip("/")
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, place, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                place.mkdir(exist_ok=True)
                shutil.copy(ROOT / name, place)
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=tmp_path / "hoigs", check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    built = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("hoigs/")}
    tracked = subprocess.run(
        ["git", "ls-files", "hoigs"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()
    assert built >= set(tracked)


def test_what_needs_videos_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from hoigs import prepare
    from hoigs.core.system.video_files import write_video

    monkeypatch.setitem(sys.modules, "av", None)
    frames = [np.zeros((16, 16, 3), np.uint8)]
    with pytest.raises(HoigsError, match=r"pip install 'hoigs\[prepare\]'"):
        write_video(tmp_path / "a.mp4", frames)
    with pytest.raises(HoigsError, match=r"pip install 'hoigs\[prepare\]'"):
        prepare(tmp_path / "none.mp4", tmp_path / "clip")
    assert write_video(tmp_path / "a.gif", frames).stat().st_size > 0

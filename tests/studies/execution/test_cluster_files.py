"""The files for Slurm and Kubernetes are scripts and YAML whose commands and options exist."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from hoigs.cli.main import app

FOLDER = Path(__file__).parents[3] / "examples" / "cluster"


def known_options() -> set[str]:
    command = typer.main.get_command(app).commands["batch"]  # type: ignore[attr-defined]
    return {name for parameter in command.params for name in parameter.opts}


def options_of(text: str) -> set[str]:
    """Options after `hoigs batch` in a command."""
    words = shlex.split(text.replace("\\\n", " "), comments=True)
    words = words[words.index("hoigs") + 1 :]
    assert words[0] == "batch"
    return {word for word in words if word.startswith("--")}


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.sh")), ids=lambda path: path.stem)
def test_scripts(path):
    subprocess.run(["bash", "-n", str(path)], check=True)
    command = path.read_text().partition("\nsrun ")[2]
    assert {"--out"} <= options_of(command) <= known_options()


def test_a_ray_job():
    job: dict[str, Any] = yaml.safe_load((FOLDER / "kuberay.yaml").read_text())
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    assert {"--executor", "--address"} <= options_of(job["spec"]["entrypoint"]) <= known_options()
    cluster = job["spec"]["rayClusterSpec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    for pod in (group["template"]["spec"] for group in groups):
        (container,) = pod["containers"]
        assert {m["name"] for m in container["volumeMounts"]} == {v["name"] for v in pod["volumes"]}
        assert container["env"] == [{"name": "RAY_USAGE_STATS_ENABLED", "value": "0"}]

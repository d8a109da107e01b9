"""A notebook: its cells run, bars are shown in its way, and a running loop is no obstacle."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import hoigs as h
from hoigs.core.reporting import default_progress, no_progress

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"
TINY = (
    "builtin:lift-and-swing?frames=12&width=64&height=64&fps=3&edge_samples=4&held_out_views=3"
    "&test_frames=3&scene_points=2000&object_points=300"
)
FEW = ("train.steps=2", "model.scene.points=300", "model.human.points=300",
       "model.object.points=100")  # fmt: skip


class Display:
    """IPython's `display` with an id, which keeps what is shown."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def __call__(self, data: Any, **options: Any) -> Display:
        assert options == {"raw": True, "display_id": True}
        return self

    def update(self, data: Any, raw: bool) -> None:
        self.shown.append(data["text/html"])


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Display:
    """IPython as it is in a notebook's kernel."""
    display = Display()
    shell = SimpleNamespace(kernel=object())
    package = SimpleNamespace(
        get_ipython=lambda: shell, display=SimpleNamespace(display=display), version_info=(9, 0)
    )
    monkeypatch.setitem(sys.modules, "IPython", package)
    monkeypatch.setitem(sys.modules, "IPython.display", package.display)
    return display


def test_a_bar_in_a_notebook_and_nothing_elsewhere(kernel: Display) -> None:
    show = default_progress()
    for done in (0.0, 0.001, 1.0):
        show(done, "<masks>")
    assert "100 %" in kernel.shown[-1] and "&lt;masks&gt;" in kernel.shown[-1]
    assert len(kernel.shown) == 2  # not more often than can be seen
    sys.modules["IPython"].get_ipython = lambda: None  # IPython is installed, and not in use
    assert default_progress() is no_progress


@pytest.mark.slow
def test_the_cells_run(kernel: Display, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within a running loop, as in a kernel; and then a training in a thread of it."""
    monkeypatch.chdir(tmp_path)

    async def session() -> h.TrainedRun:
        run_cells()
        return await asyncio.to_thread(
            h.train, TINY, out="thread", overrides=FEW, evaluate=False, device="cpu"
        )

    assert (asyncio.run(session()).path / "checkpoints" / "step_000002.json").exists()
    assert "step 2, loss" in "".join(kernel.shown)
    assert (tmp_path / "runs/notebook/around.mp4").stat().st_size > 0


def run_cells() -> None:
    cells = [
        "".join(c["source"]) for c in json.loads(NOTEBOOK.read_text())["cells"] if "outputs" in c
    ]
    names: dict[str, Any] = {}
    clip = next(line for line in cells[0].splitlines() if line.startswith("clip = "))
    for cell in cells:
        small = cell.replace(clip, f"clip = {TINY!r}").replace("steps=200", "steps=2")
        small = small.replace("overwrite=True", "evaluate=False")  # scores take most of the time
        for many in ("points=6000", "points=3500", "points=1000"):
            small = small.replace(many, "points=300")
        *lines, last = small.splitlines()
        exec("\n".join(lines), names)
        shown = eval(last, names)
        assert shown is None or "<" in shown._repr_html_()

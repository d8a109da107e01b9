"""The numbered examples run as a reader would run them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_rasterizers_agree_in_the_example():
    done = subprocess.run(
        [sys.executable, EXAMPLES / "02_swap_rasterizers.py"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines() if "off the oracle" in line]
    assert {name.rstrip(":") for name, *_ in lines} == {"TorchRasterizer", "WarpRasterizer"}
    assert all(float(off) < 1e-5 for _, off, *_ in lines)


def test_composing_by_hand_trains(monkeypatch, capsys):
    import hoigs
    from hoigs.synthesis import SceneKnobs, builtin_clip

    tiny = lambda body: builtin_clip(body, SceneKnobs.tiny())  # noqa: E731
    monkeypatch.setattr(hoigs, "builtin_clip", tiny, raising=False)
    monkeypatch.setattr(sys, "argv", ["01_compose.py", "3"])
    small = hoigs.read_clip
    monkeypatch.setattr(hoigs, "read_clip", lambda folder, width: small(folder), raising=False)
    source = (EXAMPLES / "01_compose.py").read_text().replace("clip[12]", "clip[2]")
    exec(compile(source, "01_compose.py", "exec"), {"__name__": "__main__"})
    assert "Gaussians" in capsys.readouterr().out

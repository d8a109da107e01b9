"""The README's Python runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import hoigs

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.slow
def test_the_first_screen_runs(monkeypatch):
    from hoigs.synthesis import SceneConfig, builtin_clip

    # the smallest clip in place of the default one: the same code, seconds instead of a minute
    tiny = lambda body: builtin_clip(body, SceneConfig.tiny())  # noqa: E731
    monkeypatch.setattr(hoigs, "builtin_clip", tiny, raising=False)
    code = re.search(r"```python\n(.*?)```", README.read_text(), re.S)
    assert code is not None
    names: dict[str, object] = {}
    exec(compile(code[1].replace("clip[12]", "clip[2]"), "README.md", "exec"), names)
    image = names["image"]
    assert image.shape == (64, 64, 3)
    assert image.isfinite().all() and float(image.detach().std()) > 0.01


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target

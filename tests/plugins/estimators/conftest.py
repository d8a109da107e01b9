"""Tiny networks, made once for all tests of estimators that load them; no others are used."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def no_outlines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Objects are outlined alike on every machine, whatever is installed there."""
    from hoigs.plugins.estimators.object_tracker.outlines import Outlines

    monkeypatch.setattr(Outlines, "installed", staticmethod(lambda: False))


def _fixture(name: str, builder: str):
    @pytest.fixture(scope="session", name=name)
    def make(tmp_path_factory: pytest.TempPathFactory) -> Path:
        pytest.importorskip("transformers", reason="the extra hoigs[estimators]")
        import tiny_networks

        return getattr(tiny_networks, builder)(tmp_path_factory.mktemp(name))

    return make


depth = _fixture("depth", "depth_model")
vitpose = _fixture("vitpose", "vitpose_model")
rtdetr = _fixture("rtdetr", "rtdetr_model")
sam2 = _fixture("sam2", "sam2_model")

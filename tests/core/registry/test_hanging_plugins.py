"""A plugin that hangs, or lacks a method, costs only itself, and its name is printed."""

from __future__ import annotations

import time

import pytest
from fake_plugins import PluginFolder

from hoigs.core.errors import PluginError
from hoigs.core.registry.manager import Status
from hoigs.core.registry.registry import Registry


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("HOIGS_IMPORT_TIMEOUT", "0.4")
    return PluginFolder(tmp_path)


@pytest.mark.parametrize(
    "hang",
    ["import time\ntime.sleep(60)", "while True:\n    try:\n        x = 1\n    except Exception:\n"
     "        pass"],
)  # fmt: skip
def test_an_import_that_does_not_end(plugins, capfd, hang):
    plugins.add("acme-hangs", hang)
    began = time.monotonic()
    manager = plugins.manager()
    assert time.monotonic() - began < 30
    [plugin] = [p for p in manager.plugins if p.dist == "acme-hangs"]
    assert plugin.status is Status.BROKEN and "did not end in 0.4 s" in plugin.error
    assert "HOIGS_BLOCK=acme-hangs" in plugin.error
    assert "still waiting for plugin acme-hangs-plugin of acme-hangs" in capfd.readouterr().err
    assert Registry(manager).keys("deformation")


def test_a_component_whose_module_does_not_end(plugins, tmp_path):
    (tmp_path / "acme_slow.py").write_text("import time\ntime.sleep(60)\n")
    plugins.offer("acme-slow", 'Component("deformation:acme", "acme_slow:Slow", summary="x")')
    registry = plugins.registry()
    with pytest.raises(PluginError, match=r"deformation:acme@acme-slow.*did not end in 0\.4 s"):
        registry.get("deformation:acme")

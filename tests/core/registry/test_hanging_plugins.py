"""A plugin that hangs, or lacks a method, costs only itself, and its name is printed."""

from __future__ import annotations

import signal
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


def test_a_file_that_does_not_end(plugins, tmp_path):
    file = tmp_path / "hangs.py"
    file.write_text("import time\ntime.sleep(5)\n")
    with pytest.raises(PluginError, match=r"hangs\.py: TooLong: its import did not end in 0\.4 s"):
        plugins.manager().load_file(file)


@pytest.mark.parametrize("then", ["pass", 'raise RuntimeError("wrapped")'])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopping_is_no_fault_of_the_plugin(plugins, monkeypatch, then, number):
    """Also where the plugin catches the KeyboardInterrupt of it."""
    monkeypatch.setenv("HOIGS_IMPORT_TIMEOUT", "60")
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    plugins.add(
        f"acme-catches-{number}-{len(then)}",  # a module is imported once
        f"import signal\ntry:\n    signal.raise_signal({number})\nexcept:\n    {then}",
    )
    try:
        with pytest.raises(KeyboardInterrupt):
            plugins.manager()
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_component_whose_module_does_not_end(plugins, tmp_path):
    (tmp_path / "acme_slow.py").write_text("import time\ntime.sleep(60)\n")
    plugins.offer("acme-slow", 'Component("deformation:acme", "acme_slow:Slow", summary="x")')
    registry = plugins.registry()
    with pytest.raises(PluginError, match=r"deformation:acme@acme-slow.*did not end in 0\.4 s"):
        registry.get("deformation:acme")

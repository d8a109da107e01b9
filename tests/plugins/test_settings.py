"""Every setting of what is built in says what it means."""

from __future__ import annotations

import importlib

from hoigs.core.registry.settings import describe_settings
from hoigs.plugins.builtin import PARTS


def test_no_setting_is_without_a_meaning() -> None:
    silent = [
        f"{key} {setting.name}"
        for key, module, _, config, _ in PARTS
        if config is not None
        for setting in describe_settings(getattr(importlib.import_module(module), config))
        if not setting.meaning
    ]
    assert not silent, "give each a Field(description=...): " + ", ".join(silent)

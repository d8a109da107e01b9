"""docs/reference/readers.md knows every reader and every setting."""

from __future__ import annotations

import re
from pathlib import Path

from hoigs.core.registry.registry import default_registry

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "readers.md"


def test_every_reader_and_setting_is_there() -> None:
    registry = default_registry()
    text = PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(reader:\w+)` \|(.*)$", text, flags=re.MULTILINE)
    keys = registry.keys("reader")
    assert sorted(key for key, _ in rows) == sorted([*keys, *keys])  # what it reads; its settings
    settings = dict(rows[len(keys) :])
    for key in keys:
        named = set(re.findall(r"`(\w+)`", settings[key]))
        assert set(registry.config_class(key).model_fields) <= named, key

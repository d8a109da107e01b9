"""A headless Chromium."""

from __future__ import annotations

from browser import chromium, window

__all__ = ["chromium", "window"]

"""Extras of a distribution: their requirements, and which of these are not installed."""

from __future__ import annotations

import re
from importlib import metadata

_EXTRA = re.compile(r"extra\s*==\s*['\"]([^'\"]+)['\"]")


def missing_requirements(dist: str, extra: str | None) -> list[str]:
    """Distributions that an extra of `dist` requires and that are not installed."""
    if extra is None:
        return []
    missing = []
    for line in _requirements(dist):
        requirement, _, marker = line.partition(";")
        name = re.match(r"[A-Za-z0-9._-]+", requirement.strip())
        if name is None or extra not in _EXTRA.findall(marker):
            continue
        try:
            metadata.version(name[0])
        except metadata.PackageNotFoundError:
            missing.append(name[0])
    return missing


def declared_extras(dist: str) -> set[str]:
    """Extras that any requirement of `dist` belongs to."""
    return {extra for line in _requirements(dist) for extra in _EXTRA.findall(line)}


def _requirements(dist: str) -> list[str]:
    try:
        return metadata.requires(dist) or []
    except metadata.PackageNotFoundError:
        return []  # a plugin file has no metadata; missing requirements show at its import

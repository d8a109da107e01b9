"""Distributions made up for a test: a folder with a module and its metadata, not installed."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from hoigs.core.registry.manager import GROUP, PluginManager
from hoigs.core.registry.registry import Registry

HEADER = "import hoigs\nfrom hoigs import Component, hookimpl\n"


class PluginFolder:
    """A folder like site-packages; `manager()` sees its distributions and hoigs's own."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def add(
        self, dist: str, source: str, *, module: str | None = None, requires: tuple[str, ...] = ()
    ) -> str:
        """Make distribution `dist` with one plugin module; returns the module's name."""
        module = module or f"fake_{dist.replace('-', '_')}"
        (self.path / f"{module}.py").write_text(HEADER + textwrap.dedent(source))
        info = self.path / f"{dist.replace('-', '_')}-1.2.dist-info"
        info.mkdir()
        lines = ["Metadata-Version: 2.1", f"Name: {dist}", "Version: 1.2"]
        lines += [f"Requires-Dist: {line}" for line in requires]
        (info / "METADATA").write_text("\n".join(lines) + "\n")
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{dist}-plugin = {module}\n")
        return module

    def offer(self, dist: str, *components: str, **kwargs: tuple[str, ...]) -> str:
        """`add` a plugin that yields the given Component expressions."""
        body = "".join(f"    yield {c}\n" for c in components)
        return self.add(dist, f"@hookimpl\ndef hoigs_components():\n{body}", **kwargs)

    def entry_points(self) -> list[metadata.EntryPoint]:
        own = [e for e in metadata.entry_points(group=GROUP) if e.dist and e.dist.name == "hoigs"]
        found = metadata.distributions(path=[str(self.path)])
        return own + [e for d in found for e in d.entry_points if e.group == GROUP]

    def manager(self, environ: Mapping[str, str] | None = None) -> PluginManager:
        manager = PluginManager(environ or {})
        manager.load_installed(self.entry_points())
        return manager

    def registry(self, environ: Mapping[str, str] | None = None) -> Registry:
        return Registry(self.manager(environ))

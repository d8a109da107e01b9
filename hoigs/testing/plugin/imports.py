"""P01 to P07: side effects and time of importing a plugin and a component."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hoigs.core.machine.python import PYTHON
from hoigs.core.registry.component import INTERFACES
from hoigs.core.registry.manager import HOOK
from hoigs.testing.checks import CheckError
from hoigs.testing.plugin.subject import CHECKS, PluginSubject

HEAVY = ("torch", "warp", "scipy", "pycolmap", "kornia")
SLOW = 1.0  # seconds to list one plugin
PROBE = Path(__file__).with_name("probe.py")

_targets: dict[tuple[str, ...], dict[str, Any]] = {}  # of modules, by (module, *sys.path)


def _probe(steps: Sequence[str], first: Sequence[str], hook: str | None) -> dict[str, Any]:
    """What importing each of `steps` does, in one process that has imported `first`."""
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder) / "job.json", Path(folder) / "result.json"
        job.write_text(
            json.dumps({"path": sys.path, "first": first, "hook": hook, "steps": list(steps)})
        )
        command = [*PYTHON, str(PROBE), str(result), str(job)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if not result.is_file():
            raise CheckError(f"importing it ends the process ({done.returncode}): {done.stderr}")
        return json.loads(result.read_text())


def _where(module: str) -> str:
    """What the probe imports: a module's name, or the file of a plugin without an import name."""
    if not module.startswith("hoigs_plugin_"):
        return module.partition(":")[0]
    return str(sys.modules[module].__file__)


def probe_targets(modules: Iterable[str]) -> None:
    """Import these modules in one process, after torch, and keep what each does."""
    expected = [m for m in dict.fromkeys(modules) if (m, *sys.path) not in _targets]
    if expected:
        found = _probe([_where(m) for m in expected], ["torch", "hoigs.core.model.scene"], None)
        _targets.update({(m, *sys.path): found[_where(m)] for m in expected})


def _listing(subject: PluginSubject) -> dict[str, Any]:
    """What importing the plugin's module and calling its hook does."""
    key = ("listing", subject.offer.plugin.module, *sys.path)
    if key not in _targets:
        where = _where(subject.offer.plugin.module)
        _targets[key] = _probe([where], ["hoigs.core.registry.manager"], HOOK)[where]
    if _targets[key]["error"]:
        raise CheckError(f"importing the plugin fails: {_targets[key]['error']}")
    return _targets[key]


def _target(subject: PluginSubject) -> dict[str, Any]:
    """What importing the component's module does, after torch."""
    module = subject.component.target.partition(":")[0]
    probe_targets([module])
    found = _targets[(module, *sys.path)]
    if found["error"]:
        raise CheckError(f"importing {module} fails: {found['error']}")
    return found


@CHECKS.check("P01")
def listing_imports_nothing_heavy(subject: PluginSubject) -> None:
    """Listing the plugin imports neither torch nor another heavy package."""
    loaded = [name for name in HEAVY if name in _listing(subject)["modules"]]
    if loaded:
        raise CheckError(
            f"{subject.offer.plugin.module} imports {', '.join(loaded)}; targets are strings, so "
            "that the module with the hook need not import what they name"
        )


@CHECKS.check("P02")
def listing_prints_nothing(subject: PluginSubject) -> None:
    """Listing the plugin prints nothing."""
    printed = _listing(subject)["printed"]
    if printed:
        raise CheckError(f"importing {subject.offer.plugin.module} prints {printed[:200]!r}")


@CHECKS.check("P03")
def listing_starts_no_threads(subject: PluginSubject) -> None:
    """Listing the plugin starts no threads."""
    threads = _listing(subject)["threads"]
    if threads:
        raise CheckError(f"importing {subject.offer.plugin.module} starts {', '.join(threads)}")


@CHECKS.check("P04")
def listing_is_quick(subject: PluginSubject) -> str:
    """Listing the plugin takes less than a second."""
    seconds = _listing(subject)["seconds"]
    if seconds > SLOW:
        raise CheckError(f"importing {subject.offer.plugin.module} takes {seconds:.1f} s")
    return f"its module is imported in {1000 * seconds:.0f} ms"


@CHECKS.check("P05")
def target_implements_its_interface(subject: PluginSubject) -> None:
    """The target is a concrete class of its kind's interface."""
    found = subject.registry.get(subject.offer.exact)
    if inspect.isabstract(found):
        missing = ", ".join(sorted(found.__abstractmethods__))
        interface = INTERFACES[subject.component.kind]
        raise CheckError(f"{found.__name__} lacks {missing} of {interface}")
    if not callable(getattr(found, "from_config", None)):
        raise CheckError(f"{found.__name__} has no from_config(config, context)")


@CHECKS.check("P06")
def target_prints_nothing(subject: PluginSubject) -> str:
    """Importing the component prints nothing; the time is reported."""
    found = _target(subject)
    if found["printed"]:
        raise CheckError(f"importing {subject.component.target} prints {found['printed'][:200]!r}")
    return f"its component is imported in {1000 * found['seconds']:.0f} ms, torch not counted"


@CHECKS.check("P07")
def target_starts_no_threads(subject: PluginSubject) -> None:
    """Importing the component starts no threads."""
    threads = _target(subject)["threads"]
    if threads:
        raise CheckError(f"importing {subject.component.target} starts {', '.join(threads)}")

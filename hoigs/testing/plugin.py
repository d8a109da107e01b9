"""Conformance of plugins of any kind: `CHECKS`, of one component of a registry."""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hoigs.core.errors import PluginError
from hoigs.core.registry.component import API, INTERFACES, Component
from hoigs.core.registry.manager import HOOK, Offer, Status, normal_name
from hoigs.core.registry.registry import Registry
from hoigs.core.system.environments import PYTHON
from hoigs.testing.checks import CheckError, CheckList, require
from hoigs.testing.runner import KINDS, Options


@dataclass(frozen=True)
class PluginSubject:
    """The offer under check, in its registry."""

    offer: Offer
    registry: Registry
    options: Options

    def __str__(self) -> str:
        return self.offer.exact

    @property
    def component(self) -> Component:
        return self.offer.component

    def config_class(self) -> type[Any]:
        return self.registry.config_class(self.offer.exact)

    def config(self) -> Any:
        """Its settings: the given ones, and defaults for the others."""
        return self.config_class().model_validate(dict(self.options.settings))


CHECKS: CheckList[PluginSubject] = CheckList("P")


def subject(key: str, registry: Registry, options: Options) -> PluginSubject:
    """The offer of `key`, whatever its status.

    Raises:
        PluginError: no distribution offers it, or several do and `key` names none of them.
    """
    name, _, dist = key.partition("@")
    found = [o for o in registry.manager.offers if o.key == name]
    if dist:
        found = [o for o in found if normal_name(o.plugin.dist) == normal_name(dist)]
    builtin = [o for o in found if o.plugin.builtin]
    chosen = builtin or found
    if len(chosen) != 1:
        registry.component(key)  # raises with the nearest name
        raise PluginError(f"{key} is offered by {', '.join(o.exact for o in found)}; write one")
    return PluginSubject(chosen[0], registry, options)


def takes_settings(subject: PluginSubject) -> str | None:
    return None if subject.component.config is not None else "it declares no config"


def has_extra(subject: PluginSubject) -> str | None:
    return None if subject.component.extra is not None else "it declares no extra"


def installed(subject: PluginSubject) -> str | None:
    plugin = subject.offer.plugin
    return "it comes from a file" if plugin.version.startswith("sha256:") else None


# P01 to P07: side effects and time of importing a plugin and a component.

HEAVY = ("torch", "warp", "scipy", "pycolmap", "kornia")
SLOW = 1.0  # seconds to list one plugin
PROBE = Path(__file__).with_name("probe.py")
_targets: dict[tuple[str, ...], dict[str, Any]] = {}  # of modules, by (module, *sys.path)


def _probe(steps: Sequence[str], first: Sequence[str], hook: str | None) -> dict[str, Any]:
    """What importing each of `steps` does, in one process that has imported `first`."""
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder) / "job.json", Path(folder) / "result.json"
        task = {"path": sys.path, "first": first, "hook": hook, "steps": list(steps)}
        job.write_text(json.dumps(task))
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


def _require_silent(what: str, found: dict[str, Any]) -> None:
    require(not found["printed"], f"importing {what} prints {found['printed'][:200]!r}")


def _require_no_threads(what: str, found: dict[str, Any]) -> None:
    require(not found["threads"], f"importing {what} starts {', '.join(found['threads'])}")


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
    _require_silent(subject.offer.plugin.module, _listing(subject))


@CHECKS.check("P03")
def listing_starts_no_threads(subject: PluginSubject) -> None:
    """Listing the plugin starts no threads."""
    _require_no_threads(subject.offer.plugin.module, _listing(subject))


@CHECKS.check("P04")
def listing_is_quick(subject: PluginSubject) -> str:
    """Listing the plugin takes less than a second."""
    seconds, module = _listing(subject)["seconds"], subject.offer.plugin.module
    require(seconds <= SLOW, f"importing {module} takes {seconds:.1f} s")
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
    _require_silent(subject.component.target, found)
    return f"its component is imported in {1000 * found['seconds']:.0f} ms, torch not counted"


@CHECKS.check("P07")
def target_starts_no_threads(subject: PluginSubject) -> None:
    """Importing the component starts no threads."""
    _require_no_threads(subject.component.target, _target(subject))


# P08, P09 and P11: how a plugin declares a component.

LONGEST = 100  # characters of a summary, which has one line in the listing


@CHECKS.check("P08")
def it_can_be_used_by_its_key(subject: PluginSubject) -> None:
    """The component is usable: a valid key, this API version, no conflict, nothing missing."""
    api, offer = subject.component.api, subject.offer
    require(api == API, f"api is {api}, this hoigs has {API}")
    subject.registry.check(offer)
    require(offer.status is Status.OK, f"{offer.status}: {offer.error}")


@CHECKS.check("P09")
def summary_is_one_line(subject: PluginSubject) -> None:
    """The summary is one line."""
    summary = subject.component.summary
    require(summary.strip(), "summary is empty; `hoigs plugins` shows it beside the key")
    short = len(summary.splitlines()) == 1 and len(summary) <= LONGEST
    require(short, f"summary is not one line of at most {LONGEST} characters: {summary!r}")


@CHECKS.check("P11", has_extra, installed)
def extra_exists_in_the_distribution(subject: PluginSubject) -> None:
    """The extra that it declares is one that its distribution offers."""
    dist, extra = subject.offer.plugin.dist, subject.component.extra
    offered = metadata.metadata(dist).get_all("Provides-Extra") or []
    known = extra in offered
    require(known, f'"{extra}" is not an extra of {dist}, which has {offered or "none"}')


# P10, P12 and P13: the component's settings, and building it from them.

NONSENSE = "no_setting_has_this_name"


@CHECKS.check("P10")
def it_is_built_from_its_settings(subject: PluginSubject) -> str | None:
    """It can be built from its default or given settings."""
    needed = [
        name
        for name, field in subject.config_class().model_fields.items()
        if field.is_required() and name not in subject.options.settings
    ]
    if needed:
        raise CheckError(
            f"{', '.join(needed)} has no default; set it for the check: "
            f'settings={{"{needed[0]}": …}}, or --set {needed[0]}=…'
        )
    config = subject.config()
    if subject.component.kind not in KINDS:
        return "its kind has no checks: it was not built"
    package = importlib.import_module(KINDS[subject.component.kind])
    package.subject(subject.registry.get(subject.offer.exact), config, subject.options)
    return None


@CHECKS.check("P12", takes_settings)
def unknown_settings_are_refused(subject: PluginSubject) -> None:
    """Unknown settings are refused."""
    try:
        subject.config_class().model_validate({**subject.options.settings, NONSENSE: 1})
    except ValidationError as error:
        if any(problem["loc"][-1:] == (NONSENSE,) for problem in error.errors()):
            return
    raise CheckError(
        f'{subject.component.config} accepts the setting "{NONSENSE}"; keep extra="forbid" of '
        "ComponentConfig, so that misspelt keys are errors"
    )


@CHECKS.check("P13", takes_settings)
def settings_survive_json(subject: PluginSubject) -> None:
    """Settings have a JSON schema, and are the same after a round trip through JSON."""
    config = subject.config()
    json.dumps(type(config).model_json_schema())
    again = type(config).model_validate(json.loads(config.model_dump_json()))
    require(again == config, f"after a round trip through JSON, {config!r} is {again!r}")

"""check and check_plugin: run the conformance checks of a component, or of a whole plugin."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hoigs.core.errors import PluginError, did_you_mean
from hoigs.core.registry.manager import normal_name
from hoigs.testing.checks import Check, Outcome, Report, Result, refuse_unknown, run_check

if TYPE_CHECKING:
    from hoigs.core.registry.registry import Registry

# kind -> package with CHECKS and `subject(cls, config, options)`; others have P checks only
KINDS = {
    "deformation": "hoigs.testing.deformation",
    "body": "hoigs.testing.body",
    "reader": "hoigs.testing.reader",
    "density": "hoigs.testing.density",
    "features": "hoigs.testing.features",
    "interaction": "hoigs.testing.interaction",
    "rasterizer": "hoigs.testing.rasterizer",
    "exporter": "hoigs.testing.exporter",
    "objective": "hoigs.testing.objective",
    "decoder": "hoigs.testing.decoder",
}
PLUGIN = "hoigs.testing.plugin"


@dataclass(frozen=True)
class Options:
    """How the subject of a check is made.

    Attributes:
        settings: of the component, where they differ from its defaults or have none.
        device: on which it is checked.
        folder: a clip in a reader's own layout. Without one, a reader is checked on a clip folder
            of hoigs, if its `matches` accepts it.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    folder: Path | None = None


class Candidate:
    """One component to be checked; nothing is imported before a check needs it.

    Args:
        key: "kind:name", or "kind:name@dist".
        registry: that has the key; by default that of this process.
    """

    def __init__(
        self, key: str, options: Options | None = None, registry: Registry | None = None
    ) -> None:
        self.key, self.options = key, options or Options()
        self._registry = registry

    @cached_property
    def registry(self) -> Registry:
        from hoigs.core.registry.registry import default_registry

        return self._registry or default_registry()

    @cached_property
    def plugin(self) -> Any:
        """The subject of the P checks."""
        return importlib.import_module(PLUGIN).subject(self.key, self.registry, self.options)

    @cached_property
    def component(self) -> Any:
        """The subject of its kind's checks; the exception where it cannot be built."""
        package = importlib.import_module(KINDS[kind_of(self.key)])
        try:
            settings = dict(self.options.settings)
            config = self.registry.config_class(self.key).model_validate(settings)
            return package.subject(self.registry.get(self.key), config, self.options)
        except Exception as error:  # a plugin may raise anything
            return error

    def checks(self) -> list[Check[Any]]:
        """The P checks and those of its kind."""
        packages = [PLUGIN, *filter(None, [KINDS.get(kind_of(self.key))])]
        return [check for name in packages for check in importlib.import_module(name).CHECKS]

    def result(self, check: Check[Any], expected: str | None = None) -> Result:
        """Run one of `checks`."""
        if check.id.startswith("P"):
            return run_check(check, self.plugin, expected)
        if isinstance(self.component, Exception):
            why = f"it cannot be built, see P10: {type(self.component).__name__}: {self.component}"
            return Result(check.id, check.title, Outcome.SKIPPED, why)
        return run_check(check, self.component, expected)

    def report(self, expected_failures: Mapping[str, str] | None = None) -> Report:
        expected = dict(expected_failures or {})
        refuse_unknown(expected, [check.id for check in self.checks()])
        results = [self.result(check, expected.get(check.id)) for check in self.checks()]
        return Report(self.key, tuple(results))


def kind_of(key: str) -> str:
    return key.partition(":")[0]


def check(
    key: str,
    *,
    expected_failures: Mapping[str, str] | None = None,
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
    folder: str | Path | None = None,
    registry: Registry | None = None,
) -> Report:
    """Check that the component `key` keeps the contract of its interface.

    Args:
        key: "kind:name", or "kind:name@dist".
        expected_failures: id of a check -> why it is known to fail. It runs all the same, and is
            an error when it passes.
        settings, device, folder: see Options.
        registry: that has the key; by default that of this process.

    Raises:
        PluginError: no plugin offers `key`.
        ValueError: `expected_failures` names an unknown check.
    """
    options = Options(settings or {}, device, None if folder is None else Path(folder))
    candidate = Candidate(key, options, registry)
    require_offered(key, candidate.registry)
    return candidate.report(expected_failures)


def check_plugin(
    name: str,
    *,
    expected_failures: Mapping[str, str] | None = None,
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
    folder: str | Path | None = None,
    registry: Registry | None = None,
) -> list[Report]:
    """`check` for a key, or for every component of a distribution or entry point of that name.

    Raises:
        PluginError: there is no such key or plugin, or it offers nothing.
    """
    from hoigs.core.registry.registry import default_registry

    registry = registry or default_registry()
    keys = [name] if ":" in name else keys_of(name, registry)
    return [
        check(
            key,
            expected_failures=expected_failures,
            settings=settings,
            device=device,
            folder=folder,
            registry=registry,
        )
        for key in keys
    ]


def keys_of(name: str, registry: Registry) -> list[str]:
    """Exact keys of all components of a distribution or entry point of this name."""
    expected = normal_name(name)
    plugins = registry.manager.plugins
    found = [p for p in plugins if expected in (normal_name(p.dist), normal_name(p.name))]
    keys = [o.exact for o in registry.manager.offers if o.plugin in found]
    if keys:
        return keys
    if found:
        message = "; ".join(f"{p.status}: {p.error}" if p.error else str(p.status) for p in found)
        raise PluginError(f'the plugin "{name}" offers nothing to check ({message})')
    names: Sequence[str] = [*(p.dist for p in plugins), *registry.keys()]
    raise PluginError(
        f'"{name}" is neither a component key nor a plugin{did_you_mean(name, names)}; '
        "`hoigs plugins` lists both"
    )


def require_offered(key: str, registry: Registry) -> None:
    """Raise PluginError, with the nearest name, when no plugin offers `key`."""
    name = key.partition("@")[0]
    if not any(offer.key == name for offer in registry.manager.offers):
        registry.component(key)


# conformance: the checks of a component as parameters of a pytest function.


class Case:
    """One check of one component, as a callable."""

    def __init__(self, candidate: Candidate, check: Check[Any], expected: str | None) -> None:
        self.candidate, self.check, self.expected = candidate, check, expected

    def __call__(self) -> None:
        """Run the check; fails, skips or xfails through pytest."""
        import pytest

        require_offered(self.candidate.key, self.candidate.registry)
        result = self.candidate.result(self.check, self.expected)
        message = f"{result.id} {result.title}: {result.why}"
        if result.outcome in (Outcome.FAILED, Outcome.UNEXPECTED_PASS):
            pytest.fail(message, pytrace=False)
        if result.outcome is Outcome.SKIPPED:
            pytest.skip(message)
        if result.outcome is Outcome.EXPECTED_FAILURE:
            pytest.xfail(message)


def conformance(
    key: str,
    *,
    expected_failures: Mapping[str, str] | None = None,
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
    folder: str | Path | None = None,
    registry: Registry | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator for a pytest function of one argument `check`: one test for each check.

        @conformance("deformation:bspline", expected_failures={"D09": "it jumps by design"})
        def test_conforms(check):
            check()

    Args:
        expected_failures, settings, device, folder, registry: as `hoigs.testing.check`.

    Raises:
        ValueError: `expected_failures` names an unknown check.
    """
    import pytest

    options = Options(settings or {}, device, None if folder is None else Path(folder))
    candidate = Candidate(key, options, registry)
    expected = dict(expected_failures or {})
    checks = candidate.checks()
    refuse_unknown(expected, [check.id for check in checks])
    cases = [
        pytest.param(Case(candidate, check, expected.get(check.id)), id=check.id)
        for check in checks
    ]
    return pytest.mark.parametrize("check", cases)

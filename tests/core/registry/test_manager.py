"""A plugin that fails, conflicts or is blocked costs only itself, and says why."""

from __future__ import annotations

import sys

import pytest
from fake_plugins import PluginFolder

from hoigs.core.errors import PluginError
from hoigs.core.registry.manager import PluginManager, Status
from hoigs.core.registry.registry import Registry
from hoigs.plugins.builtin import EXTRAS, PARTS

GOOD = 'Component("deformation:good", target="fake_good:Good", summary="fine")'


@pytest.fixture
def plugins(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield PluginFolder(tmp_path)
    for name in set(sys.modules) - before:
        if name.startswith(("fake_", "hoigs_plugin_")):
            del sys.modules[name]


def plugin_of(manager, dist):
    return next(p for p in manager.plugins if p.dist == dist)


def offers_of(manager, dist):
    return [o for o in manager.offers if o.plugin.dist == dist]


def builtin_lines(manager):
    """Those that need no extra; what the others are depends on what is installed here."""
    offers = offers_of(manager, "hoigs")
    return [(o.key, o.status, o.error) for o in offers if o.component.extra is None]


def test_builtin_parts_enter_through_the_hook(plugins):
    manager = plugins.manager()
    assert builtin_lines(manager) == [
        (part[0], Status.OK, "") for part in PARTS if part[0] not in EXTRAS
    ]
    assert {o.key: o.component.extra for o in manager.offers if o.component.extra} == EXTRAS
    assert plugin_of(manager, "hoigs").builtin


def test_a_good_plugin(plugins):
    plugins.offer("good", GOOD)
    (offer,) = offers_of(plugins.manager(), "good")
    assert (offer.status, offer.exact) == (Status.OK, "deformation:good@good")
    assert (offer.plugin.version, offer.component.summary) == ("1.2", "fine")


BROKEN = {
    "raises": ("raise RuntimeError('no\\n luck')", "RuntimeError: no luck"),
    "exits": ("import sys; sys.exit(3)", "SystemExit: 3"),
    "syntax": ("def f(:", "SyntaxError"),
    "lacks a package": ("import not_there_at_all", "not_there_at_all"),
    "misspells the hook": (
        "@hookimpl\ndef hoigs_component(): return []",
        'unknown hook "hoigs_component"; did you mean "hoigs_components"?',
    ),
    "forgets the marker": ("def hoigs_components(): return []", "not marked with @hoigs.hookimpl"),
    "has no hook": ("def hoigs_compnents(): return []", 'did you mean "hoigs_compnents"?'),
    "takes an argument": (
        "@hookimpl\ndef hoigs_components(registry): return []",
        "declared in the hookimpl",
    ),
    "raises in the hook": (
        f"@hookimpl\ndef hoigs_components():\n    yield {GOOD}\n    1 / 0",
        "ZeroDivisionError",
    ),
    "yields something else": (
        "@hookimpl\ndef hoigs_components():\n    yield 'deformation:good'",
        "expected hoigs.Component",
    ),
    "returns no list": ("@hookimpl\ndef hoigs_components(): return 3", "TypeError"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_plugin_costs_only_itself(plugins, case):
    source, reason = BROKEN[case]
    plugins.add("bad", source)
    plugins.offer("good", GOOD)
    manager = plugins.manager()
    bad = plugin_of(manager, "bad")
    assert bad.status is Status.BROKEN and reason in bad.error and "\n" not in bad.error
    assert not offers_of(manager, "bad")
    assert offers_of(manager, "good")[0].status is Status.OK
    assert {status for _, status, _ in builtin_lines(manager)} == {Status.OK}
    assert manager.failures() == [f"bad (bad-plugin): broken: {bad.error}"]


@pytest.mark.parametrize(
    ("component", "reason"),
    [
        ('Component("deformations:x", target="a:B")', 'did you mean "deformation"?'),
        ('Component("deformation", target="a:B")', 'expected "kind:name"'),
        ('Component("deformation:X y", target="a:B")', 'expected "kind:name"'),
        ('Component("deformation:x", target="a.B")', 'expected "package.module:Class"'),
        ('Component("deformation:x", target="a:B", config="a")', 'config is "a"'),
    ],
)
def test_a_wrong_component_costs_only_itself(plugins, component, reason):
    plugins.offer("mixed", component, GOOD)
    wrong, good = offers_of(plugins.manager(), "mixed")
    assert wrong.status is Status.BROKEN and reason in wrong.error
    assert good.status is Status.OK


def test_two_distributions_with_one_key_and_nobody_wins(plugins):
    plugins.offer("good", GOOD)
    plugins.offer("rival", GOOD, 'Component("deformation:other", target="a:B")')
    manager = plugins.manager()
    both = [o for o in manager.offers if o.key == "deformation:good"]
    assert [o.status for o in both] == [Status.CONFLICT, Status.CONFLICT]
    registry = Registry(manager)
    assert "deformation:good" not in registry.keys("deformation")
    assert "deformation:other" in registry.keys("deformation")
    with pytest.raises(PluginError) as caught:
        registry.component("deformation:good")
    for words in ("good and rival", "deformation:good@good or deformation:good@rival"):
        assert words in str(caught.value)
    assert registry.origin("deformation:good@rival")["dist"] == "rival"
    assert registry.origin("deformation:good@GOOD")["version"] == "1.2"


def test_builtin_parts_cannot_be_shadowed(plugins):
    plugins.offer("shadow", 'Component("deformation:chs", target="fake_shadow:Mine")')
    manager = plugins.manager()
    (offer,) = offers_of(manager, "shadow")
    assert offer.status is Status.CONFLICT and "deformation:chs@shadow" in offer.error
    registry = Registry(manager)
    assert registry.origin("deformation:chs")["dist"] == "hoigs"
    assert registry.component("deformation:chs@shadow").target == "fake_shadow:Mine"


def test_a_distribution_that_calls_itself_builtin_is_not(plugins):
    plugins.offer("hoigs2", 'Component("deformation:chs", target="a:B")', module="fake_builtin")
    assert not plugin_of(plugins.manager(), "hoigs2").builtin


def test_one_plugin_offering_a_key_twice(plugins):
    plugins.offer("good", GOOD, GOOD)
    offers = offers_of(plugins.manager(), "good")
    assert {o.error for o in offers} == {"deformation:good is offered 2 times by good"}


def test_another_interface_number(plugins):
    plugins.offer("late", 'Component("deformation:late", target="a:B", api=2)', GOOD)
    late, good = offers_of(plugins.manager(), "late")
    assert late.status is Status.INCOMPATIBLE
    assert "interface 2, this hoigs has 1" in late.error
    assert good.status is Status.OK


def test_an_incompatible_rival_is_no_rival(plugins):
    plugins.offer("good", GOOD)
    plugins.offer("late", 'Component("deformation:good", target="a:B", api=2)')
    assert Registry(plugins.manager()).origin("deformation:good")["dist"] == "good"


def test_an_extra_that_is_not_installed(plugins):
    component = 'Component("{}", target="a:B", extra="{}")'
    plugins.offer(
        "wants",
        component.format("body:one", "gpu"),
        component.format("body:two", "here"),
        requires=("not-there-at-all>=2; extra == 'gpu'", "pluggy ; extra == 'here'"),
    )
    one, two = offers_of(plugins.manager(), "wants")
    assert one.status is Status.NEEDS_EXTRA and two.status is Status.OK
    assert "needs not-there-at-all: pip install 'wants[gpu]'" in one.error


def test_two_distributions_with_one_module(plugins):
    module = plugins.offer("good", GOOD)
    plugins.offer("other", GOOD, module=module)
    manager = plugins.manager()
    statuses = {p.dist: p.status for p in manager.plugins}
    assert sorted(statuses[dist] for dist in ("good", "other")) == ["broken", "ok"]
    assert f"{module} is already the plugin" in manager.failures()[0]


def test_nothing_but_the_builtin_parts(plugins):
    module = plugins.offer("good", GOOD)
    manager = plugins.manager({"HOIGS_PLUGINS": "0"})
    assert module not in sys.modules
    assert plugin_of(manager, "good").status is Status.BLOCKED
    assert {o.plugin.dist for o in manager.offers} == {"hoigs"}
    assert len(manager.offers) == len(PARTS)
    assert not manager.failures() and not manager.notes


def test_the_allow_list_decides_before_the_import(plugins):
    plugins.offer("good", GOOD)
    module = plugins.add("bad-one", "raise RuntimeError")
    manager = plugins.manager({"HOIGS_PLUGINS": "Good"})
    assert offers_of(manager, "good")[0].status is Status.OK
    assert plugin_of(manager, "bad-one").status is Status.BLOCKED
    assert module not in sys.modules
    assert plugin_of(plugins.manager({"HOIGS_PLUGINS": "bad_one"}), "bad-one").status == "broken"


def test_an_empty_allow_list_is_none(plugins):
    plugins.offer("good", GOOD)
    assert offers_of(plugins.manager({"HOIGS_PLUGINS": ""}), "good")


def test_blocking_a_plugin_and_a_component(plugins):
    plugins.offer("good", GOOD)
    plugins.offer("rival", GOOD)
    manager = plugins.manager({"HOIGS_BLOCK": "rival, density:adc"})
    assert plugin_of(manager, "rival").status is Status.BLOCKED
    registry = Registry(manager)
    assert registry.origin("deformation:good")["dist"] == "good"
    with pytest.raises(PluginError, match="density:adc@hoigs is named in HOIGS_BLOCK"):
        registry.component("density:adc")
    exact = plugins.registry({"HOIGS_BLOCK": "deformation:good@good"})
    assert exact.origin("deformation:good")["dist"] == "rival"


def test_names_in_the_settings_that_mean_nothing(plugins):
    plugins.offer("good", GOOD)
    manager = plugins.manager({"HOIGS_PLUGINS": "goood", "HOIGS_BLOCK": "density:adv"})
    assert manager.notes == [
        'HOIGS_PLUGINS names "goood", which is not installed; did you mean "good"?',
        'HOIGS_BLOCK names "density:adv", which is not installed; did you mean "density:adc"?',
    ]


def test_strict(plugins):
    plugins.offer("good", GOOD)
    plugins.manager({"HOIGS_STRICT": "1"})
    plugins.add("bad", "raise RuntimeError('no luck')")
    with pytest.raises(PluginError, match=r"bad-plugin.*no luck"):
        plugins.manager({"HOIGS_STRICT": "1"})
    plugins.manager({"HOIGS_STRICT": "0"})


FILE = """
import hoigs

@hoigs.hookimpl
def hoigs_components():
    yield hoigs.Component("density:mine", target=f"{__name__}:Mine")

class Mine(__import__("hoigs.core.interfaces.density").core.interfaces.density.DensityControl):
    def refine(self, *args, **kwargs): ...
"""


def test_a_plugin_file(plugins, tmp_path):
    path = tmp_path / "my plugin.py"
    path.write_text(FILE)
    manager = plugins.manager({"HOIGS_PLUGINS": "0"})
    manager.load_file(path)
    manager.load_file(path)  # again is the same
    registry = Registry(manager)
    assert registry.get("density:mine").__name__ == "Mine"
    origin = registry.origin("density:mine")
    assert origin["dist"] == "my plugin.py" and origin["version"].startswith("sha256:")
    assert registry.get("density:mine@my plugin.py") is registry.get("density:mine")


def test_a_plugin_file_that_does_not_work(plugins, tmp_path):
    manager = plugins.manager()
    count = len(manager.plugins)
    path = tmp_path / "x.py"
    with pytest.raises(PluginError, match="expected an existing Python file"):
        manager.load_file(path)
    for source, reason in (("1 / 0", "ZeroDivisionError"), ("a = 1", "no function hoigs_comp")):
        path.write_text(source)
        with pytest.raises(PluginError, match=reason):
            manager.load_file(path)
    assert len(manager.plugins) == count and not manager.failures()


def test_managers_do_not_share_anything(plugins):
    plugins.offer("good", GOOD)
    with_plugin, empty = plugins.manager(), PluginManager({})
    assert offers_of(with_plugin, "good") and not empty.offers and not empty.plugins

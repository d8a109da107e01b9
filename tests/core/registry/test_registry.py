"""Names to classes, and what is said when that fails."""

from __future__ import annotations

import sys

import pytest
from fake_plugins import PluginFolder

from hoigs.core.errors import PluginError
from hoigs.core.registry.component import missing_target
from hoigs.core.registry.manager import Status
from hoigs.core.registry.registry import Registry, default_registry

MODULE = """
from pydantic import BaseModel
from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.density import DensityControl

class Good(DensityControl):
    def refine(self, *args, **kwargs): ...

class GoodConfig(ComponentConfig):
    rate: float = 1.0

class NoConfig(BaseModel): ...

class UseConfig(ComponentConfig):
    use: int = 3

class Stranger: ...

class Bare(DensityControl): ...

@hookimpl
def hoigs_components():
    def component(name, target, config=None, kind="density"):
        config = config and f"fake_parts:{config}"
        return Component(f"{kind}:{name}", target=f"fake_parts:{target}", config=config)

    return [
        component("good", "Good", "GoodConfig"),
        component("plain", "Good"),
        component("bare", "Bare"),
        component("stranger", "Stranger", "GoodConfig"),
        component("function", "hoigs_components"),
        component("absent", "Goood", "GoodConfig"),
        component("no-config", "Good", "NoConfig"),
        component("use", "Good", "UseConfig"),
        Component("density:heavy", target="fake_heavy:Good"),
        Component("density:extra", target="fake_heavy:Good", extra="gpu"),
    ]
"""


@pytest.fixture
def registry(tmp_path, monkeypatch) -> Registry:
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("fake_parts", "fake_heavy"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "fake_heavy.py").write_text("import not_there_at_all")
    folder = PluginFolder(tmp_path)
    folder.add("parts", MODULE, module="fake_parts")
    return folder.registry()


def refusal(call, key: str) -> str:
    with pytest.raises(PluginError) as caught:
        call(key)
    return str(caught.value)


def test_a_class_and_its_config(registry):
    assert registry.get("density:good").__name__ == "Good"
    assert registry.config_class("density:good")().rate == 1.0
    assert not registry.config_class("density:plain").model_fields
    assert registry.origin("density:good") == {
        "key": "density:good@parts",
        "dist": "parts",
        "version": "1.2",
        "target": "fake_parts:Good",
    }


def test_keys(registry):
    assert {"density:good", "density:adc"} <= set(registry.keys("density"))
    assert all(key.startswith("density:") for key in registry.keys("density"))
    assert set(registry.keys("density")) < set(registry.keys())


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("deformation:csh", 'did you mean "deformation:chs"?'),
        ("chs", 'did you mean "deformation:chs"?'),
        ("deformations:chs", 'unknown kind "deformations"; did you mean "deformation"?'),
        ("features:chs", "known: features:body-parts"),
        ("deformation:chs@nobody", 'not offered by "nobody"; write deformation:chs@hoigs'),
        ("deformation:csh@hoigs", 'did you mean "deformation:chs"?'),
    ],
)
def test_unknown_names_answer_with_the_nearest(registry, key, words):
    for call in (registry.component, registry.get, registry.config_class, registry.origin):
        assert words in refusal(call, key)


def test_an_unknown_name_mentions_plugins_that_failed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    folder = PluginFolder(tmp_path)
    folder.add("bad", "raise RuntimeError")
    assert "bad (broken)" in refusal(folder.registry().component, "deformation:lost")


@pytest.mark.parametrize(
    ("key", "words"),
    [
        (
            "density:stranger",
            "the class Stranger, expected a subclass of hoigs.core.interfaces.density.Dens",
        ),
        ("density:function", "a function, expected a subclass of"),
        ("density:absent", "cannot import fake_parts:Goood: AttributeError"),
        ("density:heavy", "cannot import fake_heavy:Good: ModuleNotFoundError"),
    ],
)
def test_a_target_that_is_wrong_costs_only_itself(registry, key, words):
    assert words in refusal(registry.get, key)
    assert words in refusal(registry.get, key)  # and it stays so
    broken = [o for o in registry.manager.offers if o.status is Status.BROKEN]
    assert [o.key for o in broken] == [key] and words in broken[0].error
    assert registry.get("density:good")


def test_a_class_that_lacks_methods_is_refused_where_it_is_built(registry):
    assert registry.get("density:bare").__name__ == "Bare"  # settings are read without building
    said = refusal(registry.concrete, "density:bare")
    assert said.endswith("lacks refine of hoigs.core.interfaces.density.DensityControl")
    assert registry.concrete("density:good").__name__ == "Good"


def test_a_target_that_needs_an_extra(registry):
    assert "pip install 'parts[gpu]'" in refusal(registry.get, "density:extra")
    offer = next(o for o in registry.manager.offers if o.key == "density:extra")
    assert offer.status is Status.NEEDS_EXTRA


def test_configs_that_are_wrong(registry):
    assert "expected a subclass of hoigs.core.config" in refusal(
        registry.config_class, "density:no-config"
    )
    assert 'has a field "use"' in refusal(registry.config_class, "density:use")


def test_checking_without_importing(registry):
    for offer in registry.manager.offers:
        if offer.plugin.dist == "parts":
            registry.check(offer)
    errors = {o.key: o.error for o in registry.manager.offers if o.status is Status.BROKEN}
    assert set(errors) == {"density:absent", "density:heavy", "density:extra"}
    assert 'has no "Goood"; did you mean "Good"?' in errors["density:absent"]
    assert '"not_there_at_all", which is not installed' in errors["density:heavy"]
    assert "fake_heavy" not in sys.modules


def test_loading_everything_finds_what_checking_cannot(registry):
    for offer in registry.manager.offers:
        if offer.plugin.dist == "parts":
            registry.try_loading(offer)
    offers = [o for o in registry.manager.offers if o.plugin.dist == "parts"]
    found = {o.key for o in offers if o.status is not Status.OK}
    names = ("bare", "stranger", "function", "absent", "no-config", "use", "heavy", "extra")
    assert found == {f"density:{name}" for name in names}


def test_missing_targets(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "fake_package"
    (package / "inner").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('must not be imported')")
    (package / "inner" / "part.py").write_text("A = B = 1\n")
    (package / "lazy.py").write_text("def __getattr__(name): ...")
    (package / "bad.py").write_text("def f(:")
    (package / "native.cpython-311.so").write_bytes(b"")
    assert missing_target("fake_package.inner.part:B") is None
    assert missing_target("fake_package.lazy:Anything") is None
    assert missing_target("fake_package.native:Anything") is None
    assert 'has no "C"' in missing_target("fake_package.inner.part:C")
    assert "SyntaxError in bad.py, line 1" in missing_target("fake_package.bad:A")
    for module in ("not_there_at_all", "fake_package.not_there", "fake_package.not.there"):
        assert missing_target(f"{module}:A") == f'no module "{module}"'
    assert "fake_package" not in sys.modules


def test_the_default_registry_is_made_once():
    assert default_registry() is default_registry()
    assert "deformation:chs" in default_registry().keys("deformation")

"""Every check of plugins kills its mutant: a distribution with one mistake; and the three doors."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

from hoigs.core.errors import PluginError
from hoigs.core.registry.manager import GROUP, PluginManager
from hoigs.core.registry.registry import Registry
from hoigs.testing import Options, Outcome, check, check_plugin, conformance
from hoigs.testing.plugin import CHECKS, probe_targets, subject

HOOK = """
import hoigs
@hoigs.hookimpl
def hoigs_components():
    yield hoigs.Component("deformation:mine", "{module}_part:Mine", config="{module}_part:Config",
                          summary={summary!r}, extra={extra!r})
"""
PART = """
from hoigs.core.config import ComponentConfig
from hoigs.core.interfaces.deformation import DeformationModel
from hoigs.plugins.deformation.static import Static
class Config(ComponentConfig):
    pass
class Mine(Static):
    pass
"""
THREAD = "import threading\nthreading.Thread(target=threading.Event().wait, daemon=True).start()\n"
ENDED = """
class Mine(Static):
    def __init__(self, end=0.0):
        super().__init__()
"""
ABSTRACT = """
class Mine(DeformationModel):
    @classmethod
    def from_config(cls, config, context):
        return Static()
"""
# code added to the plugin's module, to the component's module, and other declarations
MUTANTS: dict[str, tuple[str, str, dict[str, str]]] = {
    "P01": ("import scipy\n", "", {}),
    "P02": ("print('hello')\n", "", {}),
    "P03": (THREAD, "", {}),
    "P04": ("import time\ntime.sleep(1.1)\n", "", {}),
    "P05": ("", ABSTRACT, {}),
    "P06": ("", "print('hello')\n", {}),
    "P07": ("", THREAD, {}),
    "P08": ("", "", {"rival": "yes"}),
    "P09": ("", "", {"summary": ""}),
    "P10": (
        "",
        "class Mine(Static):\n    def __init__(self):\n        raise ValueError('no')\n",
        {},
    ),
    "P11": ("", "", {"extra": "nope"}),
    "P12": ("", "Config.model_config['extra'] = 'ignore'\nConfig.model_rebuild(force=True)\n", {}),
    "P13": ("", "class Config(ComponentConfig):\n    end: float = float('inf')\n" + ENDED, {}),
}


def distribution(site: Path, dist: str, code: str = "", part: str = "", **declared: str) -> None:
    module = dist.replace("-", "_")
    hook = HOOK.format(
        module=module, summary=declared.get("summary", "mine"), extra=declared.get("extra")
    )
    (site / f"{module}.py").write_text(code + hook)
    (site / f"{module}_part.py").write_text(PART + part)
    info = site / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {dist}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{dist} = {module}\n")


def registry_of(site: Path) -> Registry:
    manager = PluginManager({})
    found = metadata.distributions(path=[str(site)])
    manager.load_installed([e for d in found for e in d.entry_points if e.group == GROUP])
    return Registry(manager)


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_every_check_has_its_mutant() -> None:
    assert set(MUTANTS) == {c.id for c in CHECKS}


@pytest.fixture(scope="module")
def sites(tmp_path_factory) -> Iterator[dict[str, Path]]:
    """A folder like site-packages for each mutant; all components are probed in one process."""
    sites = {id: tmp_path_factory.mktemp(id) for id in MUTANTS}
    before = list(sys.path)
    sys.path[:0] = [str(site) for site in sites.values()]
    for id, (code, part, declared) in MUTANTS.items():
        dist = f"acme-{id.lower()}"
        distribution(sites[id], dist, code, part, **declared)
        if "rival" in declared:
            distribution(sites[id], f"{dist}-rival")
    probe_targets(f"acme_{id.lower()}_part" for id in MUTANTS)
    yield sites
    sys.path[:] = before


@pytest.mark.parametrize("id", list(MUTANTS))
def test_a_check_kills_its_mutant_alone(id, sites, kill) -> None:
    dist = f"acme-{id.lower()}"
    registry = registry_of(sites[id])
    mutant = subject(f"deformation:mine@{dist}", registry, Options())
    kill(CHECKS, mutant, id, dist)


def test_check_reports_a_good_plugin(site) -> None:
    distribution(site, "acme-good")
    registry = registry_of(site)
    (report,) = check_plugin("acme-good", registry=registry)
    assert report.ok and report.subject == "deformation:mine@acme-good", report
    assert {r.id[0] for r in report.results} == {"P", "D"}
    with pytest.raises(PluginError, match='acme-good"'):
        check_plugin("acme-goood", registry=registry)
    with pytest.raises(ValueError, match="D99"):
        check("deformation:mine", registry=registry, expected_failures={"D99": "no such"})


def test_expected_failures_are_counted_and_must_fail() -> None:
    report = check("density:none", expected_failures={"N05": "it does not fail"})
    assert not report.ok and report.count(Outcome.UNEXPECTED_PASS) == 1
    report = check("density:budget", expected_failures={"P10": "count has no default"})
    assert report.count(Outcome.EXPECTED_FAILURE) == 1


def test_what_cannot_be_made_fails() -> None:
    report = check("density:budget")
    (built,) = [r for r in report.results if r.id == "P10"]
    assert not report.ok and "--set count=" in built.why
    assert check("density:budget", settings={"count": 70}).ok


def test_a_report_loads_no_pytest() -> None:
    import subprocess

    code = "import hoigs.testing, sys; assert not {'pytest', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@conformance("deformation:linear-displacement")
def test_as_a_user_would(check) -> None:
    try:
        check()
    except pytest.skip.Exception as skipped:  # a skip, with the reason
        assert re.search("does not (declare|provide)|declares no", str(skipped))

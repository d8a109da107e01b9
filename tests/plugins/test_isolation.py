"""Strange plugins, installed as pip would: each costs only itself, has its line and its page."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import pytest

from hoigs.cli.parts import as_text, describe_all
from hoigs.core.errors import PluginError
from hoigs.core.registry.manager import GROUP, PluginManager
from hoigs.core.registry.registry import Registry

OFFER = """
@hoigs.hookimpl
def hoigs_components():
    yield hoigs.Component({fields})
"""
FINE = OFFER.format(fields="'density:{name}', target='{module}:Mine'")

# name of the distribution -> its module after `import hoigs`, {name} and {module} filled in
STRANGE = {
    "raises-oddly": "class Odd(BaseException): ...\nraise Odd('neither Exception nor exit')",
    "raises-in-a-function": "def deep(): return {{}}['no such key']\ndef outer(): deep()\nouter()",
    "hook-raises": "@hoigs.hookimpl\ndef hoigs_components():\n    yield {{}}['lost']",
    "hook-misspelt": "@hoigs.hookimpl\ndef hoigs_componets(): return []",
    "hook-wraps": "@hoigs.hookimpl(wrapper=True)\ndef hoigs_components():\n    return (yield)",
    "hook-endless": "import itertools\n@hoigs.hookimpl\ndef hoigs_components():\n"
    "    for i in itertools.count(): yield hoigs.Component(f'density:x{{i}}', target='a:B')",
    "offers-nothing": "@hoigs.hookimpl\ndef hoigs_components(): return []",
    "offers-numbers": OFFER.format(fields="3, target='a:B'"),
    "offers-two-lines": OFFER.format(
        fields="'density:two', target='{module}:Mine', summary='one\\ntwo\\x1b[31m'"
    )
    + "class Mine: ...",
    "late-interface": OFFER.format(fields="'density:late', target='{module}:Mine', api=99"),
    "lacks-extra": OFFER.format(fields="'density:gpu', target='{module}:Mine', extra='gpu'"),
    "names-no-extra": OFFER.format(fields="'density:gup', target='{module}:Mine', extra='gup'"),
    "slow-one": "import time; time.sleep(0.4)\n" + FINE + "class Mine: ...",
    "loud-one": "import sys; print('hello'); print('oh', file=sys.stderr)\n"
    + FINE
    + "class Mine: ...",
    "threaded-one": "import threading, time\ndef forever():\n    while True: time.sleep(0.05)\n"
    "threading.Thread(target=forever, name='endless').start()\n" + FINE + "class Mine: ...",
    "heavy-one": "import numpy\n" + FINE + "class Mine: ...",
    "class-raises": OFFER.format(fields="'density:inner', target='class_raises_inner:Mine'"),
    "no-text": OFFER.format(fields="'density:bytes', target='no_text_inner:Mine'"),
}
EXTRAS = {"lacks-extra": "gpu", "names-no-extra": "gpu"}
FILES = {
    "class_raises_inner.py": b"def f():\n    raise OSError('no licence file')\nf()\nMine = 0",
    "no_text_inner.py": b"class Mine: ...\0",
    "second.py": b"x = 1",
}


def install(site: Path, dist: str, source: str) -> None:
    module = dist.replace("-", "_")
    text = source.format(name=dist, module=module)
    (site / f"{module}.py").write_text(f"import hoigs\n{text}\n")
    info = site / f"{module}-2.0.dist-info"
    info.mkdir()
    lines = ["Metadata-Version: 2.1", f"Name: {dist}", "Version: 2.0"]
    if dist in EXTRAS:
        lines.append(f"Requires-Dist: not-there-at-all; extra == '{EXTRAS[dist]}'")
    (info / "METADATA").write_text("\n".join(lines) + "\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{dist} = {module}\n")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """All of them in one environment, with a good one, a damaged one and two of one name."""
    folder = tmp_path_factory.mktemp("site")
    for dist, source in STRANGE.items():
        install(folder, dist, source)
    install(folder, "good-one", FINE + "class Mine: ...")
    for name, content in FILES.items():
        (folder / name).write_bytes(content)
    (folder / "damaged.py").write_text("import hoigs\n" + FINE.format(name="d", module="damaged"))
    (folder / "damaged-1.dist-info").mkdir()
    (folder / "damaged-1.dist-info" / "entry_points.txt").write_text(f"[{GROUP}]\nd = damaged\n")
    for i in (1, 2):  # different distributions, one name of an entry point
        install(folder, f"twin-{i}", FINE + "class Mine: ...")
        entry = folder / f"twin_{i}-2.0.dist-info" / "entry_points.txt"
        entry.write_text(f"[{GROUP}]\ntwin = twin_{i}\n")
    twice = folder / "good_one-2.0.dist-info" / "entry_points.txt"
    twice.write_text(f"[{GROUP}]\ngood-one = good_one\ngood-one = second\n")
    return folder


@pytest.fixture(scope="module")
def rows(site) -> list[dict]:
    """What `hoigs plugins --json` says, in a process that has to end by itself."""
    done = hoigs(site, "plugins", "--json")
    return json.loads(done.stdout)["plugins"]


def hoigs(site: Path | None, *args: str) -> subprocess.CompletedProcess[str]:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("HOIGS_")}
    return subprocess.run(
        [sys.executable, "-m", "hoigs", *args],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        env={**clean, "PYTHONPATH": "" if site is None else str(site)},
    )


@pytest.fixture(scope="module")
def registry(site) -> Registry:
    """The same in this process, for the pages."""
    sys.path.insert(0, str(site))
    manager = PluginManager({})
    found = metadata.distributions(path=[str(site)])
    own = [e for e in metadata.entry_points(group=GROUP) if e.dist and e.dist.name == "hoigs"]
    manager.load_installed(own + [e for d in found for e in d.entry_points if e.group == GROUP])
    yield Registry(manager)
    sys.path.remove(str(site))


def of(rows: list[dict], dist: str) -> dict[str, tuple[str, str]]:
    """Key -> status and error of the rows of one distribution."""
    return {r["key"]: (r["status"], r["error"]) for r in rows if r["dist"] == dist}


def test_nobody_else_is_touched(site, rows):
    alone = json.loads(hoigs(None, "plugins", "--json").stdout)["plugins"]
    same = lambda rows: [{**r, "seconds": 0} for r in rows]  # noqa: E731
    assert [r for r in same(rows) if r["dist"] == "hoigs"] == same(
        [r for r in alone if r["dist"] == "hoigs"]
    )
    assert of(rows, "good-one")["density:good-one"] == ("ok", "")
    assert of(rows, "twin-1") == {"density:twin-1": ("ok", "")}
    assert of(rows, "twin-2") == {"density:twin-2": ("ok", "")}
    assert of(rows, "unknown") or of(rows, "damaged")  # without a name, but not lost


BROKEN = {
    "raises-oddly": "cannot load raises_oddly: Odd: neither Exception nor exit",
    "raises-in-a-function": "cannot load raises_in_a_function: KeyError: 'no such key'",
    "hook-raises": "KeyError: 'lost'",
    "hook-misspelt": 'unknown hook "hoigs_componets"; did you mean "hoigs_components"?',
    "hook-wraps": "hoigs_components is marked as a wrapper; mark it with @hoigs.hookimpl alone",
    "hook-endless": "hoigs_components yielded more than 1000 components",
    "offers-numbers": "hoigs.Component: key is 3, expected a str",
}


@pytest.mark.parametrize("dist", BROKEN)
def test_a_plugin_that_fails_has_its_line_and_its_page(rows, registry, dist):
    assert of(rows, dist) == {f"(plugin {dist})": ("broken", BROKEN[dist])}
    (page,) = describe_all(dist, registry)
    text = as_text(page)
    assert page["status"] == "broken" and page["distribution"] == f"{dist} 2.0"
    assert BROKEN[dist] in text and f"{dist} = {dist.replace('-', '_')}" in text
    raised = "KeyError" in BROKEN[dist] or "Odd" in BROKEN[dist]
    assert bool(page["traceback"]) == raised


def test_the_traceback_ends_where_it_happened(registry):
    (page,) = describe_all("raises-in-a-function", registry)
    assert "def deep(): return {}['no such key']" in page["traceback"]
    assert page["traceback"].endswith("KeyError: 'no such key'")
    assert len(page["traceback"].splitlines()) < 15


COMPONENTS = {
    "late-interface": ("density:late", "incompatible", "interface 99, this hoigs has 1"),
    "lacks-extra": ("density:gpu", "needs-extra", "pip install 'lacks-extra[gpu]'"),
    "names-no-extra": (
        "density:gup",
        "broken",
        'names-no-extra has no extra "gup"; did you mean "gpu"?',
    ),
    "no-text": ("density:bytes", "broken", "cannot import no_text_inner:Mine"),
}


@pytest.mark.parametrize("dist", COMPONENTS)
def test_a_component_that_cannot_be_used_has_its_line_and_its_page(rows, registry, dist):
    key, status, reason = COMPONENTS[dist]
    assert of(rows, dist)[key][0] == status and reason in of(rows, dist)[key][1]
    (page,) = describe_all(key, registry)
    assert page["component"] == f"{key}@{dist}" and page["status"] == status
    assert reason in page["error"] and page["settings"] is None


REMARKS = {
    "offers-nothing": "offers nothing",
    "slow-one": "slow: 0.4 s at every start of hoigs",
    "loud-one": 'prints while it is imported: "hello oh"',
    "threaded-one": "starts threads while it is imported: endless",
    "heavy-one": "imports numpy even for a listing",
}


@pytest.mark.parametrize("dist", REMARKS)
def test_bad_manners_are_told_and_cost_nothing(rows, dist):
    said = of(rows, dist)
    status, text = said[f"(plugin {dist})"]
    assert status == "ok" and REMARKS[dist] in text
    if dist != "offers-nothing":
        assert said[f"density:{dist}"] == ("ok", "")


def test_slow_imports_are_timed(rows, registry):
    seconds = {r["dist"]: r["seconds"] for r in rows}
    assert 0.4 <= seconds["slow-one"] < 5 and seconds["hoigs"] < 0.2
    (page,) = describe_all("density:slow-one", registry)
    assert float(page["plugin import"].split()[0]) >= 0.4
    assert page["remarks"] == ["slow: 0.4 s at every start of hoigs"]


def test_one_entry_point_twice_costs_the_second(rows):
    said = of(rows, "good-one")
    assert said["(plugin good-one)"] == ("broken", 'good-one has two entry points "good-one"')


def test_no_line_breaks_in_the_listing(site):
    lines = hoigs(site, "plugins").stdout.splitlines()
    (line,) = (line for line in lines if line.startswith("density:two"))
    assert line.endswith("one two[31m")


def test_a_class_that_cannot_be_imported_has_its_traceback(rows, registry):
    assert of(rows, "class-raises")["density:inner"] == ("ok", "")  # the listing imports no class
    (page,) = describe_all("density:inner", registry)
    assert page["status"] == "broken"
    assert page["error"].endswith("OSError: no licence file")
    assert "class_raises_inner.py" in page["traceback"] and "in f" in page["traceback"]


def test_the_page_of_a_component(registry):
    (page,) = describe_all("deformation:chs", registry)
    text = as_text(page)
    for line in (
        "component:         deformation:chs@hoigs",
        "target:            hoigs.plugins.deformation.chs:CubicHermite",
        "    keyframe_step: int >= 1; default 4",
        "        Frames between knots (the paper's 4).",
        "    adaptive.begin: float >= 0 and <= 1; default 0.2",
    ):
        assert line in text.splitlines()
    assert describe_all("deformation:chs@HOIGS", registry)[0]["status"] == "ok"
    assert describe_all("density:none", registry)[0]["settings"] == []


def test_a_name_that_is_not_there(registry):
    with pytest.raises(PluginError, match='did you mean "deformation:chs"'):
        describe_all("deformation:chz", registry)
    with pytest.raises(PluginError, match='did you mean "good-one"'):
        describe_all("god-one", registry)


def test_stdout_is_the_commands_own_when_classes_are_imported(tmp_path):
    install(tmp_path, "late-talker", OFFER.format(fields="'density:talk', target='talker:Mine'"))
    (tmp_path / "talker.py").write_text(
        "print('hello')\nfrom hoigs.core.interfaces.density import DensityControl\n"
        "class Mine(DensityControl):\n    def refine(self, *given): ...\n"
    )
    done = hoigs(tmp_path, "plugins", "show", "density:talk", "--json")
    assert json.loads(done.stdout)[0]["status"] == "ok" and "hello" in done.stderr


def test_a_listing_takes_no_longer_for_a_thread_that_never_ends(tmp_path):
    install(tmp_path, "threaded-one", STRANGE["threaded-one"])
    began = time.perf_counter()
    assert "density:threaded-one" in hoigs(tmp_path, "plugins").stdout
    assert time.perf_counter() - began < 20  # it would never end

"""`hoigs plugins new`: what it writes installs, is listed, passes its own tests; or it says why."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hoigs.cli.parts import NewKind

ROOT = Path(__file__).parents[2]
RUFF = [sys.executable, "-m", "ruff"]
CONFIG = ["--config", str(ROOT / "pyproject.toml")]


def run(*command: object, site: Path | None = None, cwd: Path | None = None) -> str:
    environ = dict(os.environ, PYTHONPATH="" if site is None else str(site))
    done = subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, env=environ, cwd=cwd
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def packages(tmp_path_factory) -> Path:
    """One package of each kind, written by the command."""
    folder = tmp_path_factory.mktemp("packages")
    for kind in NewKind:
        hoigs = [sys.executable, "-m", "hoigs", "plugins", "new"]
        run(*hoigs, f"acme-{kind}-one", "--kind", kind, "--out", folder)
    return folder


@pytest.fixture(scope="module")
def site(packages) -> Path:
    """Where pip has installed them all."""
    target = packages / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-index", "--no-deps", "--no-build-isolation", "--target", target]
    run(*pip, *offline, *sorted(packages.glob("acme-*")))
    return target


def test_they_are_listed(site):
    listing = run(sys.executable, "-m", "hoigs", "plugins", site=site)
    found = {tuple(line.split()[:3]) for line in listing.splitlines() if "acme-" in line}
    assert found == {(f"{k}:acme-{k}-one", "ok", f"acme-{k}-one") for k in NewKind}


PYTEST = [sys.executable, "-m", "pytest", "-q", "--import-mode=importlib"]


@pytest.mark.slow
def test_their_own_tests_pass(packages, site):
    one = {kind: packages / f"acme-{kind}-one" for kind in NewKind}
    first, drawing = one.pop(NewKind.deformation), one.pop(NewKind.rasterizer)
    # the rules of drawing are tested at length elsewhere, and P06 starts two more processes
    some = [f"{drawing}/tests/test_conformance.py::test_conforms[{id}]" for id in ("P10", "R01")]
    for command, least in (
        ([*PYTEST, first], 12),
        ([*PYTEST, *one.values(), *some, "-k", "not P06"], 6 * 12),
    ):
        said = run(*command, site=site, cwd=packages)
        passed = int(said.split(" passed")[0].split()[-1])
        assert passed >= least, said  # the kit asks each of them as much


SPECS = """
import sys
import hoigs as h
from hoigs.synthesis import SceneConfig
clip = h.read_clip(h.builtin_clip(h.AnnyBody(), SceneConfig.tiny()))
few = [f"model.{name}.points=50" for name in ("scene", "human", "object")]
for path in sys.argv[1:]:
    spec = h.Spec.load(path, overrides=few)
    model = h.compose(spec, clip)
    image = model.render(clip.moments[3], clip.cameras[3]).color
    print(*spec.components().values(), bool(image.isfinite().all() and image.max() > 0.05))
"""


def test_a_spec_uses_each_by_name(packages, site):
    specs = sorted([*packages.glob("acme-*/*.yaml")])
    kinds = sorted(set(NewKind) - {NewKind.reader, NewKind.exporter})  # specs name neither
    assert [path.stem for path in specs] == [f"acme-{kind}-one" for kind in kinds]
    lines = run(sys.executable, "-c", SPECS, *specs, site=site).splitlines()
    for kind, line in zip(kinds, lines, strict=True):
        assert f"{kind}:acme-{kind}-one" in line.split()
        assert line.split()[-1] == "True"


def test_they_are_tidy(packages):
    folders = sorted(packages.glob("acme-*"))
    # which imports are first-party differs between here and there
    run(*RUFF, "check", "--ignore", "I001", *CONFIG, *folders)
    run(*RUFF, "format", "--check", *CONFIG, *folders)
    for folder in folders:
        (module,) = (p for p in folder.glob("acme_*/*.py") if p.stem != "__init__")
        assert len(module.read_text().splitlines()) < 100


def test_a_folder_that_is_there_stays(hoigs, tmp_path):
    made = hoigs("plugins", "new", "acme-bounce", "--out", tmp_path)
    assert made.code == 0, made.err
    assert "pip install -e" in made.out
    (tmp_path / "acme-bounce" / "README.md").write_text("mine")
    again = hoigs("plugins", "new", "acme-bounce", "--out", tmp_path, "--kind", "reader")
    assert again.code == 2 and "is there already" in again.err
    assert (tmp_path / "acme-bounce" / "README.md").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["acme-bounce"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Acme Bounce", 'did you mean "acme-bounce"?'),
        ("acme_bounce", 'did you mean "acme-bounce"?'),
        ("3d", "a letter first"),
        ("../out", 'did you mean "out"?'),
        ("class", "Python has a class"),
        ("json", "Python has a json"),
        ("torch", "a module torch is installed here already"),
        ("chs", "deformation:chs is built in"),
        ("moment", "the class would be Moment"),
        ("component", "the class would be Component"),
    ],
)
def test_names_that_cannot_be(hoigs, tmp_path, name, said):
    made = hoigs("plugins", "new", name, "--out", tmp_path)
    assert made.code == 2 and made.err.startswith("error: ") and said in made.err
    assert not list(tmp_path.iterdir())


def test_the_wheel_has_the_templates():
    from hatchling.builders.wheel import WheelBuilder

    files = {f.distribution_path for f in WheelBuilder(str(ROOT)).recurse_included_files()}
    templates = ROOT / "hoigs" / "cli" / "templates"
    there = {str(p.relative_to(ROOT)) for p in templates.rglob("*.tmpl")}
    assert len(there) > 15 and there <= files

"""Plugins as strangers ship them: installed distributions, seen through the command line."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
import torch

from hoigs.core.errors import SpecError
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.model.compose import compose
from hoigs.core.model.entity import Entity
from hoigs.core.registry.manager import GROUP, PluginManager
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, FrameStore, ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.topology import TopologyChange

EXAMPLE = Path(__file__).parents[2] / "examples" / "third_party_plugin"

SPEC = """
name: with-b-splines
rasterizer: {use: "rasterizer:torch"}
interaction: {use: "interaction:none"}
model:
  scene: {deformation: {use: "deformation:static"}, points: 5}
  object: {deformation: {use: "deformation:b-spline", step: 2}, points: 6}
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A site folder with the example, built and installed by pip."""
    folder = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-index", "--no-deps", "--no-build-isolation", "--target", str(folder)]
    done = subprocess.run(
        [*pip, *offline, str(EXAMPLE)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def registry(installed, monkeypatch) -> Registry:
    monkeypatch.syspath_prepend(installed)
    manager = PluginManager({})
    manager.load_installed()
    return Registry(manager)


def write_plugin(site: Path, dist: str, source: str) -> None:
    """Another installed distribution, written out as pip would."""
    site.mkdir(exist_ok=True)
    module = dist.replace("-", "_")
    (site / f"{module}.py").write_text(f"import hoigs\n{source}")
    info = site / f"{module}-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {dist}\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{dist} = {module}\n")


def offering(**fields: object) -> str:
    arguments = ", ".join(f"{name}={value!r}" for name, value in fields.items())
    return f"@hoigs.hookimpl\ndef hoigs_components():\n    yield hoigs.Component({arguments})\n"


def hoigs(*args: str, sites: tuple[Path, ...] = (), code: int = 0, **environ: str) -> str:
    """Standard output of a `hoigs` command in a process of its own (stderr when it must fail)."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("HOIGS_")}
    paths = list(map(str, sites))
    done = subprocess.run(
        [sys.executable, "-m", "hoigs", *args],
        capture_output=True,
        text=True,
        check=False,
        env={**clean, **environ, "PYTHONPATH": os.pathsep.join(paths)},
    )
    assert done.returncode == code, done.stderr
    return done.stderr if code else done.stdout


def new_lines(before: str, after: str) -> list[str]:
    """Lines that were added; no line may have gone or changed."""
    old, new = before.splitlines(), after.splitlines()
    added = [line for line in new if line not in old]
    assert [line for line in new if line in old] == old
    return added


class NoPixels(FrameStore):
    def image(self, position):
        raise AssertionError("composing looks at no pixels")

    mask = depth = image


@pytest.fixture
def clip() -> Clip:
    """Two seconds of a cup that slides along a parabola and turns."""
    frames = 9
    t = torch.linspace(0, 1, frames)
    angle = t * 0.5
    zero = torch.zeros(frames)
    turns = quats_to_matrices(torch.stack((angle.cos(), zero, zero, angle.sin()), 1))
    cup = ObjectTrack(
        points=torch.rand(6, 3, generator=torch.Generator().manual_seed(1)) * 0.1,
        colors=torch.rand(6, 3),
        rotations=turns,
        translations=torch.stack((t, t**2, 2 + zero), 1),
        observed=torch.ones(frames, dtype=torch.bool),
    )
    K = torch.tensor([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
    return Clip(
        name="cup",
        store=NoPixels(),
        cameras=[Camera(K, torch.eye(4), 16, 16)] * frames,
        moments=[Moment(i / (frames - 1), i) for i in range(frames)],
        kinds={"cup": "object"},
        objects={"cup": cup},
        points=torch.tensor([[0.0, 0, 4]] * 5) + torch.arange(5)[:, None] * 0.1,
        point_colors=torch.rand(5, 3),
        split={"train": list(range(frames)), "test": []},
    )


def test_a_spec_uses_the_example_by_name(registry, clip):
    spec = Spec.parse(SPEC, registry=registry)
    model = compose(spec, clip, registry)
    cup = model.entity("cup")
    assert type(cup.deformation).__module__ == "hoigs_bspline.deformation"
    assert cup.deformation.control.shape == (6, 4 + 3, 3)
    frame = clip.moments[4]
    # a B-spline misses its control points, which follow the track t^2 every 1/4, by a sixth of
    # their second difference: 2 / 16 / 6 = 2.1 cm on a path of 1 m
    track = clip.objects["cup"]
    expected = cup.means @ track.rotations[4].T + track.translations[4]
    assert (cup(frame).means - expected).norm(dim=-1).max() < 0.021
    output = model.render(frame, clip.cameras[4])
    output.color.sum().backward()
    assert output.alpha.max() > 0.01
    gradient = cup.deformation.control.grad.norm(dim=-1).sum(0)
    assert gradient.isfinite().all()
    assert (gradient > 0).tolist() == [False, False, True, True, True, False, False]
    assert registry.provenance(spec)["model.object.deformation"] == {
        "key": "deformation:b-spline@hoigs-bspline",
        "dist": "hoigs-bspline",
        "version": "0.1.0",
        "target": "hoigs_bspline.deformation:UniformBSpline",
    }


def test_its_settings_are_checked_as_ours_are(registry):
    with pytest.raises(SpecError) as caught:
        Spec.parse(SPEC.replace("step: 2", "stp: 2"), source="my.yaml", registry=registry)
    assert str(caught.value) == (
        'my.yaml:7:55 model.object.deformation.stp: unknown key; did you mean "step"?'
    )


def test_the_example_without_any_registry(registry, clip):
    splines = importlib.import_module("hoigs_bspline.deformation")
    points = torch.rand(4, 3)
    model = splines.UniformBSpline(splines.UniformBSpline.Config(step=4), num_frames=13)
    assert model.segments == 3
    entity = Entity(Gaussians.from_points(points), model)
    for time in (0.0, 0.3, 1.0):  # all control points at rest: it stays there
        torch.testing.assert_close(entity(Moment(time)).means, points)
    torch.nn.init.normal_(model.control, generator=torch.Generator().manual_seed(2))
    canonical, h = entity.canonical, 1e-3
    for time in (0.1, 1 / 3, 0.7):  # the derivative is the velocity, also across a knot
        ahead, behind = (entity(Moment(time + s)).means for s in (h, -h))
        slope = (ahead - behind) / (2 * h) / model.segments
        torch.testing.assert_close(
            model.velocity(canonical, Moment(time)), slope, atol=2e-3, rtol=0
        )
    ends = (model.control[:, :3] * torch.tensor([1, 4, 1])[:, None] / 6).sum(1)
    torch.testing.assert_close(entity(Moment(-1.0)).means, ends)
    change = TopologyChange(
        torch.tensor([2, 2]), torch.tensor([False, True]), torch.tensor([[0.0, 0, 0], [1, 2, 3]])
    )
    before = entity(Moment(0.4)).means[2]
    entity.apply_topology(change, entity.canonical[change.source])
    torch.testing.assert_close(entity(Moment(0.4)).means, before + change.offsets)
    assert splines.UniformBSpline(num_frames=1).segments == 1


def test_the_example_adds_one_line_to_the_listing(installed):
    (line,) = new_lines(hoigs("plugins"), hoigs("plugins", sites=(installed,)))
    assert line.split()[:4] == ["deformation:b-spline", "ok", "hoigs-bspline", "0.1.0"]


def test_a_broken_plugin_changes_one_line_and_nothing_else(installed, tmp_path):
    write_plugin(tmp_path, "broken-plugin", "raise RuntimeError('deliberately')\n")
    before = hoigs("plugins", sites=(installed,))
    after = hoigs("plugins", sites=(tmp_path, installed))
    (line,) = new_lines(before, after)
    assert line.split()[:5] == ["(plugin", "broken-plugin)", "broken", "broken-plugin", "2.0"]
    assert "RuntimeError: deliberately" in line
    rows = json.loads(hoigs("plugins", "--json", sites=(tmp_path, installed)))["plugins"]
    assert [r["key"] for r in rows if r["dist"] == "broken-plugin"] == ["(plugin broken-plugin)"]


def test_a_component_that_cannot_be_imported_is_shown(tmp_path):
    source = offering(key="density:lost", target="not_there_at_all:Lost")
    write_plugin(tmp_path, "lost-plugin", source)
    (line,) = new_lines(hoigs("plugins"), hoigs("plugins", sites=(tmp_path,)))
    assert line.split()[:2] == ["density:lost", "broken"]
    assert 'no module "not_there_at_all"' in line


def test_only_importing_finds_some_faults(tmp_path):
    source = offering(key="density:late", target="late_plugin:Late") + "class Late: pass\n"
    write_plugin(tmp_path, "late-plugin", source)
    (line,) = new_lines(hoigs("plugins"), hoigs("plugins", sites=(tmp_path,)))
    assert line.split()[:2] == ["density:late", "ok"]
    (line,) = new_lines(hoigs("plugins", "--load"), hoigs("plugins", "--load", sites=(tmp_path,)))
    assert (
        "broken" in line
        and "expected a subclass of hoigs.core.interfaces.density.DensityControl" in line
    )


def test_a_conflict_has_no_winner(installed, registry, tmp_path, monkeypatch):
    write_plugin(tmp_path, "rival", offering(key="deformation:b-spline", target="rival:Mine"))
    lines = hoigs("plugins", sites=(tmp_path, installed)).splitlines()
    both = [line for line in lines if line.startswith("deformation:b-spline")]
    assert [line.split()[1:3] for line in both] == [
        ["conflict", d] for d in ("hoigs-bspline", "rival")
    ]
    monkeypatch.syspath_prepend(tmp_path)
    manager = PluginManager({})
    manager.load_installed()
    rivals = Registry(manager)
    with pytest.raises(SpecError) as caught:
        Spec.parse(SPEC, registry=rivals)
    for exact in ("deformation:b-spline@hoigs-bspline", "deformation:b-spline@rival"):
        assert exact in str(caught.value)
    exact = SPEC.replace("b-spline", "b-spline@hoigs-bspline")
    assert Spec.parse(exact, registry=rivals).model["object"] == replace_use(
        Spec.parse(SPEC, registry=registry).model["object"], "deformation:b-spline@hoigs-bspline"
    )


def replace_use(block, use):
    return block.model_copy(
        update={"deformation": block.deformation.model_copy(update={"use": use})}
    )


def test_a_plugin_for_another_interface(tmp_path):
    write_plugin(tmp_path, "future", offering(key="density:new", target="future:New", api=2))
    (line,) = new_lines(hoigs("plugins"), hoigs("plugins", sites=(tmp_path,)))
    assert line.split()[:2] == ["density:new", "incompatible"]


def test_letting_nobody_in(installed, tmp_path):
    marker = tmp_path / "imported"
    write_plugin(tmp_path, "nosy", f"open({str(marker)!r}, 'w')\n" + offering(key="x", target="y"))
    before = hoigs("plugins")
    added = new_lines(before, hoigs("plugins", sites=(tmp_path, installed), HOIGS_PLUGINS="0"))
    assert [line.split()[:3] for line in added] == [
        ["(plugin", "bspline)", "blocked"],
        ["(plugin", "nosy)", "blocked"],
    ]
    assert not marker.exists()
    assert hoigs("plugins", sites=(tmp_path, installed), HOIGS_PLUGINS="nosy") and marker.exists()


def test_strict(tmp_path):
    write_plugin(tmp_path, "broken-plugin", "raise RuntimeError('deliberately')\n")
    error = hoigs("plugins", sites=(tmp_path,), code=2, HOIGS_STRICT="1")
    assert error.startswith("error: HOIGS_STRICT: broken-plugin (broken-plugin): broken: ")


def test_a_plugin_file_by_explicit_flag(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import hoigs\nfrom hoigs.core.interfaces.density import DensityControl\n"
        "class Mine(DensityControl):\n    def refine(self, *given): ...\n"
        "@hoigs.hookimpl\ndef hoigs_components():\n"
        "    yield hoigs.Component('density:mine', target=f'{__name__}:Mine')\n"
    )
    (line,) = new_lines(
        hoigs("plugins", "--load"), hoigs("plugins", "--load", "--plugin", str(path))
    )
    assert line.split()[:3] == ["density:mine", "ok", "mine.py"]


def test_the_listing_is_quick_and_light(installed):
    probe = (
        "import sys; sys.argv = ['hoigs', 'plugins']; from hoigs.cli.main import app\n"
        "try: app()\nexcept SystemExit: pass\n"
        "print({'torch', 'warp', 'numpy'} & set(sys.modules) or 'light', len(sys.modules))"
    )
    env = {**os.environ, "PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, "-c", probe], capture_output=True, text=True, check=True, env=env
    )
    word, modules = done.stdout.splitlines()[-1].rsplit(maxsplit=1)
    # 382 when this was written, in 0.3 s; what makes a listing slow is what it imports
    assert word == "light" and int(modules) < 600
    assert "deformation:b-spline" in done.stdout


def test_the_example_spec_reads(registry):
    assert metadata.version("hoigs-bspline") == "0.1.0"
    spec = Spec.load(EXAMPLE / "hoigs-bspline.yaml", registry=registry)
    assert spec.model["object"].deformation.settings == {"step": 4}
    assert spec.model["human"].deformation.use == "deformation:hexplane-skinning"

"""`hoigs plugins new`: a package with one component, to be filled with a method of one's own."""

from __future__ import annotations

import importlib.util
import keyword
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from enum import StrEnum
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template
from typing import Annotated

import typer

TEMPLATES = "templates"
SUFFIX = ".tmpl"
_NAME = re.compile(r"[a-z][a-z0-9]*(?:-[a-z0-9]+)*")


class NewKind(StrEnum):
    """Kinds that there is a template for."""

    deformation = "deformation"
    features = "features"
    interaction = "interaction"
    density = "density"
    reader = "reader"
    rasterizer = "rasterizer"
    exporter = "exporter"


SUMMARIES = {
    NewKind.deformation: "a line and sine waves for each Gaussian",
    NewKind.features: "one token a Gaussian, of place and time",
    NewKind.interaction: "objects follow the mean of the humans' tokens",
    NewKind.density: "removes what can hardly be seen",
    NewKind.reader: "a folder with scene.npz and images",
    NewKind.rasterizer: "plain torch, every splat at every pixel",
    NewKind.exporter: "a text file of positions and opacities for each moment",
}

# the command that uses a component, where it is not the training of a spec that names it
USAGES = {
    NewKind.reader: "hoigs train FOLDER        # reads {name}'s folders",
    NewKind.exporter: "hoigs plugins check exporter:{name}",
}


def new(
    name: Annotated[str, typer.Argument(help="Of the package and the component: acme-bounce.")],
    kind: Annotated[NewKind, typer.Option("--kind", help="What it offers.")] = NewKind.deformation,
    out: Annotated[Path, typer.Option("--out", help="Where the folder NAME is made.")] = Path(),
) -> None:
    """Write a package of your own: a working component, its tests, an entry point, a README."""
    folder = write_package(name, kind, out)
    typer.echo(f"{folder}: {kind}:{name}, ready to install and to change:")
    typer.echo(f"  cd {folder}\n  pip install -e '.[test]'\n  pytest")
    typer.echo(f"  hoigs plugins show {kind}:{name}")
    if (folder / f"{name}.yaml").is_file():
        typer.echo(f"  hoigs train builtin:carry --spec {name}.yaml")
        typer.echo(f"  hoigs chart builtin:carry --specs hoigs,{name}.yaml --budgets 300 --seeds 1")


def write_package(name: str, kind: NewKind, out: Path) -> Path:
    """Fill the templates of `kind` and put the package at `out`/`name`, whole or not at all.

    Raises:
        HoigsError: the name cannot be that of a package, or the folder is there already.
    """
    from hoigs.core.errors import HoigsError
    from hoigs.core.registry.component import API

    check_name(name, kind)
    folder = out / name
    if folder.exists() or folder.is_symlink():
        raise HoigsError(f"{folder} is there already and stays as it is; choose another name")
    words = {
        "name": name,
        "kind": kind.value,
        "key": f"{kind}:{name}",
        "module": name.replace("-", "_"),
        "cls": class_name(name),
        "api": str(API),
        "summary": SUMMARIES[kind],
        "usage": USAGES.get(kind, "hoigs train CLIP --spec {name}.yaml").format(name=name),
    }
    root = resources.files("hoigs.cli") / TEMPLATES
    out.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=out))
    try:
        made = scratch / name
        for part in ("common", kind.value):
            _fill(root / part, made, words)
        made.rename(folder)
    finally:
        shutil.rmtree(scratch)
    return folder


def check_name(name: str, kind: NewKind) -> None:
    """Raise HoigsError unless a distribution, a module, a class and a component can have `name`."""
    from hoigs.core.errors import HoigsError
    from hoigs.core.registry.registry import default_registry

    if not _NAME.fullmatch(name):
        near = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
        hint = f'; did you mean "{near}"?' if _NAME.fullmatch(near) else ""
        raise HoigsError(
            f'name "{name}": expected lower-case letters, digits and single dashes, a letter '
            f"first, for example acme-bounce{hint}"
        )
    module = name.replace("-", "_")
    if keyword.iskeyword(module) or module in sys.stdlib_module_names:
        raise HoigsError(f'name "{name}": Python has a {module} of its own; choose another name')
    for offer in default_registry().manager.offers:
        if offer.plugin.builtin and offer.key == f"{kind}:{name}":
            raise HoigsError(f"{kind}:{name} is built in and cannot be replaced; choose another")
    if importlib.util.find_spec(module) is not None:
        raise HoigsError(
            f'name "{name}": a module {module} is installed here already; choose another name'
        )
    cls = class_name(name)
    root = resources.files("hoigs.cli") / TEMPLATES / kind.value / "package"
    text = (root / f"{kind}.py{SUFFIX}").read_text(encoding="utf-8")
    if re.search(rf"\b{cls}(Config)?\b", text):
        raise HoigsError(f'name "{name}": the class would be {cls}, which the module imports')


def class_name(name: str) -> str:
    """acme-bounce -> AcmeBounce."""
    return "".join(part.capitalize() for part in name.split("-"))


def _fill(source: Traversable, target: Path, words: Mapping[str, str]) -> None:
    """Copy a folder of templates with `words` filled in; `package` becomes the module's name."""
    for entry in source.iterdir():
        if entry.is_dir():
            name = words["module"] if entry.name == "package" else entry.name
            _fill(entry, target / name, words)
        elif entry.name.endswith(SUFFIX):
            name = entry.name.removesuffix(SUFFIX)
            name = f"{words['name']}.yaml" if name == "spec.yaml" else name
            text = Template(entry.read_text(encoding="utf-8")).substitute(words)
            target.mkdir(parents=True, exist_ok=True)
            (target / name).write_text(text, encoding="utf-8")

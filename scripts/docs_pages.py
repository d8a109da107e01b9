"""Pages of the site that are made from the code, whenever the site is built (see mkdocs.yml).

python scripts/docs_pages.py FOLDER      writes them into FOLDER, to look at
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

Pages = dict[str, str | bytes]


def on_files(files: Any, config: Any) -> Any:
    """mkdocs hook: add the pages, and list in the menu whatever reference pages there are."""
    from mkdocs.structure.files import File

    for path, content in pages().items():
        files.append(File.generated(config, path, content=content))
    _complete_menu(config.nav, {f.src_uri for f in files.documentation_pages()})
    return files


def pages() -> Pages:
    """Path below docs/ -> content."""
    return {
        "reference/cli.md": cli_page(),
        "reference/spec-schema.md": schema_page(),
        **component_pages(),
    }


def _complete_menu(menu: list[Any], there: set[str]) -> None:
    """Reference pages that mkdocs.yml does not list go below the others."""
    listed = set(_paths(menu))
    (reference,) = (entry["Reference"] for entry in menu if "Reference" in entry)
    reference.extend(sorted(p for p in there if p.startswith("reference/") and p not in listed))


def _paths(menu: Any) -> Iterator[str]:
    if isinstance(menu, str):
        yield menu
    for entry in (
        menu.values() if isinstance(menu, dict) else menu if isinstance(menu, list) else ()
    ):
        yield from _paths(entry)


def cli_page() -> str:
    """Every command with its arguments and options, from the parser itself."""
    import typer

    from hoigs.cli.main import app

    lines = [
        "# Commands",
        "",
        "Every option that takes a spec key takes it as in [specs](spec.md).",
        "",
    ]

    def walk(command: Any, words: list[str]) -> None:
        context = command.context_class(command, info_name=words[-1])
        for name, child in sorted(getattr(command, "commands", {}).items()):
            walk(child, [*words, name])
        if len(words) > 1:
            lines.extend(_command(command, context, words))

    walk(typer.main.get_command(app), ["hoigs"])
    return "\n".join(lines)


def _command(command: Any, context: Any, words: list[str]) -> list[str]:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and p.name != "help"]
    usage = " ".join([*words, *((p.metavar or p.name.upper()) for p in arguments), "[OPTIONS]"])
    lines = [f"## {' '.join(words)}", "", " ".join((command.help or "").split()), ""]
    lines += ["```", usage, "```", ""]
    if arguments or options:
        lines += ["| argument or option | meaning | default |", "|---|---|---|"]
    for parameter in arguments:
        name = parameter.metavar or parameter.name.upper()
        lines.append(f"| `{name}` | {_cell(parameter.help)} | |")
    for option in options:
        name = ", ".join([*option.opts, *option.secondary_opts])
        default = "" if option.default in (None, False, ()) else f"`{_plain(option.default)}`"
        lines.append(f"| `{name}` | {_cell(option.help)} | {default} |")
    return [*lines, ""]


def _plain(value: Any) -> str:
    return str(getattr(value, "value", value))


def schema_page() -> str:
    """The blocks of a spec, every key with type, default and meaning."""
    from hoigs.core.registry.settings import describe_settings
    from hoigs.core.spec.schema import EntitySpec, Spec
    from hoigs.core.spec.train_schema import EvaluationSpec, TrainSpec

    lines = [
        "# Schema of a spec",
        "",
        "Beside `use`, a component takes its own settings: [components](components.md).",
        "`hoigs spec check FILE` holds a file to all of this.",
        "",
    ]
    for title, config in (
        ("The file", Spec),
        ("model.NAME", EntitySpec),
        ("train", TrainSpec),
        ("evaluation", EvaluationSpec),
    ):
        left_out = ("train.", "evaluation.", "rasterizer.", "interaction.", "density.")
        rows = [
            s
            for s in describe_settings(config)
            if config is TrainSpec or not s.name.startswith(left_out)
        ]
        lines += [f"## {title}", "", *_settings_table(rows), ""]
    schema = json.dumps(Spec.model_json_schema(), indent=1)
    return "\n".join([*lines, "## As JSON schema", "", "```json", schema, "```", ""])


def _settings_table(rows: list[Any]) -> list[str]:
    if not rows:
        return ["Nothing to set."]
    lines = ["| key | type | default | meaning |", "|---|---|---|---|"]
    for row in rows:
        default = "required" if row.default is None else f"`{_cell(row.default)}`"
        lines.append(f"| `{row.name}` | `{_cell(row.type)}` | {default} | {_cell(row.meaning)} |")
    return lines


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


def component_pages() -> Pages:
    """The gallery: every component of hoigs with its settings; pictures where they are cheap."""
    from hoigs.core.registry.component import KINDS
    from hoigs.core.registry.registry import default_registry
    from hoigs.core.registry.settings import describe_settings

    registry = default_registry()
    files: Pages = {}
    lines = [
        "# Components",
        "",
        "All that come with hoigs. `hoigs plugins` lists yours too, `hoigs plugins show KEY` is",
        "this page for one of them.",
        "",
    ]
    for kind in KINDS:
        offers = [
            o for o in registry.manager.offers if o.component.kind == kind and o.plugin.builtin
        ]
        if offers:
            lines += [f"## {kind}", ""]
        for offer in sorted(offers, key=lambda o: o.key):
            extra = offer.component.extra
            needs = f" Needs `pip install 'hoigs[{extra}]'`." if extra else ""
            lines += [f"### {offer.key}", "", f"{_cell(offer.component.summary)}.{needs}", ""]
            if offer.key in PREVIEWS:
                name = offer.key.replace(":", "-") + ".png"
                files[f"reference/pictures/{name}"] = _png(PREVIEWS[offer.key]())
                lines += [f"![{offer.key}](pictures/{name})", ""]
            if offer.status == "ok":
                config = registry.config_class(offer.key)
                lines += _settings_table(describe_settings(config))
                lines += ["", f"`{offer.component.target}`", ""]
    return {"reference/components.md": "\n".join(lines), **files}


def _cloud(count: int = 400) -> Any:
    """A shell of coloured splats, 3 m away."""
    import torch

    import hoigs as h

    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    colors = 0.5 + 0.5 * points
    return h.Gaussians.from_points(points * 0.8, colors, scales=0.06, opacity=0.8)


def _camera(size: int = 160) -> Any:
    import torch

    import hoigs as h

    eye = torch.tensor([0.0, 0.6, -3.0])
    return h.Camera.look_at(eye, torch.zeros(3), width=size, height=size, fov_y=0.65)


def _strip(deformation: Any) -> Any:
    """The cloud at five moments, side by side."""
    import torch

    import hoigs as h

    torch.manual_seed(0)
    entity = h.Entity(_cloud(), deformation)
    for parameter in entity.deformation.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    rasterizer = h.TorchRasterizer()
    with torch.no_grad():
        drawn = [rasterizer.render(entity(h.Moment(i / 4)), _camera(120)).color for i in range(5)]
    return torch.cat(drawn, dim=1)


def _drawn_by(name: str) -> Any:
    import torch

    import hoigs as h

    with torch.no_grad():
        return getattr(h, name)().render(_cloud(), _camera()).color


def _body(name: str) -> Any:
    import math

    import torch

    import hoigs as h

    rest = getattr(h, name)().canonical(4000)
    rest = rest.replace(opacity_logits=torch.full_like(rest.opacity_logits, 2.0))
    lit = h.Gaussians.from_points(rest.means, _shading(rest.means), opacity=0.9)
    middle = rest.means.mean(0)
    eye = middle + torch.tensor([1.2, 0.3, 2.6])
    camera = h.Camera.look_at(eye, middle, width=160, height=200, fov_y=math.radians(48))
    with torch.no_grad():
        return h.TorchRasterizer().render(lit, camera).color


def _shading(points: Any) -> Any:
    """Colours by place, so that the shape shows."""
    low, high = points.min(0).values, points.max(0).values
    return 0.25 + 0.7 * (points - low) / (high - low)


def _deformation(name: str, **settings: Any) -> Callable[[], Any]:
    import hoigs as h

    def picture() -> Any:
        kind = getattr(h, name)
        return _strip(kind(kind.Config(**settings)) if settings else kind())

    return picture


PREVIEWS: dict[str, Callable[[], Any]] = {
    "rasterizer:torch": lambda: _drawn_by("TorchRasterizer"),
    "rasterizer:warp": lambda: _drawn_by("WarpRasterizer"),
    "rasterizer:oracle": lambda: _drawn_by("OracleRasterizer"),
    "body:anny": lambda: _body("AnnyBody"),
    "deformation:static": _deformation("Static"),
    "deformation:chs": _deformation("CubicHermite", keyframes=5),
    "deformation:mlp": _deformation("MlpDeformation"),
    "deformation:hexplane-field": _deformation("HexPlaneField"),
}


def _png(image: Any) -> bytes:
    from PIL import Image

    pixels = (image.clamp(0, 1) * 255).byte().cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


if __name__ == "__main__":
    for path, content in pages().items():
        target = Path(sys.argv[1]) / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content if isinstance(content, bytes) else content.encode())

"""The dependency drawing and the tables of docs/design/structure.md, made from the imports.

    python scripts/structure.py            # rewrite them
    python scripts/structure.py --check    # exit 1 if modules import each other in a circle

An arrow points from a package to one that it imports. Arrows that follow from a chain of others
are left out (transitive reduction), and each package stands above all that it imports.
"""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import astuple, dataclass
from pathlib import Path

import grimp
import networkx as nx

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "design" / "structure.md"
DRAWING = ROOT / "docs" / "assets" / "structure.svg"
DRAWN = ("hoigs", "hoigs.core")  # one panel each


def packages_of(graph: grimp.ImportGraph, parent: str) -> nx.DiGraph:
    """Imports between the packages directly below `parent`, as a graph without redundant edges."""
    children = sorted(m for m in graph.find_children(parent) if graph.find_children(m))
    found = nx.DiGraph()
    found.add_nodes_from(name.rpartition(".")[2] for name in children)
    for importer in children:
        for imported in children:
            if importer != imported and graph.direct_import_exists(
                importer=importer, imported=imported, as_packages=True
            ):
                found.add_edge(importer.rpartition(".")[2], imported.rpartition(".")[2])
    return found


def rows_of(graph: nx.DiGraph) -> dict[str, int]:
    """Each node's row, 0 at the bottom: one above the highest of what it imports.

    Raises:
        ValueError: packages import each other in a circle.
    """
    circle = next(nx.simple_cycles(graph), None)
    if circle:
        raise ValueError(f"circular imports: {' -> '.join([*circle, circle[0]])}")
    row: dict[str, int] = {}
    for node in reversed(list(nx.topological_sort(graph))):
        row[node] = max((row[below] + 1 for below in graph.successors(node)), default=0)
    return row


def circles(graph: grimp.ImportGraph) -> list[list[str]]:
    """Modules that import each other in a circle, imports under TYPE_CHECKING included."""
    imports = nx.DiGraph()
    for module in graph.modules:
        imports.add_edges_from((module, n) for n in graph.find_modules_directly_imported_by(module))
    return sorted(sorted(c) for c in nx.strongly_connected_components(imports) if len(c) > 1)


def draw(panels: dict[str, nx.DiGraph], path: Path) -> None:
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"svg.hashsalt": "hoigs", "font.size": 9, "svg.fonttype": "none"})
    rows = {name: rows_of(graph) for name, graph in panels.items()}
    heights = [max(row.values()) + 1 for row in rows.values()]
    figure, axes = plt.subplots(
        1, len(panels), figsize=(6.2 * len(panels), 0.85 * max(heights) + 0.6), squeeze=False
    )
    for axis, (name, graph) in zip(axes[0], panels.items(), strict=True):
        _panel(axis, name, nx.transitive_reduction(graph), rows[name], max(heights))
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def _panel(axis, name: str, graph: nx.DiGraph, row: dict[str, int], height: int) -> None:
    place: dict[str, tuple[float, float]] = {}
    for level in range(max(row.values()) + 1):
        nodes = sorted(node for node in row if row[node] == level)
        for index, node in enumerate(nodes):
            place[node] = ((index + 1) / (len(nodes) + 1), level)
    for importer, imported in sorted(graph.edges):
        (x0, y0), (x1, y1) = place[importer], place[imported]
        bend = 0.0 if y0 - y1 < 1.5 else 0.18 * (1 if x0 + x1 >= 1 else -1)
        axis.annotate(
            "", (x1, y1 + 0.21), (x0, y0 - 0.21),
            arrowprops={
                "arrowstyle": "-|>", "color": "#8a94a6", "linewidth": 1, "shrinkA": 0,
                "shrinkB": 0, "connectionstyle": f"arc3,rad={bend}",
            },
        )  # fmt: skip
    for node, (x, y) in place.items():
        axis.text(
            x, y, node, ha="center", va="center", color="#1c2733",
            bbox={"boxstyle": "round,pad=0.4", "facecolor": "#e8eef7", "edgecolor": "#5b7db1"},
        )  # fmt: skip
    axis.set(xlim=(-0.02, 1.02), ylim=(-0.6, height - 0.4), title=f"{name}/")
    axis.axis("off")


# lines that packages should need, in thousands
BUDGET = {
    "cli": 2, "core": 12, "evaluation": 2.5, "plugins": 19, "preparation": 10, "studies": 6,
    "synthesis": 3, "testing": 3.5, "viewing": 4, "training + runs": 4.5,
    "rasterizers + metrics": 6.5,
}  # fmt: skip
MANY = 8  # parameters


@dataclass(frozen=True)
class Size:
    """What the files of a package come to; counts add up."""

    modules: int = 0
    folders: int = 0
    lines: int = 0
    imports: int = 0
    comments: int = 0
    many: int = 0

    def __add__(self, other: Size) -> Size:
        return Size(*map(sum, zip(astuple(self), astuple(other), strict=True)))


def size_of(path: Path) -> Size:
    """Of one module. Functions of Warp are left out: a kernel is passed its arrays one by one."""
    text = path.read_text(encoding="utf-8")
    imports, many = 0, 0
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports += (node.end_lineno or node.lineno) - node.lineno + 1
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if any(ast.unparse(mark).startswith("wp.") for mark in node.decorator_list):
                continue
            given = node.args
            names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
            many += len([name for name in names if name not in {"self", "cls"}]) >= MANY
    lines = text.splitlines()
    comments = sum(line.lstrip().startswith("#") for line in lines)
    return Size(1, path.name == "__init__.py", len(lines), imports, comments, many)


def sizes() -> dict[str, Size]:
    """By package; some are counted together, as their budgets are."""
    found: dict[str, Size] = {}
    for path in sorted((ROOT / "hoigs").rglob("*.py")):
        package = path.relative_to(ROOT / "hoigs").parts[0]
        name = next((key for key in BUDGET if package in key.split(" + ")), None)
        if name:
            found[name] = found.get(name, Size()) + size_of(path)
    return dict(sorted(found.items()))


def table(found: dict[str, Size]) -> str:
    many = f"functions of {MANY}+ parameters"
    head = ("package", "modules", "folders", "lines", "budget", "imports", "comments", many)
    rows = [head, ("---",) * len(head)]
    for name, size in {**found, "all": sum(found.values(), Size())}.items():
        budget = f"{1000 * BUDGET.get(name, sum(BUDGET.values())):,.0f}"
        shares = (f"{count / size.lines:.1%}" for count in (size.imports, size.comments))
        counts = (str(size.modules), str(size.folders), f"{size.lines:,}", budget)
        rows.append((name, *counts, *shares, str(size.many)))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def page(text: str) -> str:
    """`text` with the table of today between its markers."""
    start, end = "<!-- sizes -->", "<!-- /sizes -->"
    return re.sub(f"{start}.*{end}", f"{start}\n{table(sizes())}\n{end}", text, flags=re.DOTALL)


def main() -> int:
    graph = grimp.build_graph("hoigs", exclude_type_checking_imports=False)
    found = circles(graph)
    for circle in found:
        print(f"these import each other in a circle: {', '.join(circle)}", file=sys.stderr)
    if found or "--check" in sys.argv:
        return int(bool(found))
    draw({name: packages_of(graph, name) for name in DRAWN}, DRAWING)
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"wrote {DRAWING.relative_to(ROOT)} and {PAGE.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

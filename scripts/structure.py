"""The dependency drawing and the tables of docs/design/structure.md, made from the imports.

    python scripts/structure.py            # rewrite them
    python scripts/structure.py --check    # exit 1 if modules import each other in a circle

An arrow points from a package to one that it imports. Arrows that follow from a chain of others
are left out (transitive reduction), and each package stands above all that it imports.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
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


def sizes() -> list[tuple[str, int, int, int]]:
    """Package, modules, lines, and the modules of its fullest folder."""
    found = []
    for package in sorted(path for path in (ROOT / "hoigs").iterdir() if path.is_dir()):
        files = list(package.rglob("*.py"))
        if not files:
            continue
        lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
        folders: dict[Path, int] = {}
        for path in files:
            folders[path.parent] = folders.get(path.parent, 0) + (path.name != "__init__.py")
        found.append((package.name, len(files), lines, max(folders.values())))
    return found


def table(rows: Iterable[tuple[str, int, int, int]]) -> str:
    rows = list(rows)
    lines = ["| package | modules | lines | modules of its fullest folder |", "|---|---|---|---|"]
    lines += [f"| `{name}` | {count} | {size:,} | {most} |" for name, count, size, most in rows]
    total = [sum(row[i] for row in rows) for i in (1, 2)]
    return "\n".join([*lines, f"| all | {total[0]} | {total[1]:,} | {max(r[3] for r in rows)} |"])


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

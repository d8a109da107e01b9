"""Time against the number of Gaussians, one panel an image size, one line a peer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from benchmarks.rasterizers.scenes import Case

COLORS = {
    "warp": "#0b6e4f",
    "warp-openmp": "#5fb48c",
    "warp-portable": "#a9cdb8",
    "warp-captured": "#5fb48c",
    "torch": "#7a7a7a",
    "oracle": "#b9b9b9",
    "gsplat-torch": "#b0413e",
    "gsplat": "#b0413e",
    "gswarp": "#3f6fb5",
}


def draw(report: dict[str, Any], path: Path) -> None:
    """Write the chart of a report's times; the file's suffix says what kind."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [row for row in report["times"] if "total_ms" in row]
    whole = {row["peer"] for row in rows if row["backward_ms"]}  # others have no backward
    sizes = sorted(
        {Case.parse(row["case"]).size for row in rows},
        key=lambda size: math.prod(map(int, size.split("x"))),
    )
    figure, panels = plt.subplots(
        1, len(sizes), figsize=(3.6 * len(sizes) + 0.6, 4.2), sharey=True, squeeze=False
    )
    for panel, size in zip(panels[0], sizes):
        for peer in dict.fromkeys(row["peer"] for row in rows):
            points = sorted(
                (Case.parse(row["case"]).count, row["total_ms"])
                for row in rows
                if row["peer"] == peer and Case.parse(row["case"]).size == size
            )
            if not points:
                continue
            counts = [count for count, _ in points]
            medians = [times["median"] for _, times in points]
            low = [times["quartiles"][0] for _, times in points]
            high = [times["quartiles"][1] for _, times in points]
            color = COLORS.get(peer, "black")
            wide = 2.4 if peer == "warp" else 1.4
            label = peer if peer in whole else f"{peer} (forward)"
            line = "o-" if peer in whole else "o--"
            panel.plot(counts, medians, line, color=color, lw=wide, ms=4, label=label)
            panel.fill_between(counts, low, high, color=color, alpha=0.18, lw=0)
        panel.set(xscale="log", yscale="log", title=size, xlabel="Gaussians")
        panel.set_xticks(*_ticks(rows, size))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.minorticks_off()
        panel.grid(True, which="major", alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0][0].set_ylabel("forward + backward, ms (median, quartiles)")
    handles = {}
    for panel in panels[0]:
        handles |= dict(zip(*reversed(panel.get_legend_handles_labels())))
    figure.legend(
        handles.values(), handles.keys(), loc="lower center", ncols=len(handles), frameon=False
    )
    machine = report["machine"]
    where = machine["device"] if machine["device"] != "cpu" else machine["processor"]
    threads = f", {machine['threads']} threads" if machine["device"] == "cpu" else ""
    figure.suptitle(f"{report['scene']['name']} · {where}{threads} · {report['date']}", fontsize=10)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _ticks(rows: list[dict[str, Any]], size: str) -> tuple[list[int], list[str]]:
    counts = sorted(
        {Case.parse(row["case"]).count for row in rows if Case.parse(row["case"]).size == size}
    )
    return counts, [f"{count // 1000}k" if count % 1000 == 0 else str(count) for count in counts]

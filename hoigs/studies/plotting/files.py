"""Figures as files."""

from __future__ import annotations

import io

import matplotlib
from matplotlib.figure import Figure

from hoigs.studies.plotting.style import STYLE

# nothing that differs between two runs of the same study
METADATA = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}


def figure_files(name: str, figure: Figure) -> dict[str, bytes]:
    """NAME.png and NAME.svg of a figure."""
    files = {}
    with matplotlib.rc_context(STYLE):
        for kind, metadata in METADATA.items():
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, metadata=metadata)
            files[f"{name}.{kind}"] = buffer.getvalue()
    return files

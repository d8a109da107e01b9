"""bug_report: what helps to find a fault, in a zip without pictures, names of users or paths."""

from __future__ import annotations

import getpass
import io
import json
import re
import socket
import zipfile
from pathlib import Path

import hoigs
from hoigs.core.errors import HoigsError
from hoigs.core.files.safe_replace import refuse_unwritable
from hoigs.core.files.whole_files import written_whole
from hoigs.core.registry.registry import default_registry
from hoigs.runs.run_folder import RunFolder
from hoigs.workflows.doctor import doctor

OF_A_RUN = ("spec.yaml", "provenance.json", "metrics.jsonl", "evaluation.json")
MOST_BYTES = 20 * 2**20  # of one file; a longer one is cut at its beginning
PATH = re.compile(r"(?<![\w.<])(?:[A-Za-z]:\\|~?/|(?:\.\./)+)(?:[^\s\"',:;<>|*?]+[/\\])+")


def bug_report(
    run: Path | str | None = None, *, out: Path | str = "hoigs-bug-report.zip"
) -> dict[str, int]:
    """Write a zip with the results of `doctor`, all plugins, and the text files of a run.

    Images, masks, weights and clips stay out. Folders, the names of the user and of the machine are
    replaced in every text.

    Args:
        run: a run folder, complete or not.

    Returns:
        The files in the zip and their sizes, bytes.

    Raises:
        HoigsError: `out` exists, or `run` is no folder.
    """
    out, texts = Path(out), {}
    if out.exists():
        raise HoigsError(f"{out}: already exists; name another file: --out FILE")
    refuse_unwritable(out)
    rows = [row._asdict() | {"ok": row.ok} for row in doctor()]
    texts["doctor.json"] = json.dumps({"hoigs": hoigs.__version__, "rows": rows}, indent=1)
    texts["plugins.txt"] = _plugins()
    if run is not None:
        texts |= _of_run(Path(run))
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(name, without_names(text))
    with written_whole(out) as part:
        part.write_bytes(made.getvalue())
    return {name: len(text.encode()) for name, text in texts.items()}


def _plugins() -> str:
    manager = default_registry().manager
    lines = [f"{p.name} {p.dist} {p.version}: {p.status} {p.error}" for p in manager.plugins]
    lines += [f"{o.exact}: {o.status} {o.error}" for o in manager.offers if o.status != "ok"]
    return "\n".join([*lines, *manager.notes])


def _of_run(path: Path) -> dict[str, str]:
    if not path.is_dir():
        raise HoigsError(f"{path}: no such folder")
    texts = {}
    for name in OF_A_RUN:
        if (path / name).is_file():
            data = (path / name).read_bytes()[-MOST_BYTES:]
            texts[f"run/{name}"] = data.decode("utf-8", "replace")
    folder = RunFolder(path).checkpoints
    listed = sorted(folder.iterdir()) if folder.is_dir() else []
    texts["run/checkpoints.txt"] = "\n".join(f"{p.name} {p.stat().st_size}" for p in listed)
    return texts


def without_names(text: str) -> str:
    """`text` with FOLDER/ for folders, and without the names of user and machine."""
    text = PATH.sub("FOLDER/", text)
    private = {_user(): "USER", socket.gethostname(): "MACHINE", Path.home().name: "USER"}
    for name, word in private.items():
        if len(name) > 2 and name != "root":
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", word, text)
    return text


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return ""

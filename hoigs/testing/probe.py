"""Import modules in a separate process; report what they load, print and start, and the time.

    python -P probe.py RESULT.json JOB.json

The job has `path` (sys.path), `first` (modules to import beforehand) and `steps`: targets to
import, each "module" or a file's path, with `hook`, to be called for its components.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any


def load(target: str) -> Any:
    if not target.endswith(".py"):
        return importlib.import_module(target)
    spec = importlib.util.spec_from_file_location("hoigs_probed", target)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hoigs_probed"] = module
    spec.loader.exec_module(module)
    return module


def step(target: str, hook: str | None) -> dict[str, Any]:
    """Import one target, with the output of the process in a file."""
    before, threads = set(sys.modules), threading.active_count()
    with tempfile.TemporaryFile() as captured:
        kept = [os.dup(1), os.dup(2)]
        for stream in (1, 2):
            os.dup2(captured.fileno(), stream)
        error = ""
        start = time.perf_counter()
        try:
            module = load(target)
            if hook is not None:
                list(getattr(module, hook)())
        except (Exception, SystemExit) as caught:  # a plugin may raise anything
            error = f"{type(caught).__name__}: {caught}"
        seconds = time.perf_counter() - start
        sys.stdout.flush()
        sys.stderr.flush()
        for stream, old in zip((1, 2), kept, strict=True):
            os.dup2(old, stream)
            os.close(old)
        captured.seek(0)
        printed = captured.read().decode(errors="replace")
    return {
        "error": error,
        "seconds": seconds,
        "printed": printed,
        "threads": [t.name for t in threading.enumerate()][threads:],
        "modules": sorted(set(sys.modules) - before),
    }


def main() -> None:
    result, job = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
    sys.path[:] = job["path"]
    for name in job["first"]:
        importlib.import_module(name)
    found = {target: step(target, job["hook"]) for target in job["steps"]}
    result.write_text(json.dumps(found))
    os._exit(0)  # do not wait for threads that a plugin has started


if __name__ == "__main__":
    main()

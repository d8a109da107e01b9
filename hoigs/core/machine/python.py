"""Starting Python without the modules of the folder where it is started.

`python -m` and `python -c` put that folder first on the path: in the folder of a data set, a
numpy.py of somebody else's would be run in place of NumPy.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# PYTHONPATH counts, as in the process itself
PYTHON = (sys.executable, "-P")
_SAFE = "PYTHONSAFEPATH"


@contextmanager
def safe_children() -> Iterator[None]:
    """As `-P` for what others start in the block, such as the workers of `multiprocessing`."""
    before = os.environ.get(_SAFE)
    os.environ[_SAFE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE]
        else:
            os.environ[_SAFE] = before

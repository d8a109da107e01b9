"""A Python of one of the versions that a tool supports."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hoigs.core.errors import HoigsError

_PROBE = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"


def find_python(versions: Sequence[str]) -> Path:
    """The running Python if its version is among `versions` ("3.11"), else one on the path.

    Raises:
        HoigsError: there is none that can make environments.
    """
    own = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if own in versions and _works(Path(sys.executable), own):
        return Path(sys.executable)
    for version in versions:
        found = shutil.which(f"python{version}")
        if found and _works(Path(found), version):
            return Path(found)
    raise HoigsError(
        f"no Python {', '.join(versions)} with venv was found (this is {own}); install one, such "
        f"as python{versions[0]} and python{versions[0]}-venv, so that `python{versions[0]}` runs"
    )


def _works(python: Path, version: str) -> bool:
    try:
        answer = subprocess.run(
            [str(python), "-I", "-c", _PROBE],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return answer.returncode == 0 and answer.stdout.strip() == version

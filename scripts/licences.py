"""The licences of everything that hoigs and its extras depend on, as installed here.

    python scripts/licences.py           # a table; exit code 1 if one is not allowed, or unknown

A package's own words count, in this order: License-Expression, classifiers, License.
"""

from __future__ import annotations

import re
import sys
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

# may be used and passed on with an Apache-2.0 program, for any purpose; LGPL and MPL as libraries
ALLOWED = re.compile(
    r"Apache|MIT|BSD|ISC\b|PSF|Python Software Foundation|Python-2\.0|MPL|Mozilla|LGPL|"
    r"Lesser General Public|Zlib|HPND|CC0|Unlicense|0BSD|BSL-1\.0|NVIDIA Proprietary|"
    r"LicenseRef-NVIDIA|public domain|"
    r"LicenseRef-TOST-1\.0",  # usd-core's: Apache-2.0 but for its rule on trademarks
    re.IGNORECASE,
)
CUDA = re.compile(r"nvidia-|cuda-")  # what torch's wheel for CUDA requires, redistributable by
# NVIDIA's terms, which its packages word in many ways or not at all
REFUSED = re.compile(
    r"(?<!L)(?<!Lesser )A?GPL|(?<!Lesser )General Public|non-?commercial|CC-BY-NC|research only",
    re.IGNORECASE,
)


def closure(name: str) -> dict[str, metadata.Distribution]:
    """The installed distributions that `name` and its extras require, directly or not."""
    found: dict[str, metadata.Distribution] = {}
    todo: list[tuple[str, tuple[str, ...]]] = [(name, _extras(name))]
    seen: set[tuple[str, tuple[str, ...]]] = set()
    while todo:
        item = todo.pop()
        if item in seen:
            continue
        seen.add(item)
        try:
            dist = metadata.distribution(item[0])
        except metadata.PackageNotFoundError:
            continue  # an extra that is not installed, or of another system
        found[canonicalize_name(item[0])] = dist
        for text in dist.requires or ():
            need = Requirement(text)
            if need.marker is None or any(
                need.marker.evaluate({"extra": extra}) for extra in (*item[1], "")
            ):
                todo.append((need.name, tuple(sorted(need.extras))))
    return found


def licence(dist: metadata.Distribution) -> str:
    """What a distribution says of its licence, in one line; empty if it says nothing."""
    data = dist.metadata
    told = data.get("License-Expression") or ""
    classified = [
        c.rpartition(" :: ")[2]
        for c in data.get_all("Classifier") or ()
        if c.startswith("License ::") and c != "License :: OSI Approved"
    ]
    told = told or " AND ".join(classified) or (data.get("License") or "").strip()
    return " ".join((told.splitlines() or [""])[0].split())[:90]


def faults(licences: dict[str, str]) -> list[str]:
    """A sentence for each package whose licence is not allowed."""
    found = []
    for name, text in sorted(licences.items()):
        if CUDA.match(name):
            continue
        either = re.split(r"\bOR\b", text)  # one of them may be chosen
        if not any(ALLOWED.search(part) and not REFUSED.search(part) for part in either):
            found.append(f"{name}: {text or 'no licence is declared'}")
    return found


def _extras(name: str) -> tuple[str, ...]:
    return tuple(metadata.distribution(name).metadata.get_all("Provides-Extra") or ())


def main() -> int:
    licences = {name: licence(dist) for name, dist in closure("hoigs").items()}
    for name, text in sorted(licences.items()):
        print(f"{name:<32} {text}")
    wrong = faults(licences)
    for line in wrong:
        print(f"not allowed: {line}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

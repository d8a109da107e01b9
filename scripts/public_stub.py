"""hoigs/__init__.pyi: the public names as plain imports, for editors and type checkers.

    python scripts/public_stub.py

`hoigs/__init__.py` resolves its names on first use, which no type checker can follow. A test
compares the stub with `hoigs._PUBLIC`.
"""

from __future__ import annotations

from pathlib import Path

STUB = Path(__file__).parents[1] / "hoigs" / "__init__.pyi"


def text() -> str:
    """What the stub has to be."""
    import hoigs

    names = sorted((module, name) for name, module in hoigs._PUBLIC.items())
    lines = [f"from hoigs import {name} as {name}" for name in hoigs._MODULES]
    lines += [f"from {module} import {name} as {name}" for module, name in names]
    return "\n".join(
        ["# written by scripts/public_stub.py", "", *lines, "", "__version__: str", ""]
    )


if __name__ == "__main__":
    STUB.write_text(text(), encoding="utf-8")
    print(STUB)

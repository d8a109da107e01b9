"""Lines of hoigs by package and kind: code, imports, documentation, blank.

    python scripts/line_kinds.py [CHECKOUT]     # default: this one

Documentation is docstrings, those of attributes included, and comments on lines of their own.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from pathlib import Path

KINDS = ("code", "imports", "documentation", "blank")


def kinds_of(text: str) -> Counter[str]:
    """The number of lines of each kind in one module."""
    lines, kind = text.splitlines(), {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found = "imports"
        elif (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            found = "documentation"
        else:
            continue
        assert node.end_lineno is not None
        kind |= dict.fromkeys(range(node.lineno - 1, node.end_lineno), found)
    for i, line in enumerate(lines):
        if i not in kind and not line.strip():
            kind[i] = "blank"
        elif i not in kind and line.lstrip().startswith("#"):
            kind[i] = "documentation"
    return Counter(kind.get(i, "code") for i in range(len(lines)))


def main() -> None:
    root = Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).resolve().parents[1]
    found: dict[str, Counter[str]] = {}
    for path in sorted((root / "hoigs").rglob("*.py")):
        name = path.relative_to(root / "hoigs").parts[0]
        found.setdefault(name, Counter()).update(kinds_of(path.read_text(encoding="utf-8")))
    found = {name: count for name, count in found.items() if not name.endswith(".py")}
    found["all"] = sum(found.values(), Counter())
    print(f"| package | {' | '.join(KINDS)} | lines |\n{'|---' * (len(KINDS) + 2)}|")
    for name, count in found.items():
        numbers = [f"{count[kind]:,}" for kind in KINDS]
        print(f"| `{name}` | {' | '.join(numbers)} | {count.total():,} |")


if __name__ == "__main__":
    main()

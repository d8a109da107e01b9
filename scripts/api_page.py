"""docs/reference/api.md: every public name with its arguments and its docstring.

    python scripts/api_page.py

A test compares the page with the code.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "api.md"
SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields):")
HEAD = """# Python API

`import hoigs as h` has these names; they load on first use. Written by `scripts/api_page.py` from
the docstrings. The settings of components, which their constructors take as keywords, are explained
by `hoigs plugins show KEY`.
"""


def text() -> str:
    """What the page has to be."""
    import hoigs

    groups: dict[str, list[str]] = {}
    for name, module in hoigs._PUBLIC.items():
        groups.setdefault(".".join(module.split(".")[:2]), []).append(name)
    lines = [HEAD]
    for package, names in groups.items():
        doc = importlib.import_module(package).__doc__ or ""
        lines += [f"## {package}", "", doc.partition("\n")[0], ""]
        for name in names:
            lines += _entry(f"h.{name}", getattr(hoigs, name))
    for module in hoigs._MODULES:
        value = getattr(hoigs, module)
        lines += [f"## h.{module}", "", (value.__doc__ or "").partition("\n")[0], ""]
        for name in value.__all__:
            lines += _entry(f"h.{module}.{name}", getattr(value, name))
    return "\n".join(lines).rstrip() + "\n"


def _entry(name: str, value: Any) -> Iterator[str]:
    yield from (f"### {name}", "", "```python", name + _arguments(value), "```", "")
    yield from _docstring(value)
    if inspect.isclass(value):
        methods = list(_methods(value))
        if methods:
            yield from ("**Members**", "", *methods, "")


def _methods(cls: type) -> Iterator[str]:
    for name, member in vars(cls).items():
        plain = member.__func__ if isinstance(member, staticmethod | classmethod) else member
        if name.startswith("_") or not (inspect.isfunction(plain) or isinstance(plain, property)):
            continue
        arguments = "" if isinstance(plain, property) else _arguments(plain, one_line=True)
        first = (inspect.getdoc(plain) or "").partition("\n\n")[0]
        yield f"- `{name}{arguments}`" + (f": {' '.join(first.split())}" if first else "")


def _arguments(value: Any, *, one_line: bool = False) -> str:
    """(name: type = default) with types as they stand in the source; short, in one line."""
    if isinstance(value, type) and issubclass(value, Enum):
        return f"({', '.join(value.__members__)})"
    try:
        parameters = list(inspect.signature(value).parameters.values())
    except (TypeError, ValueError):
        return "(...)"
    if one_line:
        return f"({', '.join(p.name for p in parameters if p.name not in ('self', 'cls'))})"
    shown, keyword = [], False
    for p in parameters:
        if p.kind is p.VAR_POSITIONAL:
            keyword = True
        if p.kind is p.KEYWORD_ONLY and not keyword:
            shown.append("*")
            keyword = True
        stars = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        typed = f": {p.annotation}" if isinstance(p.annotation, str) else ""
        default = "" if p.default is p.empty else (" = " if typed else "=") + _default(p.default)
        shown.append(f"{stars}{p.name}{typed}{default}")
    joined = f"({', '.join(shown)})"
    if len(joined) < 80:
        return joined
    return "(\n" + "".join(f"    {each},\n" for each in shown) + ")"


def _default(value: Any) -> str:
    plain = (type(None), bool, int, float, str, tuple)
    return repr(value) if type(value) in plain else "..."


def _docstring(value: Any) -> Iterator[str]:
    """As Markdown: sections become lists, an entry for each name."""
    item: list[str] = []
    inside = False
    for line in (inspect.getdoc(value) or "").splitlines():
        section = SECTION.fullmatch(line)
        entry = inside and line.startswith("    ") and not line.startswith("     ")
        if item and (section or entry or not line.strip()):
            yield "- " + " ".join(item)
            item = []
        if section:
            inside = True
            yield from (f"**{section[1]}**", "")
        elif inside and line.startswith("    "):
            item.append(line.strip())
        else:
            inside = inside and not line.strip()
            yield line
    if item:
        yield "- " + " ".join(item)
    yield ""


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
    print(PAGE)

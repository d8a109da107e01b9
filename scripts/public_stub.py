"""hoigs/__init__.pyi: the public names as plain imports, for editors and type checkers.

    python scripts/public_stub.py

`hoigs/__init__.py` resolves its names on first use, and constructors of components take their
settings as keywords, as functions do with their options: no type checker can follow. A test
compares the stub with the code.
"""

from __future__ import annotations

import inspect
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

STUB = Path(__file__).parents[1] / "hoigs" / "__init__.pyi"


def text() -> str:
    """What the stub has to be."""
    import hoigs
    from hoigs.core.interfaces.configurable import Configurable, takes_settings

    imports = {"from typing import Any, Literal", "from torch import Tensor"}
    imports |= {f"from hoigs import {name} as {name}" for name in hoigs._MODULES}
    classes: list[str] = []
    for name, module in hoigs._PUBLIC.items():
        value = getattr(hoigs, name)
        component = isinstance(value, type) and issubclass(value, Configurable)
        if component and takes_settings(value):
            imports.add(f"from {module} import {name} as _{name}")
            classes += ["", *_component(name, value, imports)]
        elif isinstance(value, types.FunctionType) and hasattr(value, "options"):
            classes += ["", *_verb(name, value, imports)]
        else:
            imports.add(f"from {module} import {name} as {name}")
    ordered = sorted(imports, key=lambda line: line.split())
    head = "# written by scripts/public_stub.py"
    return "\n".join([head, "", *ordered, "", "__version__: str", *classes, ""])


def _component(name: str, cls: Any, imports: set[str]) -> list[str]:
    """A class whose constructor has the component's settings."""
    hints: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        if "__init__" in vars(base):
            own = inspect.unwrap(vars(base)["__init__"])
            hints |= _hints(own)
    lines = [f"class {name}(_{name}):", "    def __init__(", "        self,"]
    star = False
    for parameter in inspect.signature(cls).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not star:
            lines.append("        *,")
            star = True
        field = cls.Config.model_fields.get(parameter.name)
        hint = hints.get(parameter.name, field.annotation if field else Any)
        typed = "Any" if parameter.name == "config" else _typed(hint, imports)
        needed = parameter.default is parameter.empty and parameter.name != "config"
        lines.append(f"        {parameter.name}: {typed}{'' if needed else ' = ...'},")
    return [*lines, "    ) -> None: ..."]


def _verb(name: str, function: Any, imports: set[str]) -> list[str]:
    """A function that takes the fields of an options class as keywords."""
    hints = _hints(inspect.unwrap(function))
    fields = function.options.model_fields
    lines, star = [f"def {name}("], False
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not star:
            lines.append("    *,")
            star = True
        field = fields.get(parameter.name)
        typed = _typed(field.annotation if field else hints.get(parameter.name, Any), imports)
        if parameter.name == "options":
            typed += " | None"
        needed = parameter.default is parameter.empty
        lines.append(f"    {parameter.name}: {typed}{'' if needed else ' = ...'},")
    return [*lines, f") -> {_typed(hints.get('return', Any), imports)}: ..."]


def _hints(function: Any) -> dict[str, Any]:
    try:
        return typing.get_type_hints(function)
    except NameError:  # a name imported for type checking only
        return {}


def _typed(hint: Any, imports: set[str]) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in (None, type(None)):
        return "None"
    if origin is Annotated:
        return _typed(arguments[0], imports)
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, arguments))}]"
    if origin in (Union, types.UnionType):
        return " | ".join(dict.fromkeys(_typed(each, imports) for each in arguments))
    if origin is tuple and arguments[1:] == (...,):  # lists are taken too
        imports.add("from collections.abc import Sequence")
        return f"Sequence[{_typed(arguments[0], imports)}]"
    if origin is dict:
        return f"dict[{', '.join(_typed(each, imports) for each in arguments)}]"
    if not isinstance(hint, type) or origin is not None:
        return "Any"
    if hint.__module__.startswith("jaxtyping"):
        return "Tensor"
    if hint.__module__ == "builtins":
        return hint.__name__
    alias = f"_{hint.__name__}"
    imports.add(f"from {hint.__module__.replace('pathlib._local', 'pathlib')} import "
                f"{hint.__name__} as {alias}")  # fmt: skip
    return alias


if __name__ == "__main__":
    STUB.write_text(text(), encoding="utf-8")
    print(STUB)

"""Spec files to plain values with the position of each: a strict, safe subset of YAML, or TOML.

Beyond `yaml.safe_load`: duplicate keys, aliases and tags are refused, scalars follow YAML 1.2's
core schema (`1e-3` is a number; `on`, `12:30` and `2024-01-01` are text), and every key and value
has a position.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from hoigs.core.errors import SpecError
from hoigs.core.system.files import regular_file

Place = tuple[str | int, ...]
LONGEST_INTEGER = 1000  # digits; Python writes no number of more than 4300, as messages have to
MAX_BYTES = 1_000_000  # a spec is a page of text; a file of this size is a mistake


@dataclass
class Document:
    """A tree of dicts, lists and scalars, with the position of every key and value.

    Attributes:
        source: its name in messages.
        data: the tree.
        keys, values: place in the tree to "file:line:column".
    """

    source: str
    data: dict[str, Any] = field(default_factory=dict)
    keys: dict[Place, str] = field(default_factory=dict)
    values: dict[Place, str] = field(default_factory=dict)

    def where(self, place: Place, *, key: bool = False) -> str:
        """Position of the value (or key) at `place`, or of the nearest enclosing block."""
        if key and place in self.keys:
            return self.keys[place]
        while place and place not in self.values:
            place = place[:-1]
        return self.values.get(place, self.source)

    def merged(self, over: Document) -> Document:
        """This document merged with `over`, key by key; values of `over` replace its own.

        A block that names another component (`use`) replaces the whole block below it,
        as settings of one component do not apply to another. Lists are replaced.
        """
        result = Document(over.source, keys=dict(self.keys), values=dict(self.values))
        result.data = _lay_over(self.data, over.data, (), over, result)
        return result

    def part(self, place: Place) -> Document:
        """The block at `place` as a separate document, positions kept."""
        size = len(place)
        keys, values = (
            {p[size:]: at for p, at in positions.items() if p[:size] == place}
            for positions in (self.keys, self.values)
        )
        return Document(self.source, self._block(place), keys, values)

    def only(self, place: Place) -> Document:
        """A document with only the content at `place`, positions kept."""
        size = len(place)
        keys, values = (
            {p: at for p, at in positions.items() if p[:size] == place[: len(p)]}
            for positions in (self.keys, self.values)
        )
        data: Any = self._block(place[:-1])[str(place[-1])]
        for key in reversed(place):
            data = {key: data}
        return Document(self.source, data, keys, values)

    def has(self, place: Place) -> bool:
        """Whether there is a value at `place`."""
        try:
            return place[-1] in self._block(place[:-1])
        except KeyError:
            return False

    def remove(self, place: Place) -> None:
        """Remove the value at `place`, if there is one."""
        if self.has(place):
            del self._block(place[:-1])[str(place[-1])]
            _forget(self, place)

    def _block(self, place: Place) -> dict[str, Any]:
        block: Any = self.data
        for part in place:
            block = block[part] if isinstance(block, dict) else {}
        return block if isinstance(block, dict) else {}


class Loader(yaml.SafeLoader):
    """Composes nodes; `_built` constructs the values, so no tag can run code."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(
                problem="aliases (*name) are not supported; write the value out", problem_mark=mark
            )
        return super().compose_node(parent, index)


class Dumper(yaml.SafeDumper):
    """Writes what `Loader` reads back equal: quotes text that it would take for a number."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_CORE_SCHEMA = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+0123456789."),
    ),
)
_PATTERNS = {tag: re.compile(f"(?:{pattern})\\Z") for tag, pattern, _ in _CORE_SCHEMA}
for _class in (Loader, Dumper):
    _class.yaml_implicit_resolvers = {}
    for _tag, _, _first in _CORE_SCHEMA:
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _PATTERNS[_tag], _first)


def load_yaml(text: str, source: str) -> Document:
    """Parse YAML.

    Raises:
        SpecError: not YAML, not a mapping, or syntax that this loader refuses.
    """
    _check_size(text, source)
    try:
        node = _composed(text)
        if node is None:
            raise SpecError(f"{source}: the file is empty")
        document = Document(source)
        data = _built(node, (), document)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = _at(source, mark) if mark else source
        raise SpecError(f"{at}: {error.problem or error.context}") from error
    except yaml.YAMLError as error:  # unreadable characters
        raise SpecError(f"{source}: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise SpecError(f"{source}: nested too deeply") from error
    if not isinstance(data, dict):
        raise SpecError(f"{document.where(())}: expected `key: value` lines, got {_name(data)}")
    document.data = data
    return document


@lru_cache(maxsize=32)  # a study reads the same presets for every candidate
def _composed(text: str) -> yaml.Node | None:
    return Loader(text).get_single_node()


def _built(node: yaml.Node, place: Place, document: Document) -> Any:
    """The plain value of a YAML node; positions go into the document."""
    at = _at(document.source, node.start_mark)
    document.values[place] = at
    tag = node.tag.removeprefix("tag:yaml.org,2002:")
    if isinstance(node, yaml.MappingNode) and tag == "map":
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            at = _at(document.source, key_node.start_mark)
            if not isinstance(key_node, yaml.ScalarNode):
                raise SpecError(f"{at}: a key must be text")
            here = (*place, key_node.value)
            if key_node.value in result:
                name, first = ".".join(map(str, here)), document.keys[here]
                raise SpecError(f"{at} {name}: this key is given twice; first at {first}")
            document.keys[here] = at
            result[key_node.value] = _built(value_node, here, document)
        return result
    if isinstance(node, yaml.SequenceNode) and tag == "seq":
        return [_built(item, (*place, i), document) for i, item in enumerate(node.value)]
    if isinstance(node, yaml.ScalarNode) and tag in _SCALARS:
        text = node.value
        if (pattern := _PATTERNS.get(tag)) and not pattern.match(text):  # of `!!int a`
            raise SpecError(f"{at}: {text[:40]!r} is no {tag}")
        if tag == "int" and len(text) > LONGEST_INTEGER:
            raise SpecError(f"{at}: a number of {len(text)} digits")
        return _SCALARS[tag](text)
    raise SpecError(f"{at}: the tag {node.tag} is not supported")


def _at(source: str, mark: Any) -> str:
    return f"{source}:{mark.line + 1}:{mark.column + 1}"


def _integer(text: str) -> int:
    return int(text, 0) if text[:2] in ("0x", "0o") else int(text)


def _float(text: str) -> float:
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))


_SCALARS: Mapping[str, Any] = {
    "null": lambda text: None,
    "bool": lambda text: text.lower() == "true",
    "int": _integer,
    "float": _float,
    "str": str,
}


def load_toml(text: str, source: str) -> Document:
    """Parse TOML; positions are those of tables and of keys that begin a line.

    Raises:
        SpecError: not TOML.
    """
    _check_size(text, source)
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise SpecError(f"{source}: nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, or a number of too many digits
        where = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
        at = f"{source}:{where[1]}:{where[2]}" if where else source
        raise SpecError(f"{at}: {str(error).partition(' (at ')[0]}") from error
    document = Document(source, data)
    table: Place = ()
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[\[?\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$", line)
        entry = re.match(r"(\s*)([\w.\"'-]+)\s*=\s*", line)
        if header:
            table = _dotted(header[1])
            document.keys[table] = document.values[table] = f"{source}:{number}:1"
        elif entry:
            place = (*table, *_dotted(entry[2]))
            document.keys[place] = f"{source}:{number}:{entry.end(1) + 1}"
            document.values[place] = f"{source}:{number}:{entry.end() + 1}"
    return document


def load_overrides(settings: list[str]) -> Document:
    """`a.b=value` settings as one document; values are YAML scalars or flow collections.

    Raises:
        SpecError: no `=`, an empty key, or a value that is not YAML.
    """
    result = Document("--set")
    for setting in settings:
        path, equals, text = setting.partition("=")
        place = tuple(path.strip().split("."))
        source = f"--set {setting}:"
        if not equals or not all(place):
            raise SpecError(f"{source} expected KEY.KEY=VALUE, for example train.steps=500")
        value = load_value(text if text.strip() else "null", source)
        node = result.data
        for depth, part in enumerate(place[:-1], 1):
            child = node.setdefault(part, {})
            if not isinstance(child, dict):
                raise SpecError(f"{source} {'.'.join(place[:depth])} has been set to {child!r}")
            node = child
        node[place[-1]] = value
        for depth in range(1, len(place) + 1):
            result.keys[place[:depth]] = result.values[place[:depth]] = source
    return result


def load_value(text: str, source: str) -> Any:
    """The value of a KEY=VALUE setting: a YAML scalar or flow collection.

    Raises:
        SpecError: it is not YAML.
    """
    try:
        return load_yaml(f"value: {text}", "").data["value"]
    except SpecError as error:
        why = str(error).partition(": ")[2] or error
        raise SpecError(f"{source} {text!r} is not a valid YAML value: {why}") from error


def dump_yaml(data: dict[str, Any]) -> str:
    """Canonical YAML of plain values, that `load_yaml` reads back equal."""
    return yaml.dump(data, Dumper=Dumper, sort_keys=False, allow_unicode=True, width=100)


def _lay_over(
    below: dict[str, Any], over: dict[str, Any], place: Place, source: Document, out: Document
) -> dict[str, Any]:
    """The merged tree; the positions of what comes from `over` move from `source` to `out`."""
    replaces = "use" in over and "use" in below and over["use"] != below["use"]
    result = {} if replaces else dict(below)
    if replaces:
        _forget(out, place)
    if place in source.values:
        out.values.setdefault(place, source.values[place])
    for key, value in over.items():
        here = (*place, key)
        if isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = _lay_over(result[key], value, here, source, out)
        else:
            _forget(out, here)
            result[key] = value
            for positions, new in ((out.keys, source.keys), (out.values, source.values)):
                size = len(here)
                positions.update({p: at for p, at in new.items() if p[:size] == here})
    return result


def _forget(document: Document, place: Place) -> None:
    """Drop the positions of everything under `place`, itself included."""
    for positions in (document.keys, document.values):
        for known in [p for p in positions if p[: len(place)] == place]:
            del positions[known]


def _dotted(text: str) -> Place:
    return tuple(part.strip().strip("\"'") for part in text.split("."))


def _check_size(text: str, source: str) -> None:
    if len(text) > MAX_BYTES:
        raise SpecError(f"{source}: {len(text)} characters; a spec has at most {MAX_BYTES}")


def _name(value: Any) -> str:
    return "a list" if isinstance(value, list) else f"the text {str(value)[:40]!r}"


def read_document(path: Path) -> Document:
    """A .yaml, .yml or .toml file.

    Raises:
        SpecError: absent, not text, or as `load_yaml` and `load_toml`.
    """
    try:
        text = regular_file(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise SpecError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise SpecError(f"{path}: is a folder, expected a YAML or TOML file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{path}: cannot be read as UTF-8 text: {error}") from error
    return load_toml(text, str(path)) if path.suffix == ".toml" else load_yaml(text, str(path))

"""The answer as a readable spec: what it extends, and each changed key with a reason."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hoigs.core.names import name_from
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.files import SUFFIXES
from hoigs.core.spec.loader import load_overrides
from hoigs.core.spec.schema import Spec
from hoigs.studies.needs.result import SETTLES, Needs, summary_line

BY_HAND = "given by --set"
SETTLED = "with constant rates a short training ends off its optimum"


def spec_text(needs: Needs, given: Sequence[str], folder: Path) -> str:
    """Text of the spec file of an answer, for `folder`.

    Args:
        given: settings of the user for the base spec; the file has them too.
    """
    base = needs.base
    if base.endswith(SUFFIXES):
        base = os.path.relpath(Path(base).resolve(), folder.resolve())
        base = base if "/" in base else f"./{base}"
    # a clip's name is free text, a spec's is not
    name = f"{needs.spec.name.partition('@')[0]}-needs-{name_from(needs.clip, 'clip')}"
    lines = [
        f"# What the clip {needs.clip} needs of {needs.base}, chosen by `hoigs needs` on "
        f"{len(needs.frames)} training frames held back.",
        f"extends: {json.dumps(base)}",
        f"name: {json.dumps(name)}",
        f"summary: {json.dumps('no more model than ' + needs.clip + ' needs')}",
    ]
    return "\n".join([*lines, *_block(_changes(needs, given), (), _comments(needs, given))]) + "\n"


def _changes(needs: Needs, given: Sequence[str]) -> dict[str, Any]:
    """The given settings, changed by the overrides that the search chose.

    Settings that were given for a component are kept where that component is, as in the search.
    """
    tree = load_overrides(list(given)).data
    start = needs.start.model_dump(mode="json")
    for key, value in needs.overrides.items():
        *path, last = key.split(".")
        node, was = tree, start
        for step in path:
            node, was = node.setdefault(step, {}), was[step]
        own, before = node.get(last), was.get(last)
        if isinstance(own, dict) and isinstance(value, dict) and isinstance(before, dict):
            value = {**own, **value} if value.get("use") == before.get("use") else value
        node[last] = value
    return tree


def checked_spec(path: Path, needs: Needs, registry: Registry | None) -> Spec:
    """The spec that was written, read back.

    Raises:
        SpecError: it is invalid.
        RuntimeError: it is not the spec of the answer.
    """
    spec = Spec.load(path, registry=registry)
    if spec.hash() != needs.spec.hash():
        raise RuntimeError(f"{path} does not read back as the spec that was found")
    return spec


def _comments(needs: Needs, given: Sequence[str]) -> dict[str, str]:
    """The reason of each key, from the last search space that has set it."""
    comments = {SETTLES: SETTLED}
    comments |= {setting.partition("=")[0].strip(): BY_HAND for setting in given}
    for answer in needs.answers:
        for key in (*answer.overrides, *answer.afterwards):
            comments[key] = summary_line(answer)
    return comments


def _block(
    tree: Mapping[str, Any], place: tuple[str, ...], comments: Mapping[str, str]
) -> list[str]:
    """A block of YAML; values below a commented key stand on its line."""
    lines, indent = [], "  " * len(place)
    for key, value in tree.items():
        here = (*place, key)
        dotted = ".".join(here)
        deeper = isinstance(value, dict) and any(c.startswith(f"{dotted}.") for c in comments)
        if dotted in comments:
            lines.append(f"{indent}# {comments[dotted]}")
        if deeper and dotted not in comments:
            lines += [f"{indent}{key}:", *_block(value, here, comments)]
        else:
            lines.append(f"{indent}{key}: {_flow(value)}")
    return lines


def _flow(value: Any) -> str:
    """A value on one line, as specs are written by hand."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(v)}" for key, v in value.items()) + "}"
    return json.dumps(value)

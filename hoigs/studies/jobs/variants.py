"""Variants of specs as `--specs` of `hoigs chart` and `hoigs stress` declares them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hoigs.core.errors import HoigsError
from hoigs.studies.jobs.rows import Row

KEY = re.compile(r"\+(?=[A-Za-z_][\w.-]*=)")


def parse_variants(text: str) -> list[Row]:
    """`--specs`: specs with commas between, each `[LABEL=]SPEC[+KEY=VALUE…]`.

    "hoigs,mine.yaml,hoigs+model.object.deformation.use=deformation:acme-bounce" are three.

    Raises:
        HoigsError: none is named, or two have the same label.
    """
    variants = [_variant(part.strip()) for part in _split(text) if part.strip()]
    if not variants:
        raise HoigsError("--specs names no spec; give some: --specs hoigs,4dgs@matched,mine.yaml")
    labels = [v.label for v in variants]
    for variant in variants:
        if labels.count(variant.label) > 1:
            raise HoigsError(
                f'two specs are called "{variant.label}" in --specs; name them: '
                f"first={definition(variant)}"
            )
    return variants


def definition(row: Row) -> str:
    """A variant as `--specs` has it, without its label."""
    return "+".join([str(row.spec), *row.settings])


def _variant(text: str) -> Row:
    head, *settings = KEY.split(text)
    label, named, spec = head.rpartition("=")
    if not spec.strip() or (named and not label.strip()):
        raise HoigsError(f'--specs: "{text}" is no [LABEL=]SPEC[+KEY=VALUE…]')
    spec = spec.strip()
    return Row(label.strip() or _label(spec, settings), spec, tuple(s.strip() for s in settings))


def _label(spec: str, settings: Sequence[str]) -> str:
    """ "hoigs + acme-bounce" of what swaps a component, "hoigs + cap=500" of another setting."""
    name = Path(spec).stem if spec.partition("@")[0].endswith((".yaml", ".yml", ".toml")) else spec
    words = [name]
    for setting in settings:
        key, _, value = setting.partition("=")
        last = key.rpartition(".")[2]
        words.append(value.strip().rpartition(":")[2] if last == "use" else f"{last}={value}")
    return " + ".join(words)


def _split(text: str) -> list[str]:
    """At commas that no bracket encloses: `a,b+entities=[human,object]` are two."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{(") - (letter in "]})")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts

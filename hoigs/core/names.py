"""Names that are used as names of files and folders: of entities and of specs."""

from __future__ import annotations

import re
import unicodedata

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
RULE = "use letters, digits, _, - and . , a letter or digit first"
ENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def require_entity_name(name: str) -> None:
    """Raise ValueError for a name that no entity can have.

    Names of entities are also keys of specs and of torch's modules: in both a dot separates the
    parts of a path, and a module's own attributes ("type", "train") are taken.
    """
    from torch import nn

    if not ENTITY.fullmatch(name):
        raise ValueError(
            f"entity name {name!r}: names of entities have letters, digits, _ and -, a letter or "
            "digit first, and no dots"
        )
    if hasattr(nn.ModuleDict, name):
        raise ValueError(
            f"entity name {name!r}: torch's modules have an attribute of that name; take another, "
            f"as {name}_1"
        )


def name_from(text: str, otherwise: str) -> str:
    """`text` with "-" for each run of characters that no name has; `otherwise` if none is left."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("_.-") or otherwise


def is_plain(text: str) -> bool:
    """Whether a text has neither control characters nor halves of characters, which files,
    terminals and command lines do not hold."""
    return not any(unicodedata.category(c) in ("Cc", "Cs") for c in text)


def printable(text: str) -> str:
    """`text` for a terminal, without control characters but line breaks: names from files may hold
    escape sequences."""
    shown = (c if c.isprintable() or c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text)
    return "".join(shown)

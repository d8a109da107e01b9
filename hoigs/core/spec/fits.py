"""Components of one block that do not fit each other, by what their classes declare."""

from __future__ import annotations

from collections.abc import Iterator

from hoigs.core.registry.registry import Registry
from hoigs.core.spec.files import BUILTIN_SPECS
from hoigs.core.spec.loader import Document

KINDS = ("scene", "human", "object")  # blocks of other names are of one entity, of any kind


def misfits(
    name: str, moves: str, describes: str | None, document: Document, registry: Registry
) -> Iterator[str]:
    """A deformation of other kinds of entity, and features that require what it does not provide; a
    line each, with its position.

    Args:
        name: of the block. moves, describes: keys of its deformation and of its features.
    """
    from hoigs.core.interfaces.features import check_provided

    deformation = registry.get(moves)
    if name in KINDS and name not in deformation.kinds:
        yield (
            f"{_at(document, name, 'deformation')}: {deformation.__name__} deforms entities of "
            f"kind {' or '.join(sorted(deformation.kinds))}, not {name}"
        )
    elif describes is not None:
        try:
            check_provided(registry.get(describes), deformation)
        except ValueError as error:
            places = [_at(document, name, part) for part in ("deformation", "features")]
            # of the two, the one that a user wrote
            yield f"{min(places, key=lambda at: at.startswith(str(BUILTIN_SPECS)))}: {error}"


def _at(document: Document, name: str, part: str) -> str:
    place = ("model", name, part, "use")
    return f"{document.where(place)} {'.'.join(place)}"

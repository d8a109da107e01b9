"""Components of one block that do not fit each other, by what their classes declare."""

from __future__ import annotations

from collections.abc import Iterator

from hoigs.core.errors import SpecError
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.files import BUILTIN_SPECS
from hoigs.core.spec.schema import Spec

KINDS = ("scene", "human", "object")  # blocks of other names are of one entity, of any kind


def require_fitting(spec: Spec, registry: Registry) -> None:
    """Refuse a deformation of other kinds of entity, and features that require what it lacks.

    `compose` refuses both, too; here no clip is needed. A spec is not checked when it is loaded: a
    search changes one component after the other.

    Raises:
        SpecError: a line for each, with its position.
    """
    if found := [line for name in spec.model for line in _misfits(spec, name, registry)]:
        raise SpecError("\n".join(found))


def _misfits(spec: Spec, name: str, registry: Registry) -> Iterator[str]:
    from hoigs.core.interfaces.features import check_provided

    block = spec.model[name]
    deformation = registry.get(block.deformation.use)
    places = [spec.at("model", name, part, "use") for part in ("deformation", "features")]
    if name in KINDS and name not in deformation.kinds:
        yield (
            f"{places[0]}: {deformation.__name__} deforms entities of kind "
            f"{' or '.join(sorted(deformation.kinds))}, not {name}"
        )
    elif block.features is not None:
        try:
            check_provided(registry.get(block.features.use), deformation)
        except ValueError as error:
            # of the two, the one that a user wrote
            yield f"{min(places, key=lambda at: at.startswith(str(BUILTIN_SPECS)))}: {error}"

"""Where specs come from: names and files, what they extend, and their profiles.

A file is its own `native` profile. Others are partial trees under `profiles`, merged over the
file; `NAME@PROFILE` selects one. A profile that is named as a file in `plugins/specs/profiles`
first takes from another spec what that file lists, so that it means the same for every method.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hoigs
from hoigs.core.errors import SpecError, did_you_mean
from hoigs.core.spec.loader import Document, Place, read_document
from hoigs.core.system.files import name_from

BUILTIN_SPECS = Path(hoigs.__file__).parent / "plugins" / "specs"
SHARED_PROFILES = BUILTIN_SPECS / "profiles"
SUFFIXES = (".yaml", ".yml", ".toml")
NATIVE = "native"
OF_THE_FILE = ("name", "extends", "profiles")  # keys that a profile cannot have


def builtin_specs() -> list[str]:
    """Names of the specs that come with hoigs."""
    return sorted(path.stem for path in BUILTIN_SPECS.glob("*.yaml"))


def builtin_summary(name: str) -> str:
    """The summary line of a built-in spec, which is read but not checked."""
    return str(read_document(BUILTIN_SPECS / f"{name}.yaml").data.get("summary", ""))


def spec_profiles(source: str | Path) -> list[str]:
    """Profiles of a spec, `native` first; those of what it extends are its own too.

    Args:
        source: a built-in spec's name, or a file. With "@PROFILE" it is one profile, and has none.

    Raises:
        SpecError: the file, or one that it extends, cannot be read.
    """
    if split_profile(source)[1] is not None:
        return []
    return _names(_read_file(source, Path(), ()))


def read_spec(source: str | Path) -> Document:
    """The tree of a spec from its files, with one profile applied; components are not yet checked.

    Args:
        source: a built-in spec's name, or a .yaml, .yml or .toml file; "@PROFILE" may follow.

    Raises:
        SpecError: a file is absent or not a spec, or has no such profile.
    """
    _, profile = split_profile(source)
    return _with_profile(_read_file(source, Path(), ()), profile, str(source))


def extended(document: Document) -> Document:
    """The native profile of a text's tree; it may extend built-in specs only.

    Raises:
        SpecError: as `read_spec`.
    """
    return _with_profile(_extended(document, None, ()), None, document.source)


def split_profile(source: str | Path) -> tuple[str, str | None]:
    """ "4dgs@matched" to its name or file and its profile, None where it has none."""
    text = str(source)
    base, at, profile = text.rpartition("@")
    if not at or "/" in profile or text.endswith(SUFFIXES):  # the sign is part of a path
        return text, None
    return base, profile


def _read_file(source: str | Path, folder: Path | None, chain: tuple[Path, ...]) -> Document:
    """The file that `source` means, over what it extends; its profiles still to choose from.

    A relative path starts from `folder`; None allows names only.
    """
    text, _ = split_profile(source)
    named = isinstance(source, str) and "/" not in text and not text.endswith(SUFFIXES)
    if isinstance(source, str) and text in builtin_specs():
        path = BUILTIN_SPECS / f"{text}.yaml"
    elif folder is not None and not text.endswith(SUFFIXES) and (folder / text).is_dir():
        raise SpecError(f"{text}: is a folder, expected a YAML or TOML file")
    elif named:
        raise SpecError(
            f'no spec "{text}"{did_you_mean(text, builtin_specs())} (built in: '
            f"{', '.join(builtin_specs())}; a file ends in {', '.join(SUFFIXES)})"
        )
    elif folder is None:
        raise SpecError(f'"{text}": only the names of built-in specs can be extended here')
    elif not text.endswith(SUFFIXES):
        raise SpecError(f"{text}: a spec file ends in {', '.join(SUFFIXES)}")
    else:
        path = folder / text
    resolved = path.resolve()
    if resolved in chain:
        names = " -> ".join(p.name for p in (*chain, resolved))
        raise SpecError(f"{path}: extends itself: {names}")
    document = read_document(path)
    document.data.setdefault("name", name_from(path.stem, "spec"))
    return _extended(document, path.parent, (*chain, resolved))


def _extended(document: Document, folder: Path | None, chain: tuple[Path, ...]) -> Document:
    """`document` merged over what it extends; profiles are inherited, name and summary are not."""
    base_name = document.data.pop("extends", None)
    if base_name is None:
        return document
    at = document.where(("extends",))
    if not isinstance(base_name, str):
        raise SpecError(f"{at} extends: expected a spec's name or file, got {base_name!r}")
    _names(document)
    try:
        _, profile = split_profile(base_name)
        base = _read_file(base_name, folder, chain)
        if profile is not None:
            base = _with_profile(base, profile, base_name)
        _names(base)
    except SpecError as error:
        raise SpecError(f"{at} extends: {error}") from error
    base.data = {k: v for k, v in base.data.items() if k not in ("name", "summary")}
    return base.merged(document)


def _names(document: Document) -> list[str]:
    """Names of the profiles of a document, `native` first, after checking them."""
    profiles = document.data.get("profiles", {})
    if not isinstance(profiles, dict):
        at = document.where(("profiles",))
        raise SpecError(f"{at} profiles: expected a block of names and trees, got {profiles!r}")
    for name, tree in profiles.items():
        place: Place = ("profiles", name)
        if name == NATIVE or not isinstance(tree, dict):
            at = f"{document.where(place, key=True)} profiles.{name}"
            if name == NATIVE:
                raise SpecError(
                    f"{at}: the file itself is its {NATIVE} profile; give this one another name"
                )
            raise SpecError(f"{at}: expected a block of keys ({{}} for none), got {tree!r}")
        for key in OF_THE_FILE:
            if key in tree:
                where = document.where((*place, key), key=True)
                raise SpecError(f"{where} profiles.{name}.{key}: a profile cannot have this key")
    return [NATIVE, *profiles]


def _with_profile(document: Document, profile: str | None, source: str) -> Document:
    """`document` with one profile laid over it, and without the others."""
    names = _names(document)
    over = document.part(("profiles", profile)) if profile in names[1:] else None
    if profile is not None and profile not in names:
        at = document.where(("profiles",), key=True)
        raise SpecError(
            f'{at}: "{source}": no profile "{profile}"{did_you_mean(profile, names)} '
            f"(has: {', '.join(names)})"
        )
    document.data.pop("profiles", None)
    if profile is not None:
        document.data["name"] = f"{document.data.get('name', '')}@{profile}"
    if over is None:
        return document
    shared = SHARED_PROFILES / f"{profile}.yaml"
    if shared.exists():
        document = _like_another(document, read_document(shared))
    return document.merged(over)


def _like_another(document: Document, shared: Document) -> Document:
    """`document` with the places that a shared profile lists copied from the spec that it names.

    A place that is absent from that spec is removed here too, so that its default applies, as are
    those that the profile lists under `default`; places that the profile keeps are not copied.
    """
    model = read_spec(shared.data["like"])
    own = [document.only(p) for d in shared.data["keep"] if document.has(p := tuple(d.split(".")))]
    for dotted in shared.data["take"]:
        place = tuple(dotted.split("."))
        document.remove(place)
        taken: Any = model.data
        for part in place[:-1]:
            taken = taken.get(part, {})
        if place[-1] in taken:
            document = document.merged(model.only(place))
    for dotted in shared.data["default"]:
        document.remove(tuple(dotted.split(".")))
    for kept in own:
        document = document.merged(kept)
    return document

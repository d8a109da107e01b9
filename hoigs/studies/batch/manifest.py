"""Manifest of a batch: rows of YAML or CSV, checked, with file, line and key in every message."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, TextIO

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.spec.loader import MAX_BYTES, load_yaml
from hoigs.core.system.files import is_plain, regular_file, short
from hoigs.core.system.urls import as_url
from hoigs.runs.choices import parse_settings
from hoigs.training.options import TrainOptions

NAMES = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")  # rows, whose names become folders
FORMATS = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:@-]{0,79}")  # formats, with kind: and @distribution
ONE_SOURCE = "a row has either a video or a clip"
# options of a training that a row has under another name, or that the batch sets; plugin files run
# code, and the batch's folder may be writable for others
OF_THE_BATCH = ("spec", "out", "device", "overrides", "evaluate", "resume", "overwrite", "plugins")
LISTS = ("set", "train", "prepare", "object", "export")  # in CSV, texts with ";" between


class ManifestError(HoigsError):
    """A manifest that cannot be used; the message starts with file, line and key."""


class Row(BaseModel):
    """One video or clip of a batch. Relative paths are from the manifest's folder.

    Checked when it is read from a manifest and when it is read back from the batch's own folder,
    which other users may write to: names become folders, some of which are removed, and all texts
    become words of command lines.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: str = Field(description="folder of the row; default: the file's name")
    video: str = Field(default="", description="a video or a folder, for `hoigs prepare`; or a URL")
    clip: str = Field(
        default="", description="a clip folder, its URL, or builtin:NAME, in place of a video"
    )
    spec: str = Field(default="hoigs", description="spec to train")
    auto: bool = Field(default=False, description="reduce the spec to what the clip needs")
    set: tuple[str, ...] = Field(default=(), description="keys of the spec: train.steps=500")
    train: tuple[str, ...] = Field(
        default=(), description="further options of the training, by their Python names: chunk=16"
    )
    prepare: tuple[str, ...] = Field(
        default=(), description="options of the preparation: width=640"
    )
    object: tuple[str, ...] = Field(
        default=(), description="the object, as `hoigs prepare --object`"
    )
    export: tuple[str, ...] = Field(default=("ply",), description="formats to export")
    publish: str = Field(
        default="", description="URL of a folder, where run and exports are written under the name"
    )
    device: str = Field(default="auto", description="cpu, cuda or auto")
    gpus: float | None = Field(
        default=None, ge=0, le=1, description="share of a GPU; default by --jobs and the GPUs"
    )
    memory_gb: float = Field(default=0.0, ge=0, description="memory to set aside while it runs, GB")

    @field_validator("*")
    @classmethod
    def _has_no_control_characters(cls, value: Any) -> Any:
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str) and not is_plain(text):
                raise ValueError("a text without control characters is expected")
        return value

    @field_validator("name")
    @classmethod
    def _names_a_folder(cls, value: str) -> str:
        if not NAMES.fullmatch(value):
            raise ValueError(
                "a row's name has 1 to 80 letters, digits, _, - and . , a letter, digit or _ first"
            )
        return value

    @field_validator("video", "clip", "spec")
    @classmethod
    def _is_no_option(cls, value: str) -> str:
        if value.startswith("-"):
            raise ValueError("it begins with -, as an option does; write ./ before it")
        return value

    @field_validator("export")
    @classmethod
    def _names_formats(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if not FORMATS.fullmatch(name):
                raise ValueError(
                    f"{short(name)} is no name of a format, such as ply; `hoigs plugins` lists them"
                )
        return value

    @field_validator("train")
    @classmethod
    def _trains(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        try:
            given = parse_settings(value, "train")
            for name in given:
                if name in OF_THE_BATCH:
                    raise ValueError(f"{name} cannot be set here, as the batch or a key sets it")
            TrainOptions.of(None, given, "train")
        except HoigsError as error:
            raise ValueError(str(error)) from error
        return value

    def training(self, run: Path) -> TrainOptions:
        """The options of the training of this row into a run folder."""
        given = parse_settings(self.train, "train")
        own = {"spec": self.spec, "out": run, "device": self.device, "overrides": self.set}
        return TrainOptions.of(None, {**given, **own, "evaluate": False})

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        if bool(self.video) == bool(self.clip):
            raise ValueError(ONE_SOURCE)
        return self

    @field_validator("publish")
    @classmethod
    def _is_a_url(cls, value: str) -> str:
        if value and as_url(value) is None:
            raise ValueError("expected a URL, such as s3://bucket/results")
        return value

    @field_validator(*LISTS, mode="before")
    @classmethod
    def _one_is_a_list(cls, value: Any) -> Any:
        if isinstance(value, str):
            return tuple(part.strip() for part in value.split(";") if part.strip())
        if isinstance(value, Mapping):
            return tuple(
                f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in value.items()
            )
        return value


def each_row(path: Path, defaults: Mapping[str, Any] | None = None) -> Iterator[Row]:
    """The rows of a YAML file (`rows:`, and `defaults:` for all of them) or of a CSV file.

    CSV is read line by line, YAML as a whole.

    Args:
        defaults: keys for rows that have none. Lists are not joined: a row's own replaces them.

    Raises:
        ManifestError: the file cannot be read, or a row cannot be used.
    """
    names: set[int] = set()  # of hashes, which take less memory
    for row, place in _rows_and_places(path, defaults):
        key = hash(row.name.lower())  # some disks do not tell upper from lower case
        if key in names and (first := _place_of(path, defaults, row.name, place)):
            raise ManifestError(
                f'{place}: name: "{row.name}" is also the row at {first}; give this one another '
                "name"
            )
        names.add(key)
        yield row
    if not names:
        raise ManifestError(f"{path}: has no rows; each needs a video or a clip")


def _place_of(path: Path, defaults: Mapping[str, Any] | None, name: str, before: str) -> str:
    """Where the first row of this name is; "" if that is `before`: another name's hash is equal."""
    for row, place in _rows_and_places(path, defaults):
        if row.name.lower() == name.lower():
            return "" if place == before else place
    return ""


def _rows_and_places(path: Path, defaults: Mapping[str, Any] | None) -> Iterator[tuple[Row, str]]:
    """Each row, and where its name is, or the row if it has none."""
    read = {".csv": _csv, ".yaml": _yaml, ".yml": _yaml}.get(path.suffix.lower())
    if read is None:
        raise ManifestError(f"{path}: expected a file that ends with .yaml, .yml or .csv")
    try:
        with regular_file(path).open(encoding="utf-8-sig", newline="") as file:
            for values, at in read(file, path):
                row = _row({**(defaults or {}), **values}, at, path.parent)
                yield row, at.get("name", at.get("", str(path)))
    except (OSError, UnicodeDecodeError) as error:
        raise ManifestError(f"{path}: cannot be read ({error}); name a YAML or CSV file") from error


Read = Iterable[tuple[dict[str, Any], dict[str, str]]]  # values, and where each key is; "": the row


def _yaml(file: TextIO, path: Path) -> Read:
    document = load_yaml(file.read(MAX_BYTES + 1), str(path))
    places = {k: document.where((k,), key=True) for k in document.data}
    _known(document.data, ("rows", "defaults"), places)
    shared, rows = document.data.get("defaults") or {}, document.data.get("rows")
    if not isinstance(shared, dict):
        raise ManifestError(
            f"{document.where(('defaults',))}: defaults: expected `key: value` lines"
        )
    if not isinstance(rows, list):
        raise ManifestError(
            f"{document.where(('rows',))}: rows: expected a list, `- video: a.mp4` …"
        )
    for i, row in enumerate(rows):
        at = {"": document.where(("rows", i))}
        if not isinstance(row, dict):
            raise ManifestError(f"{at['']}: expected `key: value` lines, such as `video: a.mp4`")
        at |= {k: document.where(("defaults", k), key=True) for k in shared}
        at |= {k: document.where(("rows", i, k), key=True) for k in row}
        yield shared | row, at


def _csv(file: TextIO, path: Path) -> Read:
    reader = csv.DictReader(file, skipinitialspace=True)
    try:
        for values in reader:
            at = f"{path}:{reader.line_num}"
            if None in values:
                raise ManifestError(f"{at}: has more cells than the first line has columns")
            given = {k: v.strip() for k, v in values.items() if v is not None and v.strip()}
            yield given, dict.fromkeys(("", *given), at)
    except csv.Error as error:
        raise ManifestError(f"{path}:{reader.line_num + 1}: is not CSV: {error}") from error


def _known(data: Mapping[str, Any], names: Sequence[str], at: Mapping[str, str]) -> None:
    for key in data:
        if key not in names:
            hint = did_you_mean(str(key), names)
            raise ManifestError(
                f"{at.get(key, '')}: {key}: there is no such key{hint}; "
                f"there are {', '.join(names)}"
            )


def _row(values: Mapping[str, Any], at: Mapping[str, str], folder: Path) -> Row:
    _known(values, tuple(Row.model_fields), at)
    place = at.get("", "")
    if bool(values.get("video")) == bool(values.get("clip")):
        raise ManifestError(f"{place}: {ONE_SOURCE}")
    key = "video" if values.get("video") else "clip"
    given = {**values, "name": values.get("name") or _name_of(str(values[key]))}
    row = _checked(given, at)  # before its texts are looked up as paths
    source, spec = getattr(row, key), row.spec
    if not source.startswith("builtin:") and as_url(source) is None:
        path = (folder / source).absolute()
        if not _there(path):
            near = _names_in(path.parent)
            raise ManifestError(
                f"{at.get(key, place)}: {key}: {path} does not exist{did_you_mean(path.name, near)}"
            )
        source = str(path)
    if _there(file := folder / spec.partition("@")[0]) and not file.is_dir():
        spec = str((folder / spec).absolute())
    return _checked({**given, key: source, "spec": spec}, at)


def _checked(values: Mapping[str, Any], at: Mapping[str, str]) -> Row:
    try:
        return Row.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        wrong = str(first["loc"][0]) if first["loc"] else ""
        why = f"{first['msg'].removeprefix('Value error, ')}, got {short(first['input'])}"
        raise ManifestError(f"{at.get(wrong, at.get('', ''))}: {wrong}: {why}") from error


def _there(path: Path) -> bool:
    """Whether a path exists; one that the system refuses, as for its length, does not."""
    try:
        return path.exists()
    except OSError:
        return False


def _names_in(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir()] if _there(folder) and folder.is_dir() else []


def _name_of(source: str) -> str:
    builtin = source.startswith("builtin:")
    name = source.split(":")[1].partition("?")[0] if builtin else Path(source).stem
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name).lstrip(".-")[:80]

"""The clip folder on disk: its files, arrays and header, in one place.

Writer, checker, reader and docs/reference/clip.md all follow these constants.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from hoigs.core.system.files import NAME, is_plain, parse_json, require_entity_name, short
from hoigs.core.system.safe_replace import Layout, one_of
from hoigs.core.values.world import How

FORMAT = "hoigs-clip"
# body models that a key of an older version stands for: until version 2 the joints of the built-in
# body were those of its rig
KEYS_BEFORE = {1: {"body:anny": "body:anny-rig"}}
HEADER, VIEWS = "clip.json", "held_out/views.json"
MOST_LINES = 20  # about one header
IMAGE_SUFFIXES = (".png", ".jpg")
DepthKind = Literal["metric", "affine-disparity", "none"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class EntityHeader(_Strict):
    """One entry of `entities`."""

    kind: Literal["human", "object"] = Field(
        description='"human" or "object"; the scene is implied'
    )
    body: str | None = Field(
        default=None, description='a human\'s body model, for example "body:anny"'
    )

    @model_validator(mode="after")
    def _humans_have_bodies(self) -> EntityHeader:
        if self.kind == "human" and not self.body:
            raise ValueError('a human names its body model, for example "body": "body:anny"')
        if self.kind == "object" and self.body:
            raise ValueError("an object has no body")
        return self


class SplitHeader(_Strict):
    """Frame numbers by use."""

    train: list[int]
    test: list[int]


Count = Annotated[int, Field(ge=1, le=10**9)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=False)]


class WorldHeader(_Strict):
    """`world`, as `hoigs.core.values.world.World`."""

    up: list[Finite] = Field(min_length=3, max_length=3)
    floor: Finite | None = None
    metres: bool = True
    known: How = "given"
    within: Finite | None = None

    @field_validator("up")
    @classmethod
    def _up_has_a_direction(cls, up: list[float]) -> list[float]:
        if not any(up):
            raise ValueError("all zero; expected a direction")
        return up


class ClipHeader(_Strict):
    """clip.json."""

    format: Literal["hoigs-clip"] = Field(default="hoigs-clip", description='always "hoigs-clip"')
    version: Literal[1, 2] = Field(
        default=2,
        description='version of this layout: 2; in version 1 "body:anny" is "body:anny-rig"',
    )
    name: str = Field(min_length=1, description="for reports")
    fps: float = Field(
        gt=0, le=1e6, allow_inf_nan=False, strict=False, description="frames per second"
    )
    width: Count = Field(description="width of every image, mask and depth map, pixels")
    height: Count = Field(description="their height, pixels")
    frames: Count = Field(description="F, the number of frames, held-out views not counted")
    entities: dict[str, EntityHeader] = Field(
        description='name to `{"kind": "human", "body": "body:anny"}` or `{"kind": "object"}`; '
        "names are letters, digits, `_`, `-` and `.`"
    )
    split: SplitHeader = Field(
        description='`{"train": [...], "test": [...]}`, frame numbers, disjoint'
    )
    depth_kind: DepthKind = Field(
        default="none",
        description='"metric" (metres), "affine-disparity" (up to scale and shift) or "none"',
    )
    times: list[float] | None = Field(
        default=None,
        description="if frames are not evenly spaced: seconds of each since the first; `fps` "
        "is then their mean rate",
    )
    world: WorldHeader | None = Field(
        default=None,
        description='`{"up": [0, 1, 0], "floor": 0, "metres": true, "known": "given", "within": '
        "null}`: up in the world's axes, height of the floor along it or null, whether lengths are "
        'metres, and who knows: "given", "floor" (feet at rest), "lines" (vertical lines of the '
        'room), "body" (people who stand), "cameras (guess)"; `within`: degrees within which up '
        "is, in nine of ten cases, null where not known. "
        "Folders without it are read: up then comes from the bodies, else from the cameras",
    )
    provenance: dict[str, Any] = Field(
        default_factory=dict, description="free: where each part came from"
    )

    @model_validator(mode="after")
    def _names_are_safe(self) -> ClipHeader:
        for name in self.entities:
            require_entity_name(name)
            if name == "scene":
                raise ValueError('entity name "scene": it is the implied background')
        return self

    @field_validator("name")
    @classmethod
    def _name_is_plain(cls, name: str) -> str:
        if not is_plain(name):
            raise ValueError(f"{name!r} holds control characters; give the clip another name")
        return name

    @field_validator("provenance")
    @classmethod
    def _truth_is_inside(cls, provenance: dict[str, Any]) -> dict[str, Any]:
        truth = provenance.get("truth")
        if truth is not None and not (isinstance(truth, str) and NAME.fullmatch(truth)):
            raise ValueError(
                f"truth: {short(truth)} is not the name of a file in the clip's own folder"
            )
        return provenance


class ViewsHeader(_Strict):
    """held_out/views.json."""

    format: Literal["hoigs-views"] = Field(default="hoigs-views", description='"hoigs-views"')
    version: Literal[1] = Field(default=1, description="1")
    width: Count = Field(description="width of the held-out images, pixels")
    height: Count = Field(description="their height, pixels")
    frames: list[int] = Field(
        min_length=1, description="V frame numbers of the main clip: view v shows frame frames[v]"
    )


@dataclass(frozen=True)
class ArraySpec:
    """One array of an npz. Dimensions are numbers or letters; a letter has one value in a clip.

    kind: "float", "bool" or "str" (0-d unicode).
    """

    name: str
    shape: tuple[int | str, ...]
    kind: Literal["float", "bool", "str"]
    meaning: str
    optional: bool = False


@dataclass(frozen=True)
class FileSpec:
    """One kind of file: its path pattern, what it holds and who makes it when it is absent."""

    pattern: str
    meaning: str
    maker: str
    arrays: tuple[ArraySpec, ...] = ()
    when: str = "always"


_K = ArraySpec("K", ("F", 3, 3), "float", "intrinsics, pixels; top-left pixel centre at (0.5, 0.5)")
_W2C = ArraySpec(
    "world_to_camera", ("F", 4, 4), "float", "rigid, OpenCV axes: x_cam = R x + t, metres"
)
_PROVENANCE = ArraySpec("provenance", (), "str", "who made it, for reports", optional=True)
_IMAGES_FROM = "images come from `hoigs prepare VIDEO --out FOLDER`, or copy your own frames there"
_MASKS_FROM = (
    "masks come from `hoigs prepare` or your segmenter: 0/255, one file for each frame, "
    "all 0 where the entity is not seen"
)
_DEPTH_FROM = (
    'depth comes from `hoigs prepare` or your depth network; or set "depth_kind" to "none"'
)
CAMERAS = FileSpec(
    "cameras.npz",
    "one pinhole camera for each frame, distortion already removed from the images",
    "cameras come from `hoigs prepare`, or from COLMAP through it",
    (_K, _W2C),
)
IMAGE = FileSpec("images/{frame}.png", "RGB, 8 bit; `.jpg` is read too", _IMAGES_FROM)
MASK = FileSpec("masks/{entity}/{frame}.png", "visible pixels, grey 8 bit, 0 or 255", _MASKS_FROM)
DEPTH = FileSpec(
    "depth/{frame}.npz",
    "depth along z, one array",
    _DEPTH_FROM,
    (ArraySpec("depth", ("H", "W"), "float", "metres, 0 = unknown, never NaN or infinite"),),
    'depth_kind is not "none"',
)
IGNORED = FileSpec(
    "ignored/{frame}.png",
    "pixels that show no scene (painted over, outside the lens image), grey 8 bit, 255 = ignored: "
    "left out of training and of every score",
    "optional: frames without a file have no such pixels",
    when="some pixels show no scene",
)
BODY = FileSpec(
    "bodies/{entity}.npz",
    "SMPL-X convention, axis-angle in radians, world coordinates",
    "body poses come from `hoigs prepare` (landmarks) or your body estimator",
    (
        ArraySpec("global_orient", ("F", 3), "float", "rotation about the pelvis joint"),
        ArraySpec("body", ("F", 21, 3), "float", "joints 1..21"),
        ArraySpec("left_hand", ("F", 15, 3), "float", "left-hand joints"),
        ArraySpec("right_hand", ("F", 15, 3), "float", "right-hand joints"),
        ArraySpec("transl", ("F", 3), "float", "added last, metres; pelvis = J_0(betas) + transl"),
        ArraySpec("betas", ("B",), "float", "shape, shared by all frames"),
        ArraySpec("hand_pose_convention", (), "str", '"flat" or "mean": what zero means'),
        ArraySpec("model", (), "str", 'body model, as in clip.json: "body:anny"'),
        ArraySpec(
            "gender", (), "str", 'of the model file: "male", "female", "neutral"', optional=True
        ),
        ArraySpec(
            "template",
            ("V", 3),
            "float",
            "the person's own zero-pose vertices in place of the model's mean, metres",
            optional=True,
        ),
        _PROVENANCE,
    ),
    "a human",
)
OBJECT = FileSpec(
    "objects/{entity}.npz",
    "what is known of the object before training",
    "object tracks come from `hoigs prepare` or your object-pose estimator",
    (
        ArraySpec("points", ("P", 3), "float", "canonical, from the object's centre, metres"),
        ArraySpec("colors", ("P", 3), "float", "RGB in [0, 1]"),
        ArraySpec("rotations", ("F", 3, 3), "float", "object to world"),
        ArraySpec("translations", ("F", 3), "float", "object centre in the world, metres"),
        ArraySpec("observed", ("F",), "bool", "seen in that frame; the others are interpolated"),
        ArraySpec(
            "moving",
            ("P",),
            "bool",
            "of an object in two parts: points of the moving one",
            optional=True,
        ),
        ArraySpec(
            "rotation_known",
            (),
            "bool",
            "false: rotations are constant, or only the roll in the image; default true",
            optional=True,
        ),
        _PROVENANCE,
    ),
    "an object",
)
POINTS = FileSpec(
    "points.npz",
    "scene points: COLMAP's, or back-projected depth",
    "scene points come from `hoigs prepare`, COLMAP, or back-projected depth",
    (
        ArraySpec("points", ("P", 3), "float", "world, metres"),
        ArraySpec("colors", ("P", 3), "float", "RGB in [0, 1]"),
    ),
)
FILES = (CAMERAS, IMAGE, MASK, IGNORED, DEPTH, BODY, OBJECT, POINTS)
_VIEW = rf"(images/\d+\.(png|jpg)|masks/{NAME.pattern}/\d+\.png|ignored/\d+\.png|depth/\d+\.npz)"
# the files above, and what prepare and built-in clips add; colmap/ is a copy of any COLMAP model
CLIP = Layout(
    what="clip",
    maker="`hoigs prepare` or a ClipWriter",
    required=(HEADER, "cameras.npz", "points.npz", "images"),
    files=one_of(
        r"clip\.json|cameras\.npz|points\.npz",
        rf"(held_out/)?{_VIEW}|held_out/(views\.json|cameras\.npz)",
        rf"(bodies|objects)/{NAME.pattern}\.npz",
        r"report\.(json|md|html)|overlay\.mp4|object\.jpg|truth\.npz",
        r"colmap/.+",
    ),
    folders=one_of(
        rf"(held_out/)?(images|masks(/{NAME.pattern})?|ignored|depth)",
        r"held_out|bodies|objects|colmap(/.+)?",
    ),
)


def stem(frame: int) -> str:
    """00000, 00001, …"""
    return f"{frame:05d}"


def image_path(folder: Path, frame: int) -> Path:
    """The image of a frame, whichever suffix it has; `.png` when there is none."""
    for suffix in IMAGE_SUFFIXES:
        path = folder / "images" / (stem(frame) + suffix)
        if path.exists():
            return path
    return folder / "images" / (stem(frame) + IMAGE_SUFFIXES[0])


def mask_path(folder: Path, entity: str, frame: int) -> Path:
    return folder / "masks" / entity / f"{stem(frame)}.png"


def ignored_path(folder: Path, frame: int) -> Path:
    return folder / "ignored" / f"{stem(frame)}.png"


def depth_path(folder: Path, frame: int) -> Path:
    return folder / "depth" / f"{stem(frame)}.npz"


def is_clip_folder(folder: Path) -> bool:
    """Whether clip.json there is that of a clip, complete or not."""
    try:
        content = parse_json(folder / HEADER)
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("format") == FORMAT


def body_key(model: str, version: int) -> str:
    """Registry key of a body model that is called `model` in a file of a version."""
    return KEYS_BEFORE.get(version, {}).get(model, model)


Header = TypeVar("Header", ClipHeader, ViewsHeader)


def parse_header(path: Path, model: type[Header]) -> tuple[Header | None, list[str]]:
    """A header and no messages, or None and what is wrong with it, key by key."""
    try:
        content = parse_json(path)
    except (OSError, ValueError) as error:
        return None, [f"not readable as JSON ({error})"]
    if not isinstance(content, dict):
        return None, [f"expected a JSON object, got {type(content).__name__}"]
    expected = model.model_fields["format"].default
    if content.get("format") != expected:
        return None, [f'"format" is {short(content.get("format"))}, expected "{expected}"']
    known = get_args(model.model_fields["version"].annotation)
    if content.get("version") not in known:
        return None, [
            f"version {short(content.get('version'))}; this hoigs reads version "
            f"{' and '.join(map(str, known))}: "
            "write the clip again with it, or install the hoigs that wrote it"
        ]
    try:
        return model.model_validate(content), []
    except ValidationError as error:
        found = error.errors()
        lines: list[str] = [
            f"{'.'.join(map(str, e['loc'])) or 'header'}: {e['msg'][:500]}"
            + (f" (got {short(e['input'])})" if e["type"] not in ("missing", "value_error") else "")
            for e in found[:MOST_LINES]
        ]
        left = len(found) - len(lines)
        return None, [*lines, f"and {left} more"] if left else lines

"""Settings of `prepare`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import PluginError, SpecError
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.interfaces.estimator import EstimateKind, Estimator
from hoigs.core.maths.frame_times import Chunking
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document, load_overrides, read_document
from hoigs.core.spec.schema import ComponentSpec
from hoigs.preparation.body.fit_problem import FitOptions
from hoigs.preparation.objects.make_object import ObjectWay
from hoigs.preparation.video.container import Span
from hoigs.preparation.video.frames import Pick

Place = EstimateKind | Literal["object"]  # "object": masks of the object alone
Preset = Literal["auto", "offline", "hub", "files"]


class PromptAt(ComponentConfig):
    """Where an entity is in one frame."""

    points: list[tuple[float, float, bool]] = Field(
        default_factory=list, description="x, y in pixels of the video, and whether it is inside"
    )
    box: tuple[float, float, float, float] | None = Field(
        default=None, description="x0, y0, x1, y1, pixels of the video"
    )
    frame: int | None = Field(
        default=None,
        ge=0,
        description="frame of the video that points and box refer to, counted from 0 at its first "
        "one; None: the first that is used",
    )


class Prompt(PromptAt):
    """Where, or what, an entity is, for segmenters that need it."""

    text: str | None = Field(default=None, description='what to look for: "a man", "football"')
    further: list[PromptAt] = Field(default_factory=list, description="the same in other frames")

    def places(self) -> list[PromptAt]:
        """All frames in which it is shown."""
        first = [self] if self.points or self.box else []
        return [*first, *self.further]


class PrepareOptions(ComponentConfig):
    """Settings of `prepare`; the defaults suit a phone's video of one person and one object."""

    width: int | None = Field(
        default=None,
        ge=16,
        description="width of the stored frames, pixels; None keeps the video's, but makes frames "
        "whose longer side is over 1920 pixels smaller, to 1280",
    )
    every: int = Field(default=1, ge=1, description="take every n-th frame")
    fps: float | None = Field(
        default=None, gt=0, description="frames a second to take, in place of `every`"
    )
    pick: Pick = Field(
        default="sharpest",
        description='which frame of each n to take: the "first", or the "sharpest" if it is '
        "clearly sharper than the first",
    )
    folder_fps: float = Field(
        default=30.0, gt=0, description="frames a second of a folder of frames"
    )
    start: str | float | None = Field(
        default=None,
        description="where in the video to start: 2.5 (seconds), 1:02.5, or 75f (frame 75)",
    )
    end: str | float | None = Field(
        default=None, description="where to end, likewise; the frame there is not used"
    )
    max_frames: int | None = Field(
        default=None, ge=1, description="stop after so many chosen frames"
    )
    image_format: Literal["jpg", "png"] = Field(
        default="jpg", description="format of stored frames"
    )
    quality: int = Field(default=95, ge=1, le=100, description="quality of jpg frames")
    camera: Literal["auto", "static", "turning", "moving", "sfm"] = Field(
        default="auto",
        description='"static": it never moves; "turning": it turns on its spot, as on a tripod; '
        '"moving": the COLMAP model beside the video, or '
        'structure from motion without one; "sfm": structure from motion in any case; "auto": the '
        "COLMAP model, or else whether the background moves decides",
    )
    focal: float | None = Field(
        default=None,
        gt=0,
        description="focal length in pixels of the *video's* own size, for a camera that "
        "stays in one place; None: "
        "what the file's metadata give, or the landmarks if they determine it, or else 0.8 x the "
        "longer side (64 degrees); it scales all depths",
    )
    intrinsics: tuple[float, ...] | None = Field(
        default=None,
        description="fx, fy, cx, cy and perhaps k1, k2, p1, p2 of the lens, in pixels of the "
        "video's own size, as OpenCV has them; frames are undistorted, and the lens is not refined",
    )
    calibration: str | None = Field(
        default=None,
        description="file with the lens: COLMAP's cameras, OpenCV's FileStorage, Qualisys, or a "
        "TOML of Pose2Sim; FILE#NAME where it holds several",
    )
    body: str = Field(default="body:anny", description="key of the body model, for the clip")
    person_height: float | None = Field(
        default=None,
        description="of the person standing, metres; None: the body model's mean. A camera that "
        "stays in one place shows no size, and structure from motion none either: the unit of the "
        "world comes from it",
    )
    fit_steps: int = Field(
        default=FitOptions.steps, ge=1, description="steps of the body fit, at most"
    )
    chunk: int | None = Field(
        default=None,
        ge=1,
        description="frames of a window, for long videos: the body is fitted window by window, "
        "with one shape for all; None: all frames at once",
    )
    overlap: int | None = Field(
        default=None,
        ge=1,
        description="frames that neighbouring windows share; None: a quarter of them, at most 50",
    )
    preset: Preset = Field(
        default="auto",
        description='what finds that which no file beside the video gives: "offline": MediaPipe '
        'and a tracker of hoigs; "hub": networks of the Hugging Face hub; "files": nothing, the '
        'files must be there; "auto": offline',
    )
    estimators: dict[Place, ComponentSpec] = Field(
        default_factory=dict,
        description="where masks, landmarks and depth come from, each an estimator with its "
        'settings, before files and preset; "object": masks of the object, where "masks" gives the '
        "person's alone",
    )
    bodies: str | None = Field(
        default=None,
        description="file of bodies of GVHMR, WHAM, TRAM, PHALP or PromptHMR, relative to the "
        "video's folder; None: the one that lies beside it, if any",
    )
    find_object: bool = Field(
        default=True, description="look for an object; False: the clip has the person alone"
    )
    find_person: bool = Field(
        default=True, description="look for people; False: the clip has objects alone"
    )
    prompts: dict[str, Prompt] = Field(
        default_factory=dict, description="by entity, where or what it is"
    )
    human: str = Field(default="human", description="name of the person's entity")
    everybody: bool = Field(
        default=False,
        description="fit all people who are seen by a quick look, where no prompt says who",
    )
    further_people: tuple[str, ...] = Field(
        default=(),
        description="names of more people, each with a prompt; the estimators of landmarks and "
        "masks give those of all",
    )
    object: str = Field(default="object", description="name of the object's entity")
    further_objects: tuple[str, ...] = Field(
        default=(),
        description="names of more objects, each with a prompt; estimators.object follows them all",
    )
    object_track: ObjectWay = Field(
        default="auto",
        description='how the object\'s poses are found: "ball": as those of a sphere, whose '
        'rotation stays unknown; "texture": from hands, outlines and texture; "outline": its place '
        'and roll only; "auto": as a ball where its masks are round in all frames, or else by '
        "texture, and by outline where that cannot be",
    )
    object_size: float | None = Field(
        default=None,
        gt=0,
        description="of the object across, metres, in a clip without people, where it sets the "
        "unit of the world; None: 0.3. With people their height does",
    )
    ball_radius: float | None = Field(
        default=None,
        gt=0,
        description="radius of a ball, metres; None: 0.11, a football's, for one in "
        "ball_track.npz, and what the limbs that touch it give for one known by its round masks",
    )
    object_points: int = Field(
        default=4000, ge=8, description="number of the object's first points"
    )
    scene_points: int = Field(
        default=25_000, ge=100, description="number of the background's first points, about"
    )
    backdrop: float = Field(
        default=3.0,
        gt=1,
        description="distance of a static background, in distances of the person",
    )
    keep_black: bool = Field(
        default=False,
        description="train on flat black patches too, which are ignored by default",
    )
    overwrite: bool = Field(default=False, description="replace an older clip at the target")
    overlay_width: int = Field(
        default=640, ge=0, description="width of overlay.mp4, pixels; 0 writes none"
    )

    @property
    def own_cameras(self) -> bool:
        """Whether cameras are found anew, whatever lies beside the video."""
        return self.camera in ("static", "turning", "sfm")

    @property
    def chunking(self) -> Chunking | None:
        """How the clip is cut into windows; None: it is not."""
        return None if self.chunk is None else Chunking.of(self.chunk, self.overlap)

    @property
    def people(self) -> tuple[str, ...]:
        """Names of all people, the first one's first."""
        return (self.human, *self.further_people) if self.find_person else ()

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of all objects, the first one's first."""
        return (self.object, *self.further_objects)

    @field_validator("intrinsics", mode="before")
    @classmethod
    def _numbers(cls, value: Any) -> Any:
        return value.split(",") if isinstance(value, str) else value

    @field_validator("intrinsics")
    @classmethod
    def _all_there(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and len(value) not in (4, 8):
            raise ValueError(
                f"{len(value)} numbers; expected fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2 (for more "
                "coefficients write a file for --calibration)"
            )
        return value

    @field_validator("person_height")
    @classmethod
    def _in_metres(cls, value: float | None) -> float | None:
        if value is not None and not 0.4 < value < 2.6:
            raise ValueError("must be between 0.4 and 2.6 metres")
        return value

    @model_validator(mode="after")
    def _one_lens(self) -> PrepareOptions:
        given = [n for n in ("focal", "intrinsics", "calibration") if getattr(self, n) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} both give the focal length: leave one out")
        return self

    @model_validator(mode="after")
    def _somebody_or_something(self) -> PrepareOptions:
        if not (self.find_person or self.find_object):
            raise ValueError("neither people nor objects are looked for: nothing would be fitted")
        return self

    @model_validator(mode="after")
    def _windows_overlap(self) -> PrepareOptions:
        if self.chunk is None and self.overlap is not None:
            raise ValueError("overlap is of windows: give their length, chunk, too")
        _ = self.chunking
        return self

    @model_validator(mode="after")
    def _span_is_one(self) -> PrepareOptions:
        try:
            Span.of(self.start, self.end)
        except SpecError as error:
            raise ValueError(str(error)) from error
        return self


# Options of `prepare` from a file and from KEY=VALUE settings, and the estimators that they
# name.

_OPTIONS = {"preset": "estimators"}  # whose names on the command line are others


def load_options(
    file: PrepareOptions | Path | str | None = None,
    settings: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
    registry: Registry | None = None,
) -> PrepareOptions:
    """Options from a YAML or TOML file, or ready-made, with settings and flags laid over them.

    Args:
        settings: "estimators.masks.use=estimator:masks-files".
        flags: options by name; None leaves one alone.

    Raises:
        SpecError: everything that is wrong, a line each, with its position.
    """
    if isinstance(file, PrepareOptions):
        document = Document("options", file.model_dump(mode="json"))
    else:
        document = Document("options") if file is None else read_document(Path(file))
    given = {name: value for name, value in (flags or {}).items() if value is not None}
    places: dict[tuple[str | int, ...], str] = {
        (name,): f"--{_OPTIONS.get(name, name).replace('_', '-')}" for name in given
    }
    document = document.merged(Document("command line", given, dict(places), dict(places)))
    if settings:
        document = document.merged(load_overrides(list(settings)))
    try:
        options = PrepareOptions.model_validate(document.data)
    except ValidationError as error:
        raise SpecError("\n".join(explain(error, PrepareOptions, document, ()))) from error
    installed_estimators(
        options, document, registry
    )  # so that errors in them are reported at once, too
    return options


def installed_estimators(
    options: PrepareOptions, document: Document | None = None, registry: Registry | None = None
) -> dict[Place, Estimator]:
    """The estimators that `options.estimators` names, built from their plugins.

    Args:
        document: where the options came from, for messages.

    Raises:
        SpecError: an estimator is unknown, gives something else, or its settings are wrong.
    """
    registry = registry or default_registry()
    document = document or Document("options", options.model_dump(mode="json"))
    estimators: dict[Place, Estimator] = {}
    problems: list[str] = []
    for role, spec in options.estimators.items():
        kind: EstimateKind = "masks" if role == "object" else role
        place = ("estimators", role)
        at = f"{document.where((*place, 'use'))} estimators.{role}.use"
        try:
            component = registry.concrete(spec.use)
            config_class = registry.config_class(spec.use)
        except PluginError as error:
            problems.append(f"{at}: {error}")
            continue
        if not issubclass(component, Estimator) or kind not in component.provides:
            problems.append(
                f'{at}: "{spec.use}" gives no {kind} of a video; those that do: '
                f"{', '.join(_givers(registry, kind)) or 'none is installed'}"
            )
            continue
        try:
            config = config_class.model_validate(spec.settings)
        except ValidationError as error:
            problems += explain(error, config_class, document, place)
            continue
        estimators[role] = component.from_config(config, BuildContext())
    if problems:
        raise SpecError("\n".join(problems))
    return estimators


def refuse_commands(estimators: Mapping[Place, Estimator]) -> None:
    """SpecError, showing the command lines, if estimators would run programs."""
    lines = [
        f"  estimators.{kind}: {c}"
        for kind, estimator in estimators.items()
        for c in estimator.commands()
    ]
    if lines:
        found = "\n".join(lines)
        raise SpecError(
            f"these options run programs on this machine:\n{found}\n"
            "nothing was run; if you trust them, use --allow-commands (prepare(..., "
            "allow_commands=True))"
        )


def _givers(registry: Registry, kind: EstimateKind) -> list[str]:
    """Keys of the installed estimators that give a kind of estimate."""
    found = []
    for key in registry.keys("estimator"):
        try:
            component = registry.get(key)
        except PluginError:  # one that lacks an extra cannot be chosen now
            continue
        if issubclass(component, Estimator) and kind in component.provides:
            found.append(key)
    return found

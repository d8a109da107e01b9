"""Settings of `prepare`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, PrivateAttr, ValidationError, field_validator, model_validator

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import SpecError
from hoigs.core.options import Flag, Options
from hoigs.core.spec.errors import explain
from hoigs.core.spec.loader import Document, load_overrides, read_document
from hoigs.core.spec.schema import ComponentSpec
from hoigs.preparation.video.span import Pick, Span

if TYPE_CHECKING:
    from hoigs.core.maths.frame_times import Chunking

ObjectWay = Literal["auto", "ball", "rod", "plate", "texture", "outline"]
FIT_STEPS = 40  # of the body fit, at most
# an EstimateKind, or "object": masks of the object alone (that interface loads numpy)
Place = Literal["masks", "landmarks", "depth", "object"]
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


class PrepareOptions(Options):
    """Settings of `prepare`; the defaults suit a phone's video of one person and one object."""

    width: int | None = Field(
        default=None,
        ge=16,
        description="Resize frames to this width, pixels; default: the video's own, and 1280 "
        "where its longer side is over 1920.",
    )
    every: int = Field(
        default=1,
        ge=1,
        description="Use one of each n frames: the sharpest.",
    )
    fps: float | None = Field(
        default=None,
        gt=0,
        description="Use this many frames a second, the sharpest, in place of --every.",
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
        description="Start here: 2.5 (seconds), 1:02.5, or 75f (frame 75 of the video).",
    )
    end: str | float | None = Field(
        default=None,
        description="End before this: 7.5, 1:07.5, or 225f.",
    )
    max_frames: int | None = Field(
        default=None,
        ge=1,
        description="Use only the first frames.",
    )
    image_format: Literal["jpg", "png"] = Field(
        default="jpg", description="format of stored frames"
    )
    quality: int = Field(default=95, ge=1, le=100, description="quality of jpg frames")
    camera: Literal["auto", "static", "turning", "moving", "sfm"] = Field(
        default="auto",
        description="auto, static (it never moves), turning (on its spot, as on a tripod), moving"
        " (COLMAP's model beside the video, or structure from motion) or sfm "
        "(structure from motion in any case). auto: COLMAP's model, or else whether "
        "the background moves decides.",
    )
    focal: float | None = Field(
        default=None,
        gt=0,
        description="Focal length in pixels of the video's own size, if known; default: what the "
        "file's metadata give, or the landmarks if they determine it, or else 0.8 x "
        "the longer side (64 degrees). It scales all depths.",
    )
    intrinsics: Annotated[tuple[float, ...] | None, Flag("--intrinsics", kind=str)] = Field(
        default=None,
        description="The lens, in pixels of the video's own size: fx,fy,cx,cy or "
        "fx,fy,cx,cy,k1,k2,p1,p2 as OpenCV has them. Frames are undistorted.",
    )
    calibration: str | None = Field(
        default=None,
        description="The lens, in a file of COLMAP, OpenCV, Qualisys or Pose2Sim; FILE#NAME where"
        " the file holds several.",
    )
    keep_borders: bool = Field(
        default=False,
        description="With a distorted lens: make undistorted frames so large, at most twice, that "
        "they show all that the video shows; default: the video's own size, and borders are lost.",
    )
    body: str = Field(default="body:anny", description="key of the body model, for the clip")
    person_height: float | None = Field(
        default=None,
        description="Height of the person standing, metres: the unit of the world comes from it; "
        "default: the body model's mean.",
    )
    fit_steps: int = Field(default=FIT_STEPS, ge=1, description="steps of the body fit, at most")
    chunk: int | None = Field(
        default=None,
        ge=1,
        description="For a long video: fit the body in windows of this many frames, with one "
        "shape for all.",
    )
    overlap: int | None = Field(
        default=None,
        ge=1,
        description="Frames that neighbouring windows share; default: a quarter of --chunk, 50 at"
        " most.",
    )
    preset: Annotated[Preset, Flag("--estimators")] = Field(
        default="auto",
        description="What finds landmarks and masks that no file beside the video gives: offline "
        "(MediaPipe and hoigs's tracker; auto is the same), hub (networks of the "
        "Hugging Face hub), or files (nothing does).",
    )
    estimators: dict[Place, ComponentSpec] = Field(
        default_factory=dict,
        description="where masks, landmarks and depth come from, each an estimator with its "
        'settings, before files and preset; "object": masks of the object, where "masks" gives the '
        "person's alone",
    )
    bodies: str | None = Field(
        default=None,
        description="file of bodies of GVHMR, WHAM, TRAM, PHALP, PromptHMR or SAM 3D Body, "
        "relative to the video's folder; None: the one that lies beside it, if any",
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
    human_name: str = Field(default="human", description="name of the person's entity")
    everybody: bool = Field(
        default=False,
        description="fit all people who are seen by a quick look, where no prompt says who",
    )
    further_people: tuple[str, ...] = Field(
        default=(),
        description="names of more people, each with a prompt; the estimators of landmarks and "
        "masks give those of all",
    )
    object_name: str = Field(default="object", description="name of the object's entity")
    further_objects: tuple[str, ...] = Field(
        default=(),
        description="names of more objects, each with a prompt; estimators.object follows them all",
    )
    object_track: ObjectWay = Field(
        default="auto",
        description='how the object\'s poses are found: "ball": as those of a sphere, whose '
        'rotation stays unknown; "rod": as those of something long and thin that a hand holds, '
        'whose turn about its axis stays unknown; "plate": as those of something flat, such as a '
        'board; "texture": from hands, outlines and texture; "outline": its place and roll only; '
        '"auto": as a ball where its masks are round in all frames, or else by what explains '
        "held-back frames best",
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
        description="Train on uniform black areas; default: they are ignored.",
    )
    overwrite: bool = Field(
        default=False,
        description="Replace an older clip at --out.",
    )
    overlay_width: int = Field(
        default=640, ge=0, description="width of overlay.mp4, pixels; 0 writes none"
    )

    object: tuple[str, ...] = Field(
        default=(),
        description="Where the object is: a point 640,402 or 640,402@FRAME, a point that is not "
        'on it -700,380, a box x0,y0,x1,y1, words "football" (with --estimators hub),'
        " or none; several objects with names, kettle=640,402. Default: what `hoigs "
        "annotate` stored beside the video, or a search.",
    )
    person: tuple[str, ...] = Field(
        default=(),
        description="Which person to fit where several are seen: a point on them, 320,210 or "
        "320,210@FRAME, or a box; several people with names, anna=320,210; all, or "
        "none.",
    )
    yes: Annotated[bool, Flag("--yes", "-y")] = Field(
        default=False,
        description="Install and download what is needed, unasked.",
    )
    overrides: Annotated[tuple[str, ...], Flag("--set")] = Field(
        default=(),
        description="Any option: estimators.masks.use=estimator:masks-files, "
        "estimators.masks.path=sam2.",
    )
    file: Annotated[Path | None, Flag("--options")] = Field(
        default=None,
        description="YAML or TOML file of options.",
    )
    allow_commands: bool = Field(
        default=False,
        description="Let options run the programs that they name (estimator:command, "
        "estimator:mediapipe).",
    )
    redo: tuple[str, ...] = Field(
        default=(),
        description="Run this stage again, and those that depend on it.",
    )

    _document: Document = PrivateAttr(default_factory=lambda: Document("options"))

    shown: ClassVar = (
        "object", "person", "preset", "yes", "width", "camera", "max_frames", "every", "fps",
        "start", "end", "focal", "intrinsics", "calibration", "keep_borders", "person_height",
        "chunk", "overlap", "keep_black", "overwrite", "overrides", "file", "allow_commands",
        "redo",
    )  # fmt: skip

    @classmethod
    def of(
        cls,
        options: Self | Path | str | None = None,
        settings: Mapping[str, Any] | None = None,
        verb: str = "prepare",
        places: Mapping[str, str] | None = None,
    ) -> Self:
        """Options, ready-made or from a YAML or TOML file, with `settings` laid over them.

        Raises:
            SpecError: everything that is wrong, a line each, with its position.
        """
        given = {name: value for name, value in (settings or {}).items() if value is not None}
        file, overrides = given.pop("file", None), tuple(given.pop("overrides", ()))
        if file is not None:
            options = file
        if isinstance(options, Path | str):
            document = read_document(Path(options))
            _refuse_callers(document)
        elif options is None or isinstance(options, cls):
            known = Document("options") if options is None else options.document
            data = {} if options is None else options.given()
            document = Document(known.source, data, known.keys, known.values)
        else:
            raise SpecError(f"{verb}: options must be {cls.__name__} or a file, got {options!r}")
        names = {name: (places or {}).get(name, _flag_of(cls, name)) for name in given}
        at: dict[tuple[str | int, ...], str] = {(name,): place for name, place in names.items()}
        document = document.merged(Document("command line", given, dict(at), dict(at)))
        if overrides:
            laid = load_overrides(list(overrides))
            _refuse_callers(laid)
            document = document.merged(laid)
        try:
            made = cls.model_validate(document.data)
        except ValidationError as error:
            raise SpecError("\n".join(explain(error, cls, document, ()))) from error
        made._document = document
        return made

    @property
    def document(self) -> Document:
        """Where the options came from, for messages."""
        return self._document

    @property
    def own_cameras(self) -> bool:
        """Whether cameras are found anew, whatever lies beside the video."""
        return self.camera in ("static", "turning", "sfm")

    @property
    def chunking(self) -> Chunking | None:
        """How the clip is cut into windows; None: it is not."""
        from hoigs.core.maths.frame_times import Chunking

        return None if self.chunk is None else Chunking.of(self.chunk, self.overlap)

    @property
    def people(self) -> tuple[str, ...]:
        """Names of all people, the first one's first."""
        return (self.human_name, *self.further_people) if self.find_person else ()

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of all objects, the first one's first."""
        return (self.object_name, *self.further_objects)

    @field_validator("object", "person", "redo", mode="before")
    @classmethod
    def _several(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @field_validator("calibration", mode="before")
    @classmethod
    def _text(cls, value: Any) -> Any:
        return str(value) if isinstance(value, Path) else value

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
    def _consistent(self) -> PrepareOptions:
        given = [n for n in ("focal", "intrinsics", "calibration") if getattr(self, n) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} both give the focal length: leave one out")
        if not (self.find_person or self.find_object):
            raise ValueError("neither people nor objects are looked for: nothing would be fitted")
        if self.chunk is None and self.overlap is not None:
            raise ValueError("overlap is of windows: give their length, chunk, too")
        _ = self.chunking
        try:
            Span.of(self.start, self.end)
        except SpecError as error:
            raise ValueError(str(error)) from error
        return self


# what a file beside a stranger's video, or a row of a manifest, must not decide
CALLERS = ("allow_commands", "yes", "file", "overrides")


def _refuse_callers(document: Document) -> None:
    wrong = [name for name in CALLERS if name in document.data]
    if wrong:
        lines = (
            f"{document.where((name,))} {name}: only the caller decides this, by "
            f"{_flag_of(PrepareOptions, name)} or prepare({name}=…)"
            for name in wrong
        )
        raise SpecError("\n".join(lines))


def _flag_of(options: type[Options], name: str) -> str:
    """How the command line writes an option."""
    field = options.model_fields.get(name)
    marks = () if field is None else field.metadata
    names = Flag.names_of(name, next((m for m in marks if isinstance(m, Flag)), None))
    return names[0].partition("/")[0]

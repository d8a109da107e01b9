"""Which estimator gives what: the caller's, then files beside the video, then those of a preset."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from hoigs.core.errors import HoigsError, PluginError, SpecError
from hoigs.core.interfaces.estimator import Estimator
from hoigs.core.registry.registry import default_registry
from hoigs.core.reporting import Progress
from hoigs.core.spec.schema import ComponentSpec
from hoigs.core.system import downloads as hub
from hoigs.core.system.npz import holds
from hoigs.preparation.body.body_files import BodyFileEstimator, FileBody
from hoigs.preparation.options import Place, PrepareOptions
from hoigs.preparation.video.container import video_header
from hoigs.preparation.video.source import MEGASAM, VGGT, Source, numbered_frames
from hoigs.preparation.video.span import Span

# seconds a frame of 1280x720 on two cores, about, as reports of real videos say (`seconds`); up to
# three times as long before a camera that moves; those of networks are guesses
COST = {
    "estimator:mediapipe": 0.3,
    "estimator:object-tracker": 1.8,
    "estimator:transformers-sam2": 4.0,
    "estimator:transformers-pose": 0.6,
    "estimator:transformers-depth": 1.5,
}
STAGES_COST = 0.8  # of all other stages, likewise
WHAT: dict[Place, str] = {
    "landmarks": "person's landmarks",
    "masks": "person's mask",
    "object": "object's mask",
    "depth": "depth",
}
PERSON_ONLY = ("estimator:mediapipe",)  # give no masks of objects
_OFFLINE: dict[Place, ComponentSpec] = {
    "landmarks": ComponentSpec(use="estimator:mediapipe"),
    "masks": ComponentSpec(use="estimator:mediapipe"),
    "object": ComponentSpec(use="estimator:object-tracker"),
}
_DETECTOR = "PekingU/rtdetr_v2_r18vd"
_HUB: dict[Place, ComponentSpec] = {
    "landmarks": ComponentSpec(
        use="estimator:transformers-pose", checkpoint="usyd-community/vitpose-base-simple",
        detector=_DETECTOR,
    ),
    "masks": ComponentSpec(
        use="estimator:transformers-sam2", checkpoint="facebook/sam2.1-hiera-tiny",
        detector=_DETECTOR,
    ),
    "object": ComponentSpec(
        use="estimator:transformers-sam2", checkpoint="facebook/sam2.1-hiera-tiny",
        detector=_DETECTOR,
    ),
    "depth": ComponentSpec(
        use="estimator:transformers-depth",
        checkpoint="depth-anything/Depth-Anything-V2-Small-hf",
    ),
}  # fmt: skip
OFFLINE_NOTE = "none of it needs a network; --estimators hub downloads neural networks instead"
HUB_LICENCES = "all Apache-2.0: SAM 2.1 tiny, ViTPose base, RT-DETR v2 r18, Depth Anything V2 Small"


@dataclass(frozen=True)
class Choice:
    """What gives one kind of estimate.

    Attributes:
        what: for people. use: the estimator's key, or where else it comes from.
        why: the reason. seconds: about, a frame of 1280x720 on two cores; None: unknown.
        spec: of the estimator, if the preset chose it.
    """

    place: Place
    use: str
    why: str
    seconds: float | None = None
    spec: ComponentSpec | None = None

    @property
    def what(self) -> str:
        return WHAT[self.place]


@dataclass(frozen=True)
class EstimatorPlan:
    """What a preparation is going to do.

    Attributes:
        choices: what gives each kind of estimate.
        frames: of the video, about; None: unknown. notes: sentences about what was found.
        cameras: the file or folder beside the video that has them; "": none.
        counted: whether frames were counted, and not read from the header of a video, of which a
            part may be missing.
    """

    choices: dict[Place, Choice]
    frames: int | None = None
    notes: tuple[str, ...] = ()
    cameras: str = ""
    counted: bool = False

    def specs(self) -> dict[Place, ComponentSpec]:
        """Estimators of the preset."""
        return {place: c.spec for place, c in self.choices.items() if c.spec is not None}

    def with_body(self, body: FileBody, landmarks: object) -> EstimatorPlan:
        """Says whether another program's body is used; `landmarks`: their estimator, if chosen."""
        name, program = body.path.name, body.program
        if not isinstance(landmarks, BodyFileEstimator):
            note = f"{name}, {program}'s body, is not used: there are landmarks"
            return replace(self, notes=(*self.notes, note))
        choice = Choice("landmarks", f"{program}'s body", f"from {name}", 0.0)
        return replace(self, choices={**self.choices, "landmarks": choice})

    def rows(self) -> list[tuple[str, str, str, str]]:
        """What, from where, why, and how long it takes, for a table."""
        rows = []
        met: set[str] = set()
        for choice in self.choices.values():
            seconds = 0.0 if choice.use in met and choice.place != "object" else choice.seconds
            met.add(choice.use)
            use = choice.use.removeprefix("estimator:")
            rows.append((choice.what, use, choice.why, self._time(seconds)))
        rest = "body, object, scene, clip"
        if self.cameras:
            rows.append(("cameras", self.cameras, "lies beside the video", ""))
        else:
            rest = f"cameras, {rest}"
        rows.append(("everything else", "hoigs", rest, self._time(STAGES_COST)))
        return rows

    def _time(self, seconds: float | None) -> str:
        if seconds == 0:
            return ""
        if seconds is None or self.frames is None:
            return "unknown"
        total = seconds * self.frames
        return f"{total:.0f} s" if total < 100 else f"{total / 60:.0f} min"


def plan_estimators(
    source: Source, options: PrepareOptions, given: Collection[str] = ()
) -> EstimatorPlan:
    """What gives landmarks, masks, the object's masks and depth.

    Args:
        source: with `Source.absent`. given: places that the caller's own estimators fill.

    Raises:
        SpecError: the object is described in words, which no estimator of the preset reads.
    """
    found: dict[Place, Choice] = {}
    for place in WHAT:
        choice = _choose(place, source, options, given)
        if choice is not None:
            found[place] = choice
    known = source.cameras or source.colmap
    cameras = "" if known is None else _cameras(known)
    offline = options.preset == "auto" and any(c.spec is not None for c in found.values())
    notes = (OFFLINE_NOTE,) if offline else ()
    frames, counted = _frames(source.video, options), source.video.is_dir()
    return EstimatorPlan(found, frames, notes, cameras, counted)


def _cameras(path: Path) -> str:
    """Whose they are, and the file's name."""
    programs = {"MegaSaM's": MEGASAM, "VGGT's": VGGT}
    who = next((name for name, arrays in programs.items() if holds(path, arrays)), "")
    return f"{who} {path.name}".strip() if path.is_file() else f"COLMAP's {path.name}"


def _frames(video: Path, options: PrepareOptions) -> int | None:
    """Frames that will be used, about, by the container's header."""
    if video.is_dir():
        count, rate = len(numbered_frames(video)), options.folder_fps
    else:
        header = video_header(video, about=True)
        if header is None:
            return None
        count, rate = header
    span = Span.of(options.start, options.end)
    start, end = (
        None if x is None else x.value if x.in_frames else x.value * rate
        for x in (span.start, span.end)
    )  # fmt: skip
    count = max(1, round(min(end or count, count) - (start or 0)))
    step = options.every if options.fps is None else rate / options.fps
    return max(1, min(round(count / step), options.max_frames or count))


def _choose(
    place: Place, source: Source, options: PrepareOptions, given: Collection[str]
) -> Choice | None:
    if place in given:
        named = options.estimators.get(place)
        use = named.use if named else "given"
        return Choice(place, use, "chosen by you", COST.get(use))
    if place == "object":
        return _object(source, options, given)
    if place in ("landmarks", "masks") and not options.people:
        return Choice(place, "none", "--person none", 0.0)
    if place in source.beside:
        files = source.beside[place]
        return Choice(place, files.use, f"{files.settings.get('path')} lies beside the video", 0.0)
    if place == "depth" and options.preset != "hub":
        return None  # no network of the offline preset gives it
    return _of_preset(place, options)


def _object(source: Source, options: PrepareOptions, given: Collection[str]) -> Choice | None:
    if not options.find_object:
        return Choice("object", "none", "--object none", 0.0)
    if source.ball is not None:
        return Choice("object", source.ball.name, "lies beside the video", 0.0)
    if options.object_name in source.masked:
        return Choice("object", "with the person's mask", "both lie beside the video", 0.0)
    named = options.estimators.get("masks")
    if "masks" in given and (named is None or named.use not in PERSON_ONLY):
        return Choice("object", "with the person's mask", "your estimator of masks gives both")
    if options.preset == "files":
        return Choice("object", "none", "there is no file of it beside the video", 0.0)
    return _of_preset("object", options)


def _of_preset(place: Place, options: PrepareOptions) -> Choice:
    hub = options.preset == "hub"
    spec = (_HUB if hub else _OFFLINE)[place]
    why = "--estimators hub" if hub else "no file beside the video"
    if place == "landmarks" and not hub:
        shown = [_shown(options, name) for name in options.people if name in options.prompts]
        why = "; ".join([*shown, why])
    if place == "object":
        if not _installed(spec.use):
            return Choice(place, "none", f"{spec.use} is not installed", 0.0)
        why = "; ".join(_shown(options, name) for name in options.objects)
    return Choice(place, spec.use, why, COST.get(spec.use), spec)


def _shown(options: PrepareOptions, name: str) -> str:
    """Where an entity's prompt is.

    Raises:
        SpecError: the preset's estimator of objects cannot read it.
    """
    prompt, person = options.prompts.get(name), name in options.people
    where = prompt.places() if prompt else []
    if prompt is None or not (where or prompt.text):
        return "what hands move or hold"
    if options.preset != "hub" and not person and prompt.text is not None:
        raise SpecError(
            f'--object "{prompt.text}": words need a network that reads them; point at it, '
            "such as --object 640,402, or use --estimators hub"
        )
    if options.preset == "hub" and not person and len(where) > 1:
        raise SpecError(
            "--object: SAM 2 takes points and a box of one frame; give those of one, or use "
            "--estimators offline"
        )
    if prompt.text:
        return f'"{prompt.text}"'
    what = name if person or options.further_objects else "--object"
    frames = ", ".join("first" if at.frame is None else str(at.frame) for at in where)
    return f"{what} in frame {frames}"


def _installed(key: str) -> bool:
    try:
        default_registry().get(key)
    except PluginError:
        return False
    return True


# Before work begins: environments and weights that the plan needs are there, or are fetched.

Consent = Callable[[str], bool]  # a question to whether the answer is yes


def agree(question: str) -> bool:
    """A Consent that answers yes."""
    return True


def get_ready(
    plan: EstimatorPlan,
    estimators: Mapping[Place, Estimator],
    consent: Consent | None,
    progress: Progress,
) -> None:
    """Installs environments that are absent, and asks before weights are downloaded.

    Raises:
        HoigsError: without consent, with the command that gives it.
    """
    needed = {e.environment.name: e.environment for e in estimators.values()
              if e.environment is not None and not e.commands()}  # fmt: skip
    for environment in needed.values():
        if environment.installed:
            continue
        question = (
            f"This needs {environment.summary}. hoigs installs it once into {environment.folder}; "
            f"`hoigs estimators remove {environment.name}` removes it. Install it now?"
        )
        if consent is None or not consent(question):
            environment.python()  # raises, with what to do
        environment.install(progress)
    wanted = _not_cached(plan)
    if not wanted:
        return
    names = ", ".join(wanted)
    question = (
        f"These networks are downloaded from the Hugging Face hub: {names}; licences: "
        f"{HUB_LICENCES}. Download them?"
    )
    if hub.offline():
        raise HoigsError(
            f"--estimators hub: HF_HUB_OFFLINE is set and {names} are not whole in the hub's "
            "cache; use --estimators offline, or unset it"
        )
    if consent is None or not consent(question):
        raise HoigsError(
            f"--estimators hub needs {names}, which are not whole in the hub's cache (licences: "
            f"{HUB_LICENCES}); add --yes to download them, or use --estimators offline"
        )
    for done, name in enumerate(wanted):
        progress(done / len(wanted), f"downloading {name}")
        hub.fetched(name)


def _not_cached(plan: EstimatorPlan) -> list[str]:
    """Checkpoints of the plan's networks that have to be downloaded."""
    settings = [spec.settings for spec in plan.specs().values()]
    names = {s[key] for s in settings for key in ("checkpoint", "detector") if key in s}
    return sorted(name for name in names if hub.cached(name) is None)

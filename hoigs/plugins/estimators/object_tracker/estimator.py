"""ObjectTrackerEstimator: masks of objects from clicks, boxes or motion."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool
from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError
from hoigs.core.interfaces.estimator import (
    EntityRequest,
    Estimates,
    Estimator,
    FramePrompt,
    LazyFrames,
    PromptPoint,
    VideoRequest,
)
from hoigs.core.reporting import Progress, no_progress
from hoigs.core.system.environments import EnvironmentAbsentError
from hoigs.core.system.threads import one_thread
from hoigs.plugins.estimators.object_tracker.alike import told_apart
from hoigs.plugins.estimators.object_tracker.appearance import Appearance
from hoigs.plugins.estimators.object_tracker.footage import Footage, read_footage, skeletons
from hoigs.plugins.estimators.object_tracker.outlined import clicked_mask
from hoigs.plugins.estimators.object_tracker.outlines import Outlines
from hoigs.plugins.estimators.object_tracker.prompts import (
    SET_OFF,
    PromptedMask,
    looks_like_person,
    overlap,
)
from hoigs.plugins.estimators.object_tracker.propagation import Track
from hoigs.plugins.estimators.object_tracker.proposal import proposed, sampled
from hoigs.plugins.estimators.object_tracker.refined import refined
from hoigs.plugins.estimators.object_tracker.rod import (
    Rod,
    clicked_rod,
    rod_followed,
    rod_of,
    rods_held,
)
from hoigs.plugins.estimators.object_tracker.scene import (
    Scene,
    is_static,
    moving_scene,
    static_scene,
)
from hoigs.plugins.estimators.object_tracker.states import (
    DOUBTFUL,
    SEEN,
    covers_torso,
    is_worn,
    looks_like_skin,
    mostly_doubtful,
    states_of,
    takes_in_hands,
)
from hoigs.plugins.estimators.object_tracker.together import (
    followed_together,
    groups_of,
    rivals_of,
)
from hoigs.plugins.estimators.object_tracker.tracker import (
    Said,
    at_rest,
    color_model,
    followed,
    masks_of,
    never_leaves,
    read_tracks,
    write_tracks,
)
from hoigs.plugins.estimators.tools import MEDIAPIPE, settings_key

# What is said of clicks on nothing, and of tracks that are not done, or not well.

WEAK = 0.6  # confidence below which a frame is named in a note


def nothing_there(entity: EntityRequest, prompt: FramePrompt, footage: Footage, i: int) -> str:
    """What lies under a prompt from which no mask grows."""
    point = next((p for p in prompt.points if p.inside), None)
    where = f"{point.x:g},{point.y:g}" if point else f"the box {prompt.box}"
    there = "a surface without an outline"
    if point is not None:
        h, w = footage.shape
        x, y = int(point.x * footage.scale), int(point.y * footage.scale)
        if not (0 <= x < w and 0 <= y < h):
            there = "nothing: that is outside the picture"
        elif footage.blank[i, y, x]:
            there = "a black border of the video"
        elif footage.person[i, y, x]:
            there = "the person"
    return (
        f"estimator:object-tracker: no {entity.name} was found at {where} in frame {prompt.frame}: "
        f"there is {there}; click on the middle of the object in a frame that shows it well"
    )


def doubts(tracks: dict[str, Track | None], footage: Footage) -> list[str]:
    """A sentence for each object on the frames that were not done, or not well."""
    notes = []
    for name, track in tracks.items():
        if track is None:
            continue
        seen = [bool((soft > 127).any()) for soft in track.soft]
        lost = [n for n, s in zip(footage.numbers, seen) if not s]
        weak = [n for n, s, c in zip(footage.numbers, seen, track.confidence) if s and c < WEAK]
        if lost:
            notes.append(f"{name}: not seen in {_ranges(lost)}")
        if weak:
            notes.append(f"{name}: its mask is less sure in {_ranges(weak)}; a click there helps")
    return notes


def _ranges(numbers: Sequence[int]) -> str:
    """Numbers of frames as "3 frames (10-12)", the first few ranges."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n - runs[-1][1] <= 2:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    texts = [f"{a}" if a == b else f"{a}-{b}" for a, b in runs[:6]]
    more = ", …" if len(runs) > 6 else ""
    return f"{len(numbers)} frame{'s' if len(numbers) > 1 else ''} ({', '.join(texts)}{more})"


VERSION = 36  # of what is kept in `work`; raised when masks change
VAGUE = (
    "most of what was found lies on a person and has their colours, and is dropped: click on it "
    "in a frame that shows it beside them, or give a box"
)
CLOTHES = (
    "what was taken never leaves one person's torso and thighs and may be their clothes: no mask "
    "of it counts as seen; click on the object"
)
SHIRT = (
    "what was taken covers one person's torso and hardly reaches beyond it: that is rather their "
    "clothes, and is dropped; click on the object"
)
SKIN = (
    "what was taken has the colours of people's faces and hands: that is rather a bare arm or leg, "
    "and is dropped; click on the object"
)
HANDS = (
    "its masks take in the hands that hold it, so that none counts as seen: click on it in a frame "
    "that shows it beside them, or give a box"
)
EQUAL = (
    "other things look the same, so that only its path tells which is which; where it does not, "
    "nothing is shown, and a click there or later says it"
)
FOLLOWED = 0.7  # share of the work that is done where objects are outlined again
SHARED = 0.3  # of a mask that is another object's, from which it is that


class ObjectTrackerConfig(ComponentConfig):
    """Settings of `estimator:object-tracker`."""

    size: int = Field(
        default=640, ge=64, description="pixels of the longer side at which objects are tracked"
    )
    network: bool | None = Field(
        default=None,
        description="outline objects by a segmentation network, which runs in the environment of "
        "`hoigs estimators install mediapipe`; None: where that is installed",
    )


class ObjectTrackerEstimator(Estimator):
    """Masks of objects through a video from one click, box or a few of them. They are followed by
    what is learnt on the video, and outlined by a network where it is installed.

    It needs the person's masks (`VideoRequest.known`) to tell the object from the person, and does
    what it can without. An object without a prompt is proposed: what is around the hands in many
    frames, and is neither the scene nor the person by motion, landmarks and colours.
    """

    Config: ClassVar = ObjectTrackerConfig
    config: ObjectTrackerConfig
    provides = frozenset({"masks"})

    def __repr__(self) -> str:
        """With whether the network is there: what was found without it is found anew."""
        return f"{super().__repr__()[:-1]}, installed={Outlines.installed()})"

    def estimate(self, video: VideoRequest, progress: Progress = no_progress) -> Estimates:
        wanted = [e for e in video.entities if e.kind == "object"]
        wanted = wanted or [EntityRequest("object")]
        file = video.work / f"object-tracker-{self._key(video, wanted)}.npz"
        if not file.is_file():
            self._track(video, wanted, file, progress)
        progress(1.0, "object")
        return Estimates(read_tracks(file, video, [e.name for e in wanted]))

    def _key(self, video: VideoRequest, wanted: Sequence[EntityRequest]) -> str:
        """Key of everything that masks depend on; a few frames stand for the person's masks."""
        person = _person(video)
        digest = hashlib.sha256()
        if video.known is not None:
            for track in (video.known.landmarks or {}).values():
                digest.update(np.ascontiguousarray(track.image_xyzv).tobytes())
        if person is not None:
            for i in video.numbers[:: max(1, len(video.numbers) // 8)]:
                digest.update(np.packbits(person[i]).tobytes())
        return settings_key({
            "version": VERSION, "settings": self.config.model_dump() | {"network": self._outlined},
            "frames": video.numbers,
            "objects": [[e.name, repr(e.prompts)] for e in wanted], "static": video.static_camera,
            "person": digest.hexdigest(),
        })  # fmt: skip

    @property
    def _outlined(self) -> bool:
        """Whether the network is used.

        Raises:
            EnvironmentAbsentError: it is wanted and not installed.
        """
        installed = Outlines.installed()
        if self.config.network and not installed:
            raise EnvironmentAbsentError(
                "estimator:object-tracker: the network that outlines objects is not installed; run "
                f"`hoigs estimators install {MEDIAPIPE.name}`, or leave out `network: true`"
            )
        return installed if self.config.network is None else self.config.network

    @one_thread()
    def _track(
        self, video: VideoRequest, wanted: Sequence[EntityRequest], file: Path, progress: Progress
    ) -> None:
        also = sorted({p.frame for e in wanted for p in e.prompts})
        for number in also:
            if not 0 <= number < video.frames:
                raise HoigsError(
                    f"estimator:object-tracker: a prompt is in frame {number}; the video has "
                    f"frames 0 to {video.frames - 1}"
                )
        footage = read_footage(
            video, _person(video), also, self.config.size, lambda x: progress(0.3 * x, "frames")
        )
        still = video.static_camera or is_static(footage)
        scene: Scene = static_scene(footage) if still else moving_scene(footage)
        progress(0.35, "object")
        with ExitStack() as stack:
            outlines = None
            if self._outlined:
                outlines = stack.enter_context(Outlines(footage.shape, video.frame))
            tracks, said = self._followed(video, wanted, footage, scene, outlines, progress)
        write_tracks(file, video, footage, tracks, said)

    def _followed(
        self, video: VideoRequest, wanted: Sequence[EntityRequest], footage: Footage, scene: Scene,
        outlines: Outlines | None, progress: Progress,
    ) -> tuple[dict[str, Track | None], Said]:  # fmt: skip
        """Where each object is, and what there is to say of it."""
        ends = 1.0 if outlines is None else FOLLOWED
        people = skeletons(video, footage.numbers, footage.scale)
        tracks: dict[str, Track | None] = {}
        prompts: dict[str, list[PromptedMask]] = {}
        notes: list[str] = []
        chosen: dict[str, list[FramePrompt]] = {}
        rods: dict[str, list[Rod]] = {}
        for entity in (e for e in wanted if e.prompts):
            if held := _rods(entity, footage, scene, people):
                rods[entity.name] = held
                prompts[entity.name] = [clicked_rod(footage, scene, people, rod) for rod in held]
            else:
                prompts[entity.name] = self._prompted(entity, footage, scene, outlines, notes)
        looks = {
            n: Appearance.learnt(footage, masks_of(m))
            for n, m in prompts.items()
            if m and n not in rods
        }
        rivals = {n: rivals_of(footage, scene, k, masks_of(prompts[n])) for n, k in looks.items()}
        groups = groups_of(prompts, rivals)
        equal = {n for _, group in groups for n in group}
        done = 0.35
        for frame, group in groups:
            share = (ends - 0.35) * len(group) / len(wanted)
            part = _part(progress, done, share)
            tracks |= followed_together(footage, {n: prompts[n] for n in group}, frame, part)
            notes.append(f"{', '.join(group)}: {EQUAL}")
            done += share
        for entity in (e for e in wanted if e.name not in equal):
            if not entity.prompts and (rod := _held(footage, scene, people, tracks)):
                rods[entity.name] = [rod]
                prompts[entity.name] = [clicked_rod(footage, scene, people, rod)]
                chosen[entity.name] = [_taken(entity, footage, rod, notes)]
            elif not entity.prompts:
                prompts[entity.name], chosen[entity.name] = _proposed(
                    entity, footage, scene, people, tracks, notes
                )
            masks, share = prompts[entity.name], (ends - 0.35) / len(wanted)
            part = _part(progress, done, share)
            if entity.name in rods:
                tracks[entity.name] = rod_followed(footage, scene, people, rods[entity.name], part)
            else:
                tracks[entity.name] = (
                    followed(footage, scene, masks, part, looks.get(entity.name)) if masks else None
                )
            done += share
        others = {n: [] if n in equal or n in rods else masks for n, masks in prompts.items()}
        tracks, alike = told_apart(footage, scene, others, {e.name: tracks[e.name] for e in wanted})
        led: dict[str, Bool[np.ndarray, " F"]] = {}
        if outlines is not None:
            for k, (name, track) in enumerate(tracks.items()):
                if track is not None and name not in rods:
                    part = _part(
                        progress, ends + k * (1 - ends) / len(wanted), (1 - ends) / len(wanted)
                    )
                    clicked = [] if name in chosen else [p.frame for p in prompts[name]]
                    better = refined(footage, outlines, track, clicked, name in equal, part)
                    tracks[name], led[name] = better.track, better.led
        states = states_of(footage, tracks, led)
        vague = [n for n, s in states.items() if mostly_doubtful(s)]
        taken = {n: t.soft > 127 for n, t in tracks.items() if n in chosen and t is not None}
        shirts = [n for n, m in taken.items() if n not in vague and covers_torso(m, people)]
        bare = [
            n
            for n, m in taken.items()
            if n not in (*vague, *shirts) and looks_like_skin(footage, m, people)
        ]
        tracks |= dict.fromkeys((*vague, *shirts, *bare))
        states = states_of(footage, tracks, led)
        worn = [n for n, t in tracks.items() if n in chosen and t and is_worn(t.soft > 127, people)]
        own = [n for n, m in prompts.items() if m and n not in chosen]
        faint = [n for n in own if all(_looks_like_scenery(scene, p) for p in prompts[n])]
        scenery = [n for n in faint if (t := tracks[n]) and never_leaves(scene, t.soft > 127)]
        # these are not dropped: the masks are about the object, and of more than it
        handed = [
            n
            for n, t in tracks.items()
            if t and n not in rods and takes_in_hands(footage, t.soft > 127, people)
        ]
        unsure = (*worn, *scenery, *handed)
        states |= {n: [DOUBTFUL if s == SEEN else s for s in states[n]] for n in unsure}
        why = (
            (vague, VAGUE), (shirts, SHIRT), (bare, SKIN), (worn, CLOTHES), (handed, HANDS),
        )  # fmt: skip
        said = [f"{n}: {reason}" for names, reason in why for n in names]
        notes += [*alike, *said, *doubts(tracks, footage)]
        return tracks, Said(chosen, notes, states, outlines is not None)

    def _prompted(
        self, entity: EntityRequest, footage: Footage, scene: Scene, outlines: Outlines | None,
        notes: list[str],
    ) -> list[PromptedMask]:  # fmt: skip
        """Masks of the entity's prompts."""
        masks: list[PromptedMask] = []
        for prompt in entity.prompts:
            i = footage.numbers.index(prompt.frame)
            known = color_model(footage, {m.frame: m.soft for m in masks}) if masks else None
            found = clicked_mask(footage, scene, i, prompt, known, outlines)
            if not (found.soft > 0.5).any():
                raise HoigsError(nothing_there(entity, prompt, footage, i))
            if prompt.box is None and looks_like_person(footage, found):
                notes.append(
                    f"{entity.name}: what was clicked in frame {prompt.frame} lies on the person "
                    "and has their colours, so it is not followed: click where it is before "
                    "something else, or give a box"
                )
                continue
            if _looks_like_scenery(scene, found):
                notes.append(
                    f"{entity.name}: what was clicked in frame {prompt.frame} hardly differs from "
                    "what is around it, and looks like a part of the scene: if it is none, click "
                    "where it is seen better, or give a box"
                )
            masks.append(found)
        return masks


def _rods(
    entity: EntityRequest, footage: Footage, scene: Scene, people: Sequence[np.ndarray]
) -> list[Rod]:
    """The entity in each of its clicked frames, where it is long and thin and held in all of them;
    else none."""
    found = []
    for prompt in entity.prompts:
        click = next((np.array((p.x, p.y)) for p in prompt.points if p.inside), None)
        i = footage.numbers.index(prompt.frame)
        if prompt.box or click is None:
            return []
        rod = rod_of(footage, scene, people, i, footage.scale * click)
        if rod is None:
            return []
        found.append(rod)
    return found


def _looks_like_scenery(scene: Scene, found: PromptedMask) -> bool:
    """Whether a mask is hardly set off from what is around it, and is as the scene is there."""
    return found.quality < SET_OFF and at_rest(scene, {found.frame: found.soft > 0.5})


def _proposed(
    entity: EntityRequest,
    footage: Footage,
    scene: Scene,
    people: Sequence[np.ndarray],
    others: dict[str, Track | None],
    notes: list[str],
) -> tuple[list[PromptedMask], list[FramePrompt]]:
    """Masks in a few frames, and the clicks that give them; none, with a note, where nothing is."""
    taken = [t.soft > 127 for t in others.values() if t is not None]
    found = proposed(footage, scene, people, np.any(taken, axis=0) if taken else None)
    if not found:
        notes.append(
            f"{entity.name}: nothing was found that moves or is held and is not the person; click "
            "on it (--object X,Y@FRAME, or hoigs annotate)"
        )
    else:
        notes.append(_not_clicked(entity, found[0].prompt))
    return [p.mask for p in found], [p.prompt for p in found]


def _held(
    footage: Footage,
    scene: Scene,
    people: Sequence[np.ndarray],
    others: dict[str, Track | None],
) -> Rod | None:
    """A long and thin thing in a hand that is no other object; None where there is none."""
    for rod in rods_held(footage, scene, people, sampled(len(footage), people)):
        mask = clicked_rod(footage, scene, people, rod).soft > 0.5
        taken = [t.soft[rod.frame] > 127 for t in others.values() if t is not None]
        if mask.any() and not any(overlap(mask, other & mask) > SHARED for other in taken):
            return rod
    return None


def _taken(entity: EntityRequest, footage: Footage, rod: Rod, notes: list[str]) -> FramePrompt:
    """The click that would have given this, and a note."""
    x, y = (round(float(v) / footage.scale) for v in rod.click)
    prompt = FramePrompt(footage.numbers[rod.frame], (PromptPoint(x, y),))
    notes.append(_not_clicked(entity, prompt))
    return prompt


def _not_clicked(entity: EntityRequest, prompt: FramePrompt) -> str:
    point = prompt.points[0]
    return (
        f"{entity.name}: nothing was clicked, and what is at {point.x:g},{point.y:g} in frame "
        f"{prompt.frame} was taken (object.jpg); if it is something else, click on it (--object "
        "X,Y@FRAME, or hoigs annotate)"
    )


def _part(progress: Progress, start: float, share: float) -> Callable[[float], None]:
    """Progress of one object among several."""
    return lambda done: progress(start + share * done, "object")


def _person(video: VideoRequest) -> Sequence[Any] | None:
    """Masks of all people together, by frame of the video; None where there are none."""
    masks = None if video.known is None else video.known.masks
    if masks is None or not masks.entities:
        return None
    each = list(masks.entities.values())
    if len(each) == 1:
        return each[0]
    return LazyFrames(video.frames, lambda i: np.any([m[i] for m in each], axis=0))

"""Cases, read from YAML: trigger, criterion, sweep, and the models that each concerns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import Field

from hoigs.core.config import ComponentConfig
from hoigs.core.errors import HoigsError, did_you_mean
from hoigs.core.spec.loader import load_yaml
from hoigs.studies.stress.capabilities import Capability
from hoigs.studies.stress.measures import MEASURES

FOLDER = Path(__file__).with_name("cases")
FAMILIES = ("motion", "camera", "human", "interaction", "optimisation")


class Criterion(ComponentConfig):
    """A bound of one measure of a training; exactly one bound is given.

    Attributes:
        measure: a key of `measures.MEASURES`.
        loses: the most that it may lose from the first level, of the same spec and seed.
        ratio: the most that it may be, relative to the first level.
        at_most, at_least: bounds of the number itself.
    """

    measure: str
    loses: float | None = None
    ratio: float | None = None
    at_most: float | None = None
    at_least: float | None = None

    def holds(self, value: float, first: float) -> bool:
        """Whether `value` is within the bound; `first` is the value at the first level."""
        if self.loses is not None:
            return first - value <= self.loses
        if self.ratio is not None:
            return value <= self.ratio * first
        if self.at_most is not None:
            return value <= self.at_most
        assert self.at_least is not None
        return value >= self.at_least

    @property
    def words(self) -> str:
        measure = MEASURES[self.measure]
        unit = f" {measure.unit}" if measure.unit else ""
        if self.loses is not None:
            return f"{measure.title} loses at most {self.loses:g}{unit}"
        if self.ratio is not None:
            return f"{measure.title} at most {self.ratio:g} times the first"
        if self.at_most is not None:
            return f"{measure.title} at most {self.at_most:g}{unit}"
        return f"{measure.title} at least {self.at_least:g}{unit}"


class Sweep(ComponentConfig):
    """A setting of the clip's generator or of a spec that is varied until a method breaks.

    Attributes:
        clip: built-in clip with any settings of its own: "carry?camera.arc_degrees=20".
        sets: settings in the clip's name, with `{}` for the value: "object.cycles={}".
        blocks: settings of every model block that has them, with `{}` for the value:
            "deformation.keyframe_step".
        values: easiest first; the others are compared with the first.
        required: the hardest value that a method must pass; None is the last.
        unit: of the values, for axes and tables.
        scored_on: "own", the clip's own test frames; "first", those of the first value's clip, for
            settings that degrade the training data and not the motion.
        faults: whether the clip has faults that training must be allowed to ignore.
        criteria: all must hold.
        draws: measure of the breakdown curves; None is that of the first criterion.
    """

    clip: str
    sets: tuple[str, ...] = ()
    blocks: dict[str, str] = Field(default_factory=dict)
    values: tuple[float, ...] = Field(min_length=2)
    required: float | None = None
    unit: str
    scored_on: Literal["own", "first"] = "own"
    faults: bool = False
    criteria: tuple[Criterion, ...] = Field(min_length=1)
    draws: str | None = None

    @property
    def drawn(self) -> str:
        """The measure of the breakdown curves."""
        return self.draws or self.criteria[0].measure

    @property
    def required_value(self) -> float:
        return self.values[-1] if self.required is None else self.required


class Case(ComponentConfig):
    """One failure case.

    Attributes:
        title: what fails. trigger: what causes it. criterion: what passes, in words.
        concerns: capabilities of the models that the case applies to; () is every model.
        sweep: the setting that is varied, with short trainings.
        limitation: failing is inherent in the method of a model with one of these capabilities (or
            without: "no keyed opacity").
        advice: what to do about it.
    """

    id: str = Field(pattern=r"^F\d\d$")
    title: str
    trigger: str
    criterion: str
    concerns: tuple[Capability, ...] = ()
    sweep: Sweep
    limitation: tuple[Capability | Literal["no keyed opacity"], ...] = ()
    advice: str = ""

    def is_limitation(self, has: frozenset[Capability]) -> bool:
        """Whether failing is inherent in a method with these capabilities."""
        flat = "keyed opacity" not in has
        return any(flat if word == "no keyed opacity" else word in has for word in self.limitation)


class _File(ComponentConfig):
    cases: tuple[Case, ...]


@cache
def load_cases() -> Mapping[str, tuple[Case, ...]]:
    """All cases by family, in order."""
    paths = {family: FOLDER / f"{family}.yaml" for family in FAMILIES}
    return {
        family: _File.model_validate(load_yaml(path.read_text("utf-8"), str(path)).data).cases
        for family, path in paths.items()
    }


def all_cases() -> tuple[Case, ...]:
    return tuple(case for cases in load_cases().values() for case in cases)


def choose_cases(text: str) -> tuple[Case, ...]:
    """`--cases`: "all", or ids and families with commas between.

    Raises:
        HoigsError: a name that is neither.
    """
    known = all_cases()
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words or "all" in words:
        return known
    wanted: set[str] = set()
    by_word: dict[str, Sequence[Case]] = {case.id: [case] for case in known}
    by_word |= load_cases()
    for word in words:
        key = next((k for k in by_word if k.lower() == word.lower()), None)
        if key is None:
            near = did_you_mean(word.upper() if word[1:].isdigit() else word.lower(), by_word)
            raise HoigsError(
                f"--cases: no case {word!r}{near}; there are {', '.join(by_word)} and all"
            )
        wanted |= {case.id for case in by_word[key]}
    return tuple(case for case in known if case.id in wanted)

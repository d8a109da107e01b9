"""--object: points, boxes and words."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hoigs.core.errors import SpecError
from hoigs.preparation.options import PrepareOptions, Prompt
from hoigs.preparation.prompts import check_prompts, parse_prompts, placed_prompts, with_prompts
from hoigs.preparation.video.frames import FrameList

FOUND = FrameList(64, 48, 30.0, 30.0, 10, list(range(10)), [1.0] * 10)


def test_clicks_by_frame() -> None:
    prompt = parse_prompts(["30,20", "-10, 5", "!11,6", "12.5,7@4", "1,2,30,40@4"])
    assert prompt.frame is None and prompt.box is None
    assert prompt.points == [(30, 20, True), (10, 5, False), (11, 6, False)]
    (other,) = prompt.further
    assert other.frame == 4 and other.points == [(12.5, 7, True)] and other.box == (1, 2, 30, 40)
    assert parse_prompts(["football"]).text == "football"
    assert parse_prompts(["1,2@3"]).frame == 3


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["1,2,3"], "1,2,3"),
        (["-1,2,3,4"], "-1,2,3,4"),
        (["9,9,3,3"], "x0 < x1"),
        (["640;402"], "640;402"),
        (["ball@3"], "ball@3"),
        (["ball", "football"], "ball.*football"),
        (["-3,4"], "--object"),
        (["0,0,3,4", "0,0,5,6"], "0,0,5,6"),
        (["none", "3,4"], "--object none"),
        (["kettle=none"], "--object none"),
        (["human=1,2"], "human"),
        (["kettle="], "--object"),
    ],
)
def test_what_is_wrong_is_named(texts: list[str], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        with_prompts(PrepareOptions(object=texts))


def test_prompts_become_options() -> None:
    options = with_prompts(PrepareOptions(object="3,4@2", preset="offline"))
    assert options.prompts["object"].frame == 2 and options.preset == "offline"
    assert with_prompts(PrepareOptions(object=["none"])).find_object is False
    named = with_prompts(PrepareOptions(object=["kettle=3,4", " kettle = -5,6@7"]))
    assert named.object_name == "kettle" and [
        at.frame for at in named.prompts["kettle"].places()
    ] == [
        None,
        7,
    ]
    both = with_prompts(PrepareOptions(object=["kettle=3,4", "5,6@7", "kettle=7,8@9"]))
    assert both.objects == ("kettle", "object") and set(both.prompts) == set(both.objects)
    assert len(both.prompts["kettle"].places()) == 2
    untouched = PrepareOptions()
    assert with_prompts(untouched) is untouched


def given(*places: str) -> dict[str, Prompt]:
    return with_prompts(PrepareOptions(object=places)).prompts


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("64.5,3", r"64\.5,3 in frame 0.*64x48"),
        ("1,1,20,60@2", "20,60 in frame 2"),
        ("3,4@10", "frame 10.* 0 to 9"),
    ],
)
def test_prompts_outside_of_the_video(text: str, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        check_prompts(placed_prompts(given(text), FOUND), FOUND)
    check_prompts(given("64,48", "3,4@9"), FOUND)


def test_prompts_count_frames_of_the_video_wherever_it_is_started() -> None:
    late = replace(FOUND, first=4, indices=[4, 6, 8])
    prompt = placed_prompts(given("3,4", "9,9@8", "-1,1@4"), late)["object"]
    assert [at.frame for at in prompt.places()] == [4, 8]
    assert prompt.points == [(3, 4, True), (1, 1, False)]
    with pytest.raises(SpecError, match=r"frame 2.* 4 to 9"):
        check_prompts(given("3,4@2"), late)
    with pytest.raises(SpecError, match="frame 4"):
        placed_prompts(given("0,0,3,4", "0,0,5,6@4"), late)


def test_a_person_is_chosen_as_an_object_is() -> None:
    options = with_prompts(PrepareOptions(object="640,402", person=["320,210@3", "-500,200@3"]))
    (at,) = options.prompts["human"].places()
    assert at.frame == 3 and at.points == [(320, 210, True), (500, 200, False)]
    assert options.prompts["object"].points == [(640, 402, True)]
    assert with_prompts(PrepareOptions(person="anna=320,210")).human_name == "anna"
    alone = with_prompts(PrepareOptions(object="ball=3,4", person="none"))
    assert alone.people == () and alone.objects == ("ball",)
    with pytest.raises(SpecError, match=r"--person.*--object"):
        with_prompts(PrepareOptions(object="none", person="none"))
    with pytest.raises(SpecError, match="--person"):
        with_prompts(PrepareOptions(person=["none", "3,4"]))


def test_several_people_have_names() -> None:
    people = ["anna=3,2", "ben=5,2", "anna=4,2@7"]
    options = with_prompts(PrepareOptions(object="9,9", person=people))
    assert options.people == ("anna", "ben") and len(options.prompts["anna"].places()) == 2
    assert set(options.prompts) == {"object", "anna", "ben"}
    both = with_prompts(PrepareOptions(person=["3,2", "anna=5,2"]))
    assert both.people == ("human", "anna")
    with pytest.raises(SpecError, match="ball is an object's name"):
        with_prompts(PrepareOptions(object="ball=3,4", person="ball=3,2"))

"""Regions of a frame, by hand-drawn masks."""

from __future__ import annotations

from dataclasses import replace

import torch

from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame
from hoigs.core.values.moment import Moment
from hoigs.metrics.regions import MEANING, REGIONS, default_band, dilate, region_masks


def frame(**boxes: tuple[slice, slice]) -> Frame:
    masks = {}
    for name, box in boxes.items():
        masks[name] = torch.zeros(20, 30, dtype=torch.bool)
        masks[name][box] = True
    image = torch.zeros(20, 30, 3, dtype=torch.uint8)
    return Frame(0, Moment(0.0), Camera(torch.eye(3), torch.eye(4), 30, 20), image, masks, None)


def test_regions_of_two_humans_and_an_object() -> None:
    drawn = frame(
        a=(slice(5, 15), slice(0, 10)),
        b=(slice(5, 15), slice(25, 30)),
        box=(slice(8, 12), slice(12, 18)),
    )
    masks = region_masks(drawn, {"a": "human", "b": "human", "box": "object"}, band=3)
    assert tuple(masks) == REGIONS and set(MEANING) == set(REGIONS)
    areas = {name: int(mask.sum()) for name, mask in masks.items()}
    assert areas["full"] == 600 and areas["human"] == 150 and areas["object"] == 24
    assert areas["human_object"] == 174 and areas["background"] == 426
    # a, grown by 3, spans columns 0..12; the box, grown, columns 9..20 and rows 5..14
    rows, columns = masks["interaction"].nonzero(as_tuple=True)
    assert (int(columns.min()), int(columns.max())) == (9, 12)
    assert (int(rows.min()), int(rows.max())) == (5, 14)


def test_far_apart_there_is_no_interaction() -> None:
    drawn = frame(a=(slice(0, 3), slice(0, 3)), box=(slice(15, 20), slice(25, 30)))
    masks = region_masks(drawn, {"a": "human", "box": "object"}, band=2)
    assert not masks["interaction"].any()


def test_dilation_is_a_square_and_leaves_its_input_alone() -> None:
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[4, 4] = True
    grown = dilate(mask, 2)
    expected = torch.zeros(9, 9, dtype=torch.bool)
    expected[2:7, 2:7] = True
    assert grown.equal(expected) and int(mask.sum()) == 1
    assert dilate(mask, 0).equal(mask) and int(dilate(mask, 1).sum()) == 9


def test_regions_leave_out_what_shows_no_scene_and_what_is_not_known() -> None:
    drawn = frame(a=(slice(5, 15), slice(0, 10)), box=(slice(8, 12), slice(12, 18)))
    no_scene = torch.zeros(20, 30, dtype=torch.bool)
    no_scene[:10] = True
    kinds = {"a": "human", "box": "object"}
    whole = region_masks(drawn, kinds, band=3)
    for name, mask in region_masks(replace(drawn, ignored=no_scene), kinds, band=3).items():
        assert mask.equal(whole[name] & ~no_scene)
    found = region_masks(replace(drawn, unknown=frozenset({"box"})), kinds, band=3)
    empty = {name for name, mask in found.items() if not mask.any()}
    assert empty == {"object", "human_object", "interaction", "background"}
    assert found["human"].equal(whole["human"]) and found["full"].all()


def test_band_follows_the_resolution() -> None:
    assert default_band(64, 48) == 2
    assert default_band(256, 256) == 5
    assert default_band(640, 360) == default_band(360, 640) == 13

"""Clip as a value: shown in a line, cut, copied, pickled."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import pytest
import torch

from hoigs.core.maths.frame_times import frame_at
from hoigs.core.values.clip import Clip
from hoigs.testing.material import FRAMES, HUMAN, OBJECT, tiny_clip


@pytest.fixture
def clip() -> Clip:
    clip = tiny_clip()
    return replace(clip, held_out=replace(clip, name="held out", split={"test": range(FRAMES)}))


@pytest.mark.parametrize("of", [lambda c: c, lambda c: c[1], lambda c: c.objects[OBJECT]])
def test_values_are_shown_in_one_line_without_their_numbers(clip, of) -> None:
    shown = repr(of(clip))
    assert "\n" not in shown and "tensor(" not in shown and len(shown) < 1500


def test_a_clip_is_shown_by_its_facts_also_in_a_notebook(clip) -> None:
    named = replace(clip, name="<b>")
    for shown in (repr(clip), named._repr_html_()):
        assert f"{FRAMES} of " in shown and HUMAN in shown and OBJECT in shown
    assert len(repr(clip)) < 300
    assert "<b>" not in named._repr_html_().replace("<caption><b>", "")


def test_a_copy_and_a_pickle_read_the_same_pixels(clip) -> None:
    small = clip.resized(8)
    small.store.image(2)  # a cache that is in use
    for twin in (copy.deepcopy(small), pickle.loads(pickle.dumps(small))):
        assert torch.equal(twin.store.image(2), small.store.image(2))


def test_a_slice_is_a_clip_whose_time_runs_from_0_to_1(clip) -> None:
    cut = clip[2:6]
    assert [m.index for m in cut.moments] == [0, 1, 2, 3]
    assert [m.time for m in cut.moments] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert cut.num_frames == 4 and cut.frame_times is None
    for new, old in enumerate(range(2, 6)):
        assert torch.equal(cut.store.image(new), clip.store.image(old))
        assert torch.equal(cut.store.mask(OBJECT, new), clip.store.mask(OBJECT, old))
        assert torch.equal(
            cut.objects[OBJECT].translations[new], clip.objects[OBJECT].translations[old]
        )
        pose = cut.bodies[HUMAN].poses.frame(new)
        assert torch.equal(pose.transl, clip.moments[old].poses[HUMAN].transl)
    for name, positions in clip.split.items():
        assert [p + 2 for p in cut.split[name]] == [p for p in positions if 2 <= p < 6]
    assert cut.held_out is not None
    assert [m.index for m in cut.held_out.moments] == [0, 1, 2, 3]
    assert torch.equal(cut.held_out.store.image(0), clip.held_out.store.image(2))


def test_a_step_leaves_frames_out_but_keeps_the_rows_of_tracks(clip) -> None:
    cut = clip[1:6:2]
    assert [m.index for m in cut.moments] == [0, 2, 4]
    assert cut.num_frames == len(cut.objects[OBJECT].rotations) == 5
    assert torch.equal(cut.store.image(1), clip.store.image(3))


def test_times_that_are_not_even_stay_uneven(clip) -> None:
    times = tuple((i / (FRAMES - 1)) ** 2 for i in range(FRAMES))
    uneven = replace(
        clip,
        moments=[replace(m, time=t) for m, t in zip(clip.moments, times, strict=True)],
        objects={OBJECT: replace(clip.objects[OBJECT], times=times)},
        held_out=None,
    )
    cut = uneven[1:5]
    span = times[4] - times[1]
    expected = [(t - times[1]) / span for t in times[1:5]]
    assert list(cut.frame_times or ()) == pytest.approx(expected)
    track = cut.objects[OBJECT].times
    assert track == pytest.approx(expected)
    assert frame_at(expected[2], 4, track) == pytest.approx(2)


def test_slices_that_hold_nothing_or_run_backwards_are_refused(clip) -> None:
    with pytest.raises(IndexError, match=str(FRAMES)):
        clip[FRAMES:]
    with pytest.raises(ValueError, match="-1"):
        clip[::-1]


@pytest.mark.parametrize("points", [True, False])
def test_a_static_camera_has_an_extent(clip, points) -> None:  # F13
    """Learning rates of positions are in units of it."""
    still = replace(clip, cameras=[clip.cameras[0]] * len(clip.cameras))
    if not points:
        still = replace(still, points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3))
    assert still.extent() > 0.5

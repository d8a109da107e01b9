"""Windows over a clip: they cover it, are no longer than wanted, and overlap as wanted."""

from __future__ import annotations

from itertools import pairwise

import pytest

from hoigs.core.maths.frame_times import Chunking


@pytest.mark.parametrize("frames", [1, 40, 41, 97, 1000, 4999])
@pytest.mark.parametrize(("chunk", "overlap"), [(40, 4), (40, 20), (500, 50)])
def test_windows_cover_the_clip_and_overlap(frames: int, chunk: int, overlap: int) -> None:
    windows = Chunking(chunk, overlap).windows(frames)
    assert windows[0].start == 0
    assert windows[-1].stop == frames
    assert max(w.stop - w.start for w in windows) <= chunk
    assert (len(windows) == 1) == (frames <= chunk)
    for before, after in pairwise(windows):
        assert before.stop - after.start == overlap
        assert before.start < after.start


def test_without_an_overlap_a_quarter_is_shared_but_no_more_than_fifty_frames() -> None:
    assert Chunking.of(8).overlap == 4
    assert Chunking.of(40).overlap == 10
    assert Chunking.of(500).overlap == 50
    assert Chunking.of(500, 120).overlap == 120


@pytest.mark.parametrize(
    ("chunk", "overlap", "said"),
    [
        (100, 51, "windows of 100 frames .* may share 50"),
        (100, 3, "have to share 4 or more"),
        (7, None, "windows need 8 or more"),
    ],
)
def test_what_cannot_be_joined_is_refused(chunk: int, overlap: int | None, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Chunking.of(chunk, overlap)

"""Damages of each kind of file: read, or refused with a sentence; nothing else."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).parents[2]
# what takes a tenth of a second or more gets fewer here; benchmarks/fuzz.py runs 10,000
CASES = {"specs": 100, "options": 200, "shapes": 200, "clips": 100, "runs": 50, "checkpoints": 30}
CASES |= {f"layout {name}": 40 for name in (
    "dnerf", "hypernerf", "colmap", "colmap-binary", "nerfstudio", "hold",
    "arctic", "behave", "exavatar", "hosnerf", "neuman",
)}  # fmt: skip
CASES["bodies"] = 100


@pytest.fixture(scope="module")
def targets(tmp_path_factory):
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks import fuzz

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    made = fuzz.make_targets(tmp_path_factory.mktemp("fuzz"), fuzz.small_clip_folder())
    yield {target.name: target for target in made}
    torch.set_num_threads(before)
    monkeypatch.undo()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_damaged_files_are_answered(targets, name):
    from benchmarks.fuzz import Outcome, try_one

    outcome = Outcome()

    @settings(max_examples=CASES[name], deadline=None, derandomize=True, database=None,
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(seed=st.integers(0, 2**32))
    def answered(seed: int) -> None:
        try_one(targets[name], random.Random(seed), outcome)

    answered()
    assert outcome.refused > 0.2 * outcome.cases  # the damages do damage
    assert outcome.read + outcome.refused == outcome.cases


def test_a_reader_that_fails_is_found(tmp_path):
    """The check itself: a traceback, a written file and a run pickle are all wrong."""
    pytest.MonkeyPatch().syspath_prepend(str(ROOT))
    from benchmarks.fuzz import Outcome, Target, try_one

    (tmp_path / "a.json").write_text("{}")

    def crash(folder: Path) -> None:
        raise IndexError("17")

    def write(folder: Path) -> None:
        (folder / "more").write_text("x")

    for read, words in ((crash, "IndexError: 17"), (write, "something was written")):
        with pytest.raises(AssertionError, match=words):
            try_one(Target("x", tmp_path, ("a.json",), read), random.Random(1), Outcome())

"""Quantisation keeps its bound; packed tensors read back, and damage is an error."""

from __future__ import annotations

import pytest
import torch

from hoigs.core.errors import CheckpointError
from hoigs.runs.compact import bits_of, pack, quantise, restore, unpack


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", [(50, 3), (7,), (4, 5, 2), (1, 1), (0, 3), ()])
def test_every_value_is_within_half_a_step_of_its_channel(bits, shape):
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(shape, generator=generator) * 3 + 1
    levels = quantise(values, bits)
    back = restore(levels, torch.float64)
    assert back.shape == values.shape
    errors = (back - values.double()).abs()
    bound = levels.bound if values.dim() > 1 else levels.bound[0]
    assert (errors <= bound + 1e-12).all()
    if values.numel() > 50:  # and the levels are as coarse as `step`
        assert errors.max() > 0.3 * levels.bound.max()
        spread = values.reshape(-1, shape[-1]).double()
        widths = (spread.amax(0) - spread.amin(0)) / (2**bits - 1)
        torch.testing.assert_close(levels.step, widths)


def test_constant_channels_are_exact():
    values = torch.tensor([[0.3, 1.0], [0.3, 2.0]])
    assert torch.equal(restore(quantise(values, 8), torch.float32), values)


def test_channels_have_ranges_of_their_own():
    """A wide channel does not coarsen a narrow one."""
    values = torch.stack((torch.linspace(0, 1e-3, 100), torch.linspace(0, 1e3, 100)), 1)
    errors = (restore(quantise(values, 8), torch.float32) - values).abs().amax(0)
    assert errors[0] < 1e-5 and errors[1] > 0.1


def test_values_that_are_not_finite_are_refused_by_name():
    with pytest.raises(ValueError, match=r"model\.x: values that are not finite"):
        pack({"model.x": torch.tensor([1.0, float("nan")])})


def test_positions_and_networks_have_sixteen_bits():
    assert bits_of("model.entities.object.sh") == 8
    assert bits_of("model.entities.human.deformation.planes.space") == 8
    for name in ("means", "deformation.keyframe_translations", "deformation.head.0.weight"):
        assert bits_of(f"model.entities.object.{name}") == 16


def tensors() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return {
        "model.e.means": torch.randn(300, 3, generator=generator),
        "model.e.sh": torch.randn(300, 4, 3, generator=generator),
        "model.e.times": torch.linspace(0, 1, 7, dtype=torch.float64),
        "model.e.parts": torch.randint(0, 16, (300,), generator=generator),
        "model.e.seen": torch.rand(300, generator=generator) > 0.5,
        "model.scalar": torch.tensor(0.7),
        "model.empty": torch.zeros(0, 3),
    }


def test_packed_tensors_read_back():
    given = tensors()
    streams, described = pack(given)
    back = unpack(streams, described)
    assert list(back) == list(given)
    for name, value in given.items():
        assert back[name].dtype == value.dtype and back[name].shape == value.shape
        if value.dtype == torch.float32:
            bound = quantise(value, bits_of(name)).bound.max() if value.numel() else 0
            assert (back[name] - value).abs().max() <= bound + 1e-6 if value.numel() else True
        else:
            assert torch.equal(back[name], value)
    assert sum(s.numel() for s in streams.values()) < 0.6 * sum(
        v.numel() * v.element_size() for v in given.values()
    )


def test_packing_a_second_time_changes_nothing():
    once = unpack(*pack(tensors()))
    twice = unpack(*pack(once))
    for name, value in once.items():
        torch.testing.assert_close(twice[name], value, rtol=0, atol=1e-6)


@pytest.mark.parametrize("where", [0, 40, -1])
def test_a_changed_byte_is_an_error(where):
    streams, described = pack(tensors())
    streams["model.e.means"][where] ^= 0x40
    with pytest.raises(CheckpointError, match=r"model\.e\.means: damaged"):
        unpack(streams, described)


def test_an_absent_or_misdescribed_stream_is_an_error():
    streams, described = pack(tensors())
    del streams["model.e.sh"]
    with pytest.raises(CheckpointError, match=r"model\.e\.sh: described, but not in the file"):
        unpack(streams, described)
    streams, described = pack(tensors())
    described["model.e.sh"]["shape"] = [300, 3, 3]
    with pytest.raises(CheckpointError, match=r"model\.e\.sh: does not match its description"):
        unpack(streams, described)

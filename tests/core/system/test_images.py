"""16-bit greys keep their brightness; masks may lie in alpha."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
from PIL import Image

from hoigs.core.system.images import eight_bits, mask_values

RAMP = np.arange(256, dtype=np.uint8).reshape(16, 16)


@pytest.mark.parametrize("kind", [np.uint16, np.int32])
def test_greys_of_16_bits(kind: type) -> None:
    file = io.BytesIO()
    Image.fromarray(RAMP.astype(kind) * 257).save(file, "PNG" if kind is np.uint16 else "TIFF")
    with Image.open(file) as image:
        assert (np.asarray(eight_bits(image).convert("RGB")) == RAMP[..., None]).all()


@pytest.mark.parametrize("values", [RAMP.astype(np.int32) * 70000, RAMP.astype(np.float32)])
def test_greys_without_a_white_are_refused(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match=re.escape(f"{values.max():g}")):
        eight_bits(Image.fromarray(values))


def test_masks_in_alpha() -> None:
    alpha, opaque = Image.fromarray(RAMP), Image.new("L", (16, 16), 255)
    for colour in (0, 255):
        flat = Image.new("L", (16, 16), colour)
        assert (mask_values(Image.merge("RGBA", (flat, flat, flat, alpha))) == RAMP).all()
        assert (mask_values(Image.merge("LA", (flat, alpha))) == RAMP).all()
    assert (mask_values(Image.merge("LA", (alpha, opaque))) == RAMP).all()
    assert (mask_values(alpha) == RAMP).all()


def test_masks_of_16_bits_keep_what_is_not_zero() -> None:
    values = mask_values(Image.fromarray(np.array([[0, 1, 40000, 65535]], np.uint16)))
    assert values.tolist() == [[0, 1, 156, 255]]

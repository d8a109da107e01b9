"""Masks are kept as bits, and lose their crumbs."""

from __future__ import annotations

import numpy as np

from hoigs.preparation.mask_stack import MaskStack, largest_parts


def test_odd_widths_survive_the_packing() -> None:
    mask = np.random.default_rng(0).random((5, 13)) > 0.5
    np.testing.assert_array_equal(MaskStack([~mask, mask])[1], mask)


def test_crumbs_go_and_limbs_stay() -> None:
    mask = np.zeros((40, 40), bool)
    mask[2:22, 2:22] = mask[30:36, 30:36] = True
    body = mask.copy()
    mask[38, 38] = True
    np.testing.assert_array_equal(largest_parts(mask), body)
    np.testing.assert_array_equal(largest_parts(~(mask | True)), np.zeros_like(mask))

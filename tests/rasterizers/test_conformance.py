"""Every backend on every device, through every check of the conformance kit."""

from __future__ import annotations

import pytest

from hoigs.testing.checks import Check
from hoigs.testing.rasterizer import CHECKS, RasterizerSubject

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.mark.parametrize("check", [pytest.param(check, id=check.id) for check in CHECKS])
def test_conforms(backend: RasterizerSubject, check: Check[RasterizerSubject]) -> None:
    missing = check.missing(backend)
    if missing is not None:
        pytest.skip(missing)
    check.run(backend)

"""Every backend on every device, through every check of the conformance kit."""

from __future__ import annotations

import pytest
from backends import cases_with_checks

from hoigs.testing.checks import Check
from hoigs.testing.rasterizer import RasterizerSubject

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.mark.parametrize(("backend", "check"), list(cases_with_checks()), indirect=["backend"])
def test_conforms(backend: RasterizerSubject, check: Check[RasterizerSubject]) -> None:
    check.run(backend)

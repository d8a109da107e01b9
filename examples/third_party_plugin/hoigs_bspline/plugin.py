"""What this package offers to hoigs: strings only, so that `hoigs plugins` imports no torch."""

from __future__ import annotations

from collections.abc import Iterator

import hoigs


@hoigs.hookimpl
def hoigs_components() -> Iterator[hoigs.Component]:
    yield hoigs.Component(
        "deformation:b-spline",
        target="hoigs_bspline.deformation:UniformBSpline",
        config="hoigs_bspline.deformation:UniformBSplineConfig",
        api=1,
        summary="a uniform cubic B-spline per Gaussian",
    )

"""D20 to D23: residuals of the interaction are applied or refused as declared."""

from __future__ import annotations

import torch

from hoigs.core.errors import HoigsError
from hoigs.core.model.entity import Entity
from hoigs.core.values.tokens import Residual
from hoigs.testing.compare import require, require_close
from hoigs.testing.deformation.subject import (
    CHECKS,
    INSIDE,
    DeformationSubject,
    applies,
    by_name,
    leaves_out_some,
    require_same,
)
from hoigs.testing.modules import weighted_sum


def mean_residual(entity: Entity) -> torch.Tensor:
    generator = torch.Generator().manual_seed(11)
    return 0.1 * torch.randn(len(entity), 3, generator=generator).to(entity.means)


def pose_residual(entity: Entity) -> torch.Tensor:
    generator = torch.Generator().manual_seed(12)
    return 0.2 * torch.randn(51, 3, generator=generator).to(entity.means)


@CHECKS.check("D20", applies("means"))
def a_displacement_is_added(subject: DeformationSubject) -> None:
    """A residual of the means is added to them in the world, and changes nothing else."""
    entity = subject.entity()
    for time in INSIDE:
        plain = subject.draw(entity, time)
        moved = subject.draw(entity, time, Residual(means=mean_residual(entity)))
        require_close(
            f"means at {time}", moved.means, plain.means + mean_residual(entity), atol=1e-5
        )
        require_same(f"at {time}", moved.replace(means=plain.means), plain, atol=1e-6)


@CHECKS.check("D21", applies("pose"))
def a_pose_correction_moves_the_body(subject: DeformationSubject) -> None:
    """A residual of the pose moves Gaussians; one of zeros moves none."""
    entity = subject.entity(40)
    plain = subject.draw(entity, 0.4)
    still = subject.draw(entity, 0.4, Residual(pose=0 * pose_residual(entity)))
    require_same("a pose correction of zeros", still, plain)
    moved = subject.draw(entity, 0.4, Residual(pose=pose_residual(entity)))
    apart = float((moved.means - plain.means).norm(dim=-1).max())
    require(apart > 1e-3, f"with 0.2 rad at every joint, no Gaussian moves over {apart:.2g} m")


@CHECKS.check("D22", leaves_out_some)
def undeclared_residuals_change_nothing(subject: DeformationSubject) -> None:
    """A residual that is not declared is refused, or changes nothing."""
    entity = subject.entity()
    plain = subject.draw(entity, 0.4)
    every = {"means": mean_residual(entity), "pose": pose_residual(entity)}
    for part in sorted({"means", "pose"} - entity.deformation.residuals):
        try:
            output = subject.draw(entity, 0.4, Residual(**{part: every[part]}))
        except (ValueError, HoigsError):
            continue
        require_same(f'with a residual of the "{part}", undeclared', output, plain, atol=0.0)


@CHECKS.check("D23")
def residuals_get_gradients(subject: DeformationSubject) -> None:
    """Declared residuals get gradients, which train the interaction."""
    entity = subject.entity(40)
    every = {"means": mean_residual(entity), "pose": pose_residual(entity)}
    for part in sorted(entity.deformation.residuals):
        leaf = every[part].requires_grad_()
        loss = weighted_sum(by_name(subject.draw(entity, 0.4, Residual(**{part: leaf}))))
        found = (
            torch.autograd.grad(loss, leaf, allow_unused=True)[0] if loss.requires_grad else None
        )
        reached = found is not None and bool((found != 0).any())
        require(reached, f'no gradient reaches the residual of the "{part}"')

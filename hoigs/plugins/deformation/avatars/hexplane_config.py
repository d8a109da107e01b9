"""Settings of deformation:hexplane-skinning."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hoigs.core.values.moment import ResidualRule
from hoigs.plugins.deformation.avatars.alpha_start import AlphaStart
from hoigs.plugins.deformation.avatars.body.skinned_body import SkinnedBodyConfig
from hoigs.plugins.deformation.avatars.body.surface_laplacian import LaplacianOn, Smoothed
from hoigs.plugins.deformation.avatars.body_planes import Fusion
from hoigs.plugins.deformation.avatars.canonical_head import HeadKind
from hoigs.plugins.deformation.avatars.nonrigid import NonRigidConfig


class HexPlaneSkinningConfig(SkinnedBodyConfig):
    """The paper's human; sizes that the paper does not give are ExAvatar's."""

    fusion: Fusion = "paired"
    """How six planes give 96 features. "paired" multiplies each space plane with the time plane of
    the third axis and concatenates the three (HexPlane); it is the default, as f and phi come from
    the same planes, 3 x 32 wide. "product" multiplies all six, at three resolutions (4DGS,
    K-Planes)."""
    resolution: int = Field(default=128, ge=2)
    """Cells along each space axis of the feature planes."""
    channels: int = Field(default=32, ge=1)
    """Channels of each feature plane."""
    time_resolution: int | None = Field(default=None, ge=0)
    """Cells along time. None is half the frames; 0 leaves the time planes out, for a human whose
    tokens nothing reads."""
    box: float = Field(default=2.5, gt=0)
    """Side of the cube about the pelvis that the planes cover, metres."""
    width: int = Field(default=128, ge=8)
    """Width of the hidden layers of psi_h."""
    head: HeadKind = "full"
    """What psi_h predicts: "full" is the paper's colour, opacity, offset, rotation, scale and
    skinning weights; "exavatar" colour, offset and one isotropic scale, of opaque Gaussians."""
    free_attributes: bool | Literal["all"] = True
    """Train each Gaussian's own colour, opacity and scale too, to which psi_h then adds; they
    converge sooner. "all" trains its mean and rotation as well, so that it may leave the surface of
    the template. False is the paper: all comes from the planes."""
    scale_about: Literal["pelvis", "camera"] = "pelvis"
    """The fixed point of alpha, which the paper does not give (with the world's origin the person
    would move). "pelvis", the default, changes the person's size, which images show; "camera"
    changes the depth but not the image, so that only L_depth can learn alpha."""
    alpha_start: AlphaStart = "one"
    """Alpha at the start: "one", or the ratio of the clip's metric "depth" to the body's own, which
    fits the scale about the camera."""
    field_points: int = Field(default=1536, ge=16)
    """Body points at which phi is read, spread over the 16 parts."""
    field_at: Literal["posed", "canonical"] = "posed"
    """"posed" reads phi where the body is (the supplement's "dynamic coordinates", relative to the
    pelvis, as planes over the world would leave most cells unused); "canonical" on the body in its
    zero pose, so that only time changes a token."""
    residual_rule: ResidualRule = "add"
    """How delta theta joins theta: "add" axis-angles, as the paper prints it, or "compose"
    rotations, which differs for large angles."""
    nonrigid: bool | Literal["auto", "shading"] = False
    """What is learned beside the skeleton, at every time. True: an offset and a change of colour of
    every canonical point, for clothes, hair, soft tissue and what is wrong with a pose. "shading":
    how bright it is, for light and shadow on people who are rigid between their joints. "auto":
    True, or "shading" where the clip declares its poses to be exact, as built-in clips do. False is
    the paper's Eq. 5."""
    nonrigid_motion: NonRigidConfig = Field(default_factory=NonRigidConfig)
    """Sizes of what `nonrigid` learns."""
    laplacian: LaplacianOn = "points"
    """Where L_reg of psi_h is taken: over neighbouring "points", the Gaussians, at no further cost;
    or over the vertices of the body's "mesh" (the paper), by a second pass of psi_h, but then
    neighbours never reach from one thigh to the other."""
    laplacian_of: tuple[Smoothed, ...] = ("offset",)
    """What L_reg smooths: "offset", "scale" and "color" (ExAvatar), or fewer."""

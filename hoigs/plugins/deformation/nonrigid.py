"""What a person does beside following the skeleton: clothes, hair, soft tissue, and shading."""

from __future__ import annotations

from abc import ABC, abstractmethod

from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import pad

from hoigs.core.config import ComponentConfig
from hoigs.core.device import Time
from hoigs.core.maths.feature_planes import PairedPlanes
from hoigs.core.parameters import zeroed
from hoigs.core.values.gaussians import SH_C0, GaussianDelta, Gaussians
from hoigs.plugins.deformation.irradiance import mid_grey

LEAST = 4  # cells along time
UNIT = 0.1  # metres, of offsets: at the learning rate of networks, metres would diverge


class NonRigidConfig(ComponentConfig):
    """Sizes of what is learned beside the skeleton, of motion or of shading."""

    channels: int = Field(default=32, ge=1)
    """Channels of each of its planes."""
    resolution: int = Field(default=64, ge=2)
    """Cells along each space axis of its planes: folds of clothes, not their pattern."""
    frames: int = Field(default=3, ge=1)
    """Frames of a cell along time: one that is not trained on takes the motion of those around."""
    width: int = Field(default=64, ge=1)
    """Width of its hidden layer."""


class NonRigid(nn.Module, ABC):
    """A network over phi(P_c, t), HexPlane features of canonical points at a time.

    Each starts by changing nothing. Features are smooth over the body and in time, so that a frame
    that is not trained on takes what those around it have learned.

    Args:
        num_frames: frames in the clip. outputs: network outputs for each point.
    """

    def __init__(self, config: NonRigidConfig, num_frames: int, outputs: int) -> None:
        super().__init__()
        cells = max(LEAST, num_frames // config.frames)
        self.planes = PairedPlanes(config.channels, config.resolution, cells)
        self.layers = nn.Sequential(
            nn.Linear(self.planes.width, config.width),
            nn.ReLU(inplace=True),
            zeroed(nn.Linear(config.width, outputs)),
        )

    def read(self, points: Float[Tensor, "N 3"], time: Time) -> Float[Tensor, "N outputs"]:
        """
        Args:
            points: points in the zero pose, in [-1, 1] within the planes. time: in [0, 1].
        """
        return self.layers(self.planes(points, time))

    @abstractmethod
    def change(
        self, canonical: Gaussians, points: Float[Tensor, "N 3"], time: Time
    ) -> tuple[GaussianDelta, dict[str, Tensor]]:
        """What to add to the canonical Gaussians, and by name what is penalised, squared.

        Args:
            points: where the planes are read, see `read`.
        """

    def penalties(self) -> dict[str, Tensor]:
        """Penalties of the planes, as in `HexPlaneSkinning.regularizers`."""
        return {
            "nonrigid_smoothness": self.planes.time_smoothness(),
            "nonrigid_sparsity": self.planes.time_sparsity(),
        }


class NonRigidMotion(NonRigid):
    """(dP, dc) = psi_n(phi(P_c, t)): offset and change of colour of canonical points at a time.

    HOIGS describes soft tissue, learned by "temporally varying parameters alongside spatial
    features", and gives no equation of it. Canonical points that move by a network before they are
    skinned are those of 3DGS-Avatar (Qian et al. 2024, arXiv:2312.09228), which reads the pose
    where this reads the time.
    """

    def __init__(self, config: NonRigidConfig, num_frames: int) -> None:
        super().__init__(config, num_frames, outputs=6)

    def change(
        self, canonical: Gaussians, points: Float[Tensor, "N 3"], time: Time
    ) -> tuple[GaussianDelta, dict[str, Tensor]]:
        offsets, colors = self.read(points, time).split(3, dim=-1)
        offsets = UNIT * offsets
        others = canonical.sh.shape[1] - 1
        sh = pad(colors[:, None] / SH_C0, (0, 0, 0, others))
        return GaussianDelta(means=offsets, sh=sh), {"nonrigid": offsets}


class Shading(NonRigid):
    """c' = exp(psi_s(phi(P_c, t))) c: light and shadow on a body that turns and bends, at a time.

    One factor for all channels, as light is nearly white, and no offset: with those, each frame
    would learn what only its own camera sees, and other views of it lose (docs/results).
    """

    def __init__(self, config: NonRigidConfig, num_frames: int) -> None:
        super().__init__(config, num_frames, outputs=1)

    def change(
        self, canonical: Gaussians, points: Float[Tensor, "N 3"], time: Time
    ) -> tuple[GaussianDelta, dict[str, Tensor]]:
        exponents = self.read(points, time)
        sh = exponents.expm1()[..., None] * (canonical.sh + mid_grey(canonical.sh))
        return GaussianDelta(sh=sh), {"shading": exponents}

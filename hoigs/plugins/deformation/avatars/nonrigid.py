"""What a person does beside following the skeleton: clothes, hair, soft tissue, and shading."""

from __future__ import annotations

from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import pad

from hoigs.core.config import ComponentConfig
from hoigs.core.cuda_graphs.device_constants import Time
from hoigs.core.maths.feature_planes import PairedPlanes
from hoigs.core.maths.networks import dense, zeroed
from hoigs.core.values.gaussians import SH_C0, GaussianDelta

LEAST = 4  # cells along time
UNIT = 0.1  # metres, of offsets: at the learning rate of networks, metres would diverge


class NonRigidConfig(ComponentConfig):
    """Sizes of what is learned beside the skeleton."""

    channels: int = Field(default=32, ge=1)
    """Channels of each of its planes."""
    resolution: int = Field(default=64, ge=2)
    """Cells along each space axis of its planes: folds of clothes, not their pattern."""
    frames: int = Field(default=3, ge=1)
    """Frames of a cell along time: one that is not trained on takes the motion of those around."""
    width: int = Field(default=64, ge=1)
    """Width of its hidden layer."""


class NonRigidMotion(nn.Module):
    """(dP, dc) = psi_n(phi(P_c, t)): offset and change of colour of canonical points at a time.

    HOIGS describes soft tissue, learned by "temporally varying parameters alongside spatial
    features", and gives no equation of it. Canonical points that move by a network before they are
    skinned are those of 3DGS-Avatar (Qian et al. 2024, arXiv:2312.09228), which reads the pose
    where this reads the time; its features are phi of HexPlane, so that motion is smooth over the
    body and in time. It starts by changing nothing.

    Args:
        num_frames: of the clip.
    """

    def __init__(self, config: NonRigidConfig, num_frames: int) -> None:
        super().__init__()
        cells = max(LEAST, num_frames // config.frames)
        self.planes = PairedPlanes(config.channels, config.resolution, cells)
        self.layers = nn.Sequential(
            nn.Linear(self.planes.width, config.width),
            nn.ReLU(inplace=True),
            zeroed(nn.Linear(config.width, 6)),
        )

    def forward(self, points: Float[Tensor, "N 3"], time: Time, bands: int) -> GaussianDelta:
        """
        Args:
            points: of the zero pose, in [-1, 1] within the planes. time: in [0, 1].
            bands: number of coefficients of the Gaussians' harmonics.
        """
        offsets, colors = dense(self.layers, self.planes(points, time)).split(3, dim=-1)
        return GaussianDelta(
            means=UNIT * offsets, sh=pad(colors[:, None] / SH_C0, (0, 0, 0, bands - 1))
        )

    def penalties(self) -> dict[str, Tensor]:
        """Of the planes, as those of the human's own (`HexPlaneSkinning.regularizers`)."""
        return {
            "nonrigid_smoothness": self.planes.time_smoothness(),
            "nonrigid_sparsity": self.planes.time_sparsity(),
        }

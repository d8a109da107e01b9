"""The same scene under every backend: swap the rasterizer, keep everything else.

Run: python examples/02_swap_rasterizers.py
"""

import torch

import hoigs as h

torch.manual_seed(0)
points = torch.randn(300, 3) * 0.4 + torch.tensor([0.0, 0.0, 3.0])
gaussians = h.Gaussians.from_points(points, torch.rand(300, 3), opacity=0.7)
K = torch.tensor([[80.0, 0, 32], [0, 80.0, 32], [0, 0, 1]])
camera = h.Camera(K, torch.eye(4), width=64, height=64)

oracle = h.OracleRasterizer(h.OracleRasterizer.Config(cutoffs=True))
reference = oracle.render(gaussians, camera).color
for backend in (h.TorchRasterizer(), h.WarpRasterizer()):
    image = backend.render(gaussians, camera).color
    off = float((image - reference).abs().max())
    print(f"{type(backend).__name__:>16}: {off:.1e} off the oracle")

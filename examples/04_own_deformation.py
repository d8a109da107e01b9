"""A deformation of your own, in a script: no package, no registry. It learns to follow a ball.

Run: python examples/04_own_deformation.py [STEPS]
"""

import math
import sys

import torch
from torch import nn

import hoigs as h

steps = int(sys.argv[1]) if sys.argv[1:] else 200


class Swing(h.DeformationModel):
    """x(t) = x + a sin(pi t), with one a [3] for the whole entity, metres."""

    input_space = "world"

    def bind(self, canonical):
        self.swing = nn.Parameter(torch.zeros(3))

    def forward(self, canonical, moment, residual=None):
        return canonical.replace(
            means=canonical.means + self.swing * math.sin(math.pi * moment.time)
        )


torch.manual_seed(0)
ball = h.Gaussians.from_points(0.1 * torch.randn(80, 3) + torch.tensor([0.0, 0, 2]), opacity=0.8)
K = torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])
camera = h.Camera(K, torch.eye(4), width=32, height=32)

# what happens: the ball goes 0.3 m to the right and comes back
happened = h.SceneModel({"ball": h.Entity(ball, Swing())}, rasterizer=h.WarpRasterizer())
happened.entity("ball").deformation.get_parameter("swing").data = torch.tensor([0.3, 0.0, 0.0])

learned = h.SceneModel({"ball": h.Entity(ball, Swing())}, rasterizer=h.WarpRasterizer())
swing = learned.entity("ball").deformation.get_parameter("swing")
optimizer = torch.optim.Adam([swing], lr=0.01)
for step in range(steps):
    moment = h.Moment(time=(step % 9) / 8)
    with torch.no_grad():
        target = happened.render(moment, camera).color
    loss = (learned.render(moment, camera).color - target).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
print("learned swing, metres:", [round(x, 3) for x in swing.tolist()], "expected 0.3, 0, 0")

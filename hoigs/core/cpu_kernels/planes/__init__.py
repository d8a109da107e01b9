"""Bilinear samples of feature planes, and their gradients: `function`."""

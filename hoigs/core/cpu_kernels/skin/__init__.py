"""Skinning of points and rotations, products of quaternions, and their gradients: `function`."""

"""Projection: raw Gaussians to records on screen, and gradients back.

arguments                     arguments and results of the two kernels
kernels                       `project` and `project_adjoint`, for CPU and CUDA
geometry                      EWA projection of one Gaussian and its adjoint
optics                        the same kernels for cameras with optics, and their geometry
spherical_harmonics           view-dependent colour and its adjoint
spherical_harmonics_adjoint   the adjoint of view-dependent colour on CUDA
"""

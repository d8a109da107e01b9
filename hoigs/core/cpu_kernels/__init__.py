"""Warp's kernels on CPUs, where torch operations in a row would move more memory than needed.

choose       whether a computation can run by them
dense, planes, roughness, skin
             the computations: `function` for autograd, `kernels`, and their C++ in `source`
launch       launching kernels with little overhead
runtime      Warp, initialised quietly; every module of kernels takes `wp` from here
workers      the same launch on several cores
"""

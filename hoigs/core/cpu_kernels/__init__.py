"""Warp's kernels on CPUs, where torch operations in a row would move more memory than needed.

choose       whether a computation can run by them
runtime      Warp, initialised quietly; every module of kernels takes `wp` from here
launch       launching kernels with little overhead
workers      the same launch on several cores
dense        layers of networks: dense_kernels, dense_source
planes       bilinear samples of feature planes: plane_kernels, plane_source
"""

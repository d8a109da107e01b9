"""What the stages and devices share.

runtime      Warp, initialised quietly; every module takes `wp` from here
records      layout of the arrays between kernels
frame        settings, inputs, tile intersections and images of one render
cpu_launch   launching kernels on a CPU with little overhead
"""

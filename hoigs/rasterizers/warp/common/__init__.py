"""What the stages and devices share.

records      layout of the arrays between kernels
frame        settings, inputs, tile intersections and images of one render
"""

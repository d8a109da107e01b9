"""CUDA graphs: what a captured computation may contain, and how it is captured.

A CUDA graph is a list of kernels, recorded once ("captured") and launched again as a whole
("replayed"). A replay reads and writes the memory of the capture, and repeats every number that
Python passed to a kernel.

- `capture.capturing`: capture what a block launches.
- `device_constants`: times that may be 0-d tensors, and constants that stay on the device.
- `eligibility.why_not_cuda_graph_safe`: which component, if any, cannot be captured.
"""

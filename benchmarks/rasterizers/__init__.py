"""How fast each rasterizer draws and differentiates, on the CPU or on CUDA.

    python -m benchmarks.rasterizers --date 2026-01-31
    python -m benchmarks.rasterizers --peers warp torch --cases 256x256/20000 --only times
    python -m benchmarks.rasterizers --device cuda --garden garden.npz --date 2026-01-31

Run it from the repository's root on a quiet machine; OMP_NUM_THREADS sets the cores. It writes
JSON and a chart to benchmarks/results. What is measured:

- *times*: forward plus backward, from colour, alpha and depth to every raw field, projection and
  harmonics included unless the peer's note says otherwise. One round runs every peer once, in turn,
  so that whatever else the machine does falls on all of them alike: compare within one run only.
- *growth*: the factor that doubling the Gaussians, or the pixels, costs.
- *stages* (CPU): where the time goes, kernel by kernel, and what part of the machine's own limits
  each reaches, measured in the same run.
- *memory* (CPU): most bytes held at once, as bytes a Gaussian, a pixel and a tile intersection.
"""

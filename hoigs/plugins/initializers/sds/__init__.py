"""An object's unseen sides by score distillation from a diffusion model.

- `initializer`: initializer:sds, from a clip and a pipeline to an ObjectTrack.
- `distillation`: Gaussians from a diffusion model and one view (DreamGaussian's first stage).
- `diffusion`: the distillation loss, and the `Denoiser` that it needs.
- `pipelines`: Stable Diffusion and Zero-1-to-3 pipelines on disk as denoisers.
"""

"""The contracts of components; a plugin author reads one file.

- `deformation`: DeformationModel, and the capabilities that one may provide.
- `features`, `interaction`: FeatureExtractor and InteractionModule.
- `rasterizer`: Rasterizer, RenderRequest, RenderOutput, Capabilities.
- `body`: BodyModel. `density`: DensityControl.
- `estimator`: Estimator. `initializer`: ObjectInitializer. `reader`: ClipReader.
- `configurable`, `context`: how a class is built from its settings and a BuildContext.
"""

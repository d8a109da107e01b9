"""What several readers share.

- `lazy_frames.LazyFrames`: frames that are decoded on access, with lens distortion removed;
  `hoigs.core.files.pixel_cache.PixelCache` keeps the last used in memory.
- `listing.require_files`: one error for all absent files of a layout.
- `frame_order`: natural order of file names, and the times of frames.
- `poses`, `transforms`, `colmap_model`: cameras and body poses from the conventions of others.
- `point_file`, `start_points`, `template_mesh`: first points of scenes and objects.
- `json_file`: data files.
"""

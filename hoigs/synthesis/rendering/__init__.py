"""Rendering: `raycast.RayCaster` renders a view, `paths` places cameras, `shutter` adds blur."""

"""Drawing: the renderer, plots, video."""

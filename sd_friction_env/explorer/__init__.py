"""The live explorer in the browser; needs Bokeh (extra "explore")."""

from sd_friction_env.extras import extra

with extra("explore"):
    import bokeh as bokeh

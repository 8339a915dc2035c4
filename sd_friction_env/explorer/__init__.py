"""The live explorer in the browser; needs Bokeh (extra "explore").

Raises:
    ImportError: if Bokeh is not installed.
"""

import importlib.util

if importlib.util.find_spec("bokeh") is None:
    raise ImportError('the explorer needs bokeh: pip install "sd-friction-env[explore]"')

"""Measure how long the explorer takes from a moved slider to the new curve in the browser.

    python scripts/explorer_latency.py                     40 moves of the belt speed and of alpha
    python scripts/explorer_latency.py --moves 200

Needs the extra "explore", Playwright, and a Chromium that is installed (chromium, google-chrome).
"""

import contextlib
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sd_friction_env.cli.options import Parser

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

# From setting a slider to the arrival of the curve that follows from it, as the browser's clock says.
_MOVE = """
([name, value]) => new Promise(resolve => {
    const page = Bokeh.documents[0], curve = page.get_model_by_name("curve");
    const begun = performance.now();
    const arrived = () => {
        curve.properties.data.change.disconnect(arrived);
        requestAnimationFrame(() => resolve(performance.now() - begun));
    };
    curve.properties.data.change.connect(arrived);
    page.get_model_by_name(name).value = value;
})
"""


def browser() -> str | None:
    """Return the path of an installed Chromium; None if there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextlib.contextmanager
def explorer_page(width: int = 1400, height: int = 900) -> Iterator[tuple[Any, list[str]]]:
    """Start the explorer and a browser without a window; yield its page, ready, and the list of errors it has met.

    Raises:
        RuntimeError: if the explorer does not start.
    """
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "sd_friction_env", "explore", "--port", "0", "--no-browser"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http://\S+", server.stdout.readline())
        if found is None:
            raise RuntimeError(f"the explorer did not start: {' '.join(command)}")
        with sync_playwright() as playwright:
            # No sandbox: containers seldom allow it, and the page is our own.
            chromium = playwright.chromium.launch(executable_path=browser(), args=["--no-sandbox"])
            page = chromium.new_page(viewport={"width": width, "height": height})
            errors: list[str] = []
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on("console", lambda said: errors.append(said.text) if said.type in ("error", "warning") else None)
            page.goto(found[0])
            page.wait_for_function(
                "window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].get_model_by_name('path')"
            )
            page.wait_for_function("Bokeh.documents[0].get_model_by_name('path').data.t.length > 8")
            yield page, errors
            chromium.close()
    finally:
        server.terminate()
        server.wait(30)
        if server.stdout is not None:
            server.stdout.close()


def move(page: Any, slider: str, value: float) -> float:
    """Set a slider of the page, and return how many milliseconds later the new curve was there."""
    return float(page.evaluate(_MOVE, [slider, value]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; return the exit status."""
    parser = Parser(description=__doc__, prog="explorer_latency.py")
    parser.add_argument("--moves", type=int, default=40, metavar="N", help="of each slider (default: 40)")
    options = parser.parse_args(arguments)
    if options.moves < 1:
        parser.error(f"--moves must be at least 1, got {options.moves}")
    if browser() is None:
        parser.error(f"no browser was found: install one of {', '.join(BROWSERS)}")
    with explorer_page() as (page, errors):
        for slider, low, high in (("belt_speed", 0.1, 0.5), ("alpha", 0.3, 1.1), ("mu_m", 0.02, 0.15)):
            values = np.round(np.linspace(low, high, options.moves), 6)
            taken = [move(page, slider, float(value)) for value in values]
            print(
                f"{slider:12} from slider to curve: median {np.median(taken):.0f} ms, 95% within "
                f"{np.quantile(taken, 0.95):.0f} ms, longest {max(taken):.0f} ms ({options.moves} moves)"
            )
    for error in dict.fromkeys(errors):
        print(f"explorer_latency.py: the page met an error: {error}", file=sys.stderr)
    return 1 if errors else 0


if __name__ == "__main__":
    raise SystemExit(main())

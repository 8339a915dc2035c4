"""Spectrum, harmonics and envelope of a sampled motion, as tidy tables: what an analyser of vibration shows."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, signal
from scipy.interpolate import CubicHermiteSpline

from sd_friction_env.physics.parameters import checked_count, checked_number
from sd_friction_env.physics.tables import Table
from sd_friction_env.physics.theory import FloatArray

_WINDOW = "blackmanharris"  # of harmonics: its sidelobes lie 92 dB below the main lobe
_PADDING = 8  # the spectrum in which the fundamental is searched has so many times more lines
_FLOOR = 1e-3  # of the strongest line: what is weaker is no candidate for the fundamental


def spectrum(samples: ArrayLike, dt: float, *, window: str = "hann", reference: float = 1.0) -> Table:
    """Return the one-sided amplitude spectrum of evenly spaced samples: a sine of amplitude a peaks at a.

    Args:
        samples: of shape (n,) with n >= 8, such as ``simulate(...).v``.
        dt: time between two of them; seconds make the frequencies hertz.
        window: a name that ``scipy.signal.get_window`` knows; it is divided by its mean.
        reference: amplitude at 0 dB, in the samples' unit.

    Returns:
        A table with the columns frequency (cycles per unit of time, from 0 to 1/(2 dt)), amplitude, and level in dB,
        20 log10(amplitude/reference).

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    checked = _checked_signal(samples, dt, reference)
    size = len(checked.samples)
    weights = _weights(window, size)
    amplitude = np.abs(fft.rfft(weights * checked.samples)) / size
    amplitude[1 : (size + 1) // 2] *= 2.0  # zero and the highest frequency of an even number have no mirror image
    columns = {"frequency": fft.rfftfreq(size, checked.dt), "amplitude": amplitude}
    metadata = {"window": window, "reference": checked.reference, "resolution": 1.0 / (size * checked.dt)}
    return Table(columns | {"level": _level(amplitude, checked.reference)}, metadata)


def harmonics(samples: ArrayLike, dt: float, *, count: int = 10, reference: float = 1.0) -> Table:
    """Return the fundamental and its multiples in evenly spaced samples of a periodic motion.

    The fundamental is the lowest peak above a thousandth of the highest one, interpolated by a parabola through the
    logarithms of three lines of a padded spectrum (Smith and Serra, 1987): with ten periods or more its error is far
    below 0.1%. The amplitudes are Fourier coefficients at the exact multiples, under a Blackman-Harris window.

    Args:
        samples, dt, reference: as of :func:`spectrum`, over eight periods or more.
        count: of multiples, from 1 on; those above half the sampling rate are left out.

    Returns:
        A table with the columns order (1 is the fundamental), frequency, amplitude, phase (radians, of a cosine at the
        first sample) and level (dB).

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, or the samples are constant or
            too few to separate the fundamental from zero.
    """
    checked = _checked_signal(samples, dt, reference)
    count = checked_count("count", count, 1, 100_000)
    centred = checked.samples - checked.samples.mean()
    size = len(centred)
    weights = _weights(_WINDOW, size)
    padded = _PADDING * fft.next_fast_len(size)
    lines = np.abs(fft.rfft(weights * centred, padded))
    peaks, _ = signal.find_peaks(lines, height=_FLOOR * lines.max())
    peaks = peaks[peaks > 4 * padded // size]  # closer to zero the main lobes of a line and its image overlap
    if not peaks.size or not np.ptp(centred) > 0.0:
        raise ValueError(f"samples must hold eight periods of a vibration or more, got {size} without a clear line")
    left, middle, right = np.log(lines[peaks[0] - 1 : peaks[0] + 2])
    fundamental = (peaks[0] + 0.5 * (left - right) / (left - 2.0 * middle + right)) / (padded * checked.dt)
    orders = np.arange(1, min(count, max(1, int(0.5 / (fundamental * checked.dt)))) + 1)
    angle = -2j * np.pi * fundamental * checked.dt * np.arange(size)
    coefficients = np.array([2.0 * np.mean(weights * centred * np.exp(order * angle)) for order in orders])
    amplitude = np.abs(coefficients)
    columns = {"order": orders, "frequency": orders * fundamental, "amplitude": amplitude}
    columns |= {"phase": np.angle(coefficients), "level": _level(amplitude, checked.reference)}
    return Table(columns, {"window": _WINDOW, "reference": checked.reference})


def envelope(t: ArrayLike, x: ArrayLike, v: ArrayLike) -> Table:
    """Return the swings of a motion and the rate at which they grow (above 0) or decay (below 0).

    A swing is half the distance between two successive extremes of x, which are located between the samples by the
    cubic through x and v; it needs no knowledge of the equilibrium. Damped free vibration has exactly the rate -beta at
    every swing.

    Args:
        t, x, v: samples, each of shape (n,), such as those of a ``Trajectory``; t must increase.

    Returns:
        A table with a row for each swing: t (its middle), amplitude, and rate, the growth of log(amplitude) per unit of
        time since the swing before (NaN in the first row). Its metadata have the rate of the straight line fitted to
        log(amplitude) (NaN with fewer than two swings).

    Raises:
        TypeError, ValueError: if an argument is not of the type above.
    """
    times, places, speeds = (_checked_samples(name, part, 2) for name, part in (("t", t), ("x", x), ("v", v)))
    if not len(times) == len(places) == len(speeds) or not (np.diff(times) > 0.0).all():
        lengths = (len(times), len(places), len(speeds))
        raise ValueError(f"t, x and v must have one length and t must increase, got lengths {lengths}")
    motion = CubicHermiteSpline(times, places, speeds)
    turns = motion.derivative().roots(extrapolate=False)
    turns = turns[np.isfinite(turns)]  # NaN follows where the mass is at rest
    swings = np.diff(motion(turns))
    amplitude, middle = 0.5 * np.abs(swings), 0.5 * (turns[1:] + turns[:-1])
    # A double root is no extreme: it has no swing.
    amplitude, middle = amplitude[amplitude > 0.0], middle[amplitude > 0.0]
    rate, fitted = np.full(len(middle), np.nan), np.nan
    if len(middle) > 1:
        rate[1:] = np.diff(np.log(amplitude)) / np.diff(middle)
        fitted = float(np.polynomial.Polynomial.fit(middle, np.log(amplitude), 1).convert().coef[1])
    return Table({"t": middle, "amplitude": amplitude, "rate": rate}, {"rate": fitted})


class _Signal(NamedTuple):
    samples: FloatArray
    dt: float
    reference: float


def _checked_signal(samples: ArrayLike, dt: float, reference: float) -> _Signal:
    return _Signal(
        _checked_samples("samples", samples, 8),
        checked_number("dt", dt, 1e-12, 1e12),
        checked_number("reference", reference, 1e-300, 1e300),
    )


def _checked_samples(name: str, values: Any, fewest: int) -> FloatArray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be an array of numbers, got {type(values).__name__}") from None
    if array.ndim != 1 or len(array) < fewest or not np.isfinite(array).all():
        what = f"shape {array.shape}" if array.ndim != 1 or len(array) < fewest else "NaN or infinity among them"
        raise ValueError(f"{name} must be finite, of shape (n,) with n >= {fewest}, got {what}")
    return array


def _weights(window: str, size: int) -> FloatArray:
    try:
        weights: FloatArray = np.asarray(signal.get_window(window, size), dtype=np.float64)
    except (TypeError, ValueError) as error:
        known = "a name that scipy.signal.get_window knows"
        raise ValueError(f"window must be {known}, got {window!r} ({error})") from None
    weights /= weights.mean()
    return weights


def _level(amplitude: FloatArray, reference: float) -> FloatArray:
    with np.errstate(divide="ignore"):  # silence is minus infinity
        return 20.0 * np.log10(amplitude / reference)

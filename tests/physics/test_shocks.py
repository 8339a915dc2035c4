"""The smallest shock that leaves a basin against brute force, shares with intervals, and labels on disk."""

import math

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, attractors, basin_grid
from sd_friction_env.physics.basins import basins
from sd_friction_env.physics.shocks import basin_integrity, smallest_shock
from sd_friction_env.physics.sweeps import Engine, basin_file, integrity_sweep

EXACT = OscillatorParameters()
BISTABLE = EXACT.replace(geometry="linear", friction="exponential", mu_s=1.0, mu_k=0.5, v_0=0.5)
SHAKEN = [
    *(EXACT.replace(alpha=alpha, belt_speed=speed) for alpha, speed in ((0.5, 0.43), (0.7, 0.46))),
    *(EXACT.replace(geometry="cubic", alpha=alpha, belt_speed=0.46) for alpha in (0.5, 0.7)),
    *(BISTABLE.replace(belt_speed=speed) for speed in (1.3, 1.7)),
]
STEP = 0.02  # of the grid of shocks, in x and v


def smallest_on_grid(plant, cycle, label, shock, phases=32):
    """Return the smallest shock of a square grid, at phases of a cycle, after which a motion ends elsewhere."""
    size = np.arange(-2.0, 2.0 + STEP, STEP)
    dx, dv = np.meshgrid(size, size)
    sizes = np.hypot(dx, dv)
    near = sizes < shock.size + 3.0 * STEP
    smallest = math.inf
    for phase in np.arange(phases if cycle.period > 0.0 else 1) / phases:
        x, v = cycle.state(phase)
        labels = basins(plant, x + dx[near], v + dv[near]).labels
        smallest = min(smallest, sizes[near][(labels != label) & (labels != -2)].min(initial=math.inf))
    return smallest


@pytest.mark.parametrize("plant", SHAKEN)
def test_the_smallest_shock_is_below_brute_force_and_within_its_step(plant):
    found = attractors(plant)
    assert len(found) == 2
    for label, cycle in enumerate(found):
        shock = smallest_shock(cycle, starts=4000)
        smallest = smallest_on_grid(plant, cycle, label, shock)
        assert shock.size <= smallest
        assert smallest - shock.size < np.sqrt(2.0) * STEP
        after, inside = (basins(plant, shock.x + k * shock.dx, shock.v + k * shock.dv).labels for k in (1.0, 0.999))
        assert (int(after), int(inside)) == (shock.reaches, label)


def test_scales_measure_a_shock_and_one_attractor_has_a_reason():
    plant = EXACT.replace(alpha=0.7, belt_speed=0.46)
    cycle = attractors(plant)[0]
    plain, scaled = smallest_shock(cycle, starts=2000), smallest_shock(cycle, starts=2000, scales=(2.0, 2.0))
    assert scaled.size == pytest.approx(0.5 * plain.size, rel=1e-6)
    assert smallest_shock(cycle, point=(cycle.x_max, 0.0), starts=2000).size == pytest.approx(plain.size, rel=1e-6)
    table = basin_integrity(EXACT, starts=1000)
    assert table["note"].tolist() == ["the only attractor"]
    assert np.isnan(table["shock"]).all()
    assert table["fraction"].tolist() == [1.0]
    assert 0.99 < table["fraction_low"][0] < 1.0


def test_a_sweep_of_integrity_goes_on_and_gives_reasons_in_rows(tmp_path):
    plants = [BISTABLE.replace(belt_speed=speed) for speed in (0.0, 1.3)]
    for _ in range(2):
        still, moving = integrity_sweep(plants, (-2.0, 2.0), (-2.0, 2.0), Engine(folder=tmp_path / "kept"), starts=1000)
        assert "belt_speed" in still["note"][0]
        assert set(moving) == set(still)
        alone = basin_integrity(plants[1], (-2.0, 2.0), (-2.0, 2.0), starts=1000)
        assert all(moving[name].tolist() == alone[name].tolist() for name in alone)


def test_labels_on_disk_are_those_in_memory_and_go_on_from_their_folder(tmp_path):
    plant, box = EXACT.replace(alpha=0.2), ((-1.5, 1.5), (-1.0, 1.0), (60, 50))
    _, _, whole = basin_grid(plant, *box)
    engine = Engine(folder=tmp_path / "kept")
    for name in ("first.npy", "second.npy"):
        table = basin_file(plant, *box, engine, tmp_path / name, chunk=700)
        labels = np.load(tmp_path / name, mmap_mode="r")
        assert labels.dtype == np.int8
        assert np.array_equal(labels, whole.labels)
        assert table["fraction"].tolist() == whole.fractions()["fraction"].tolist()
        sorted((tmp_path / "kept").glob("chunk-*.npz"))[1].unlink()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"starts": 10}, "starts must be"),
        ({"scales": (0.0, 1.0)}, "scales must be"),
        ({"scales": (1.0,)}, "scales must be two"),
        ({"limit": 0.0}, "limit must be"),
        ({"seed": -1}, "seed must be"),
    ],
)
def test_shocks_that_cannot_be_searched_are_refused(arguments, named, tmp_path):
    with pytest.raises(ValueError, match=named):
        basin_integrity(EXACT, **arguments)
    folder = tmp_path / "kept"
    with pytest.raises(ValueError, match=named):
        integrity_sweep([EXACT], (-1.0, 1.0), (-1.0, 1.0), Engine(folder=folder), **arguments)
    assert not folder.exists()

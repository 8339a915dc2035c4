"""What needs an extra says which, wherever it is imported from."""

import importlib
import subprocess
import sys

import pytest

import sd_friction_env
from sd_friction_env.extras import extra


def test_a_missing_module_is_named_with_the_line_that_installs_it():
    with (
        pytest.raises(ModuleNotFoundError, match=r'^wheelbarrow is not installed: pip install "sd-friction-env\[x\]"$'),
        extra("x"),
    ):
        importlib.import_module("wheelbarrow.axle")


def test_a_missing_module_of_ours_is_our_fault():
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'sd_friction_env\.nothing'"), extra("x"):
        importlib.import_module("sd_friction_env.nothing")


BLOCKED = """
import sys
for name in sys.argv[1].split(","):
    sys.modules[name] = None
try:
    exec(sys.argv[2])
except ImportError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("blocked", "statement", "extra_name"),
    [
        ("stable_baselines3", "from sd_friction_env import SDFrictionVecEnv", "train"),
        ("torch,stable_baselines3", "from sd_friction_env import AnnealedExploration", "train"),
        ("stable_baselines3", "import sd_friction_env.environments.sb3", "train"),
        ("pygame", "from sd_friction_env.pictures.renderer import Renderer", "render"),
        ("torch", "from sd_friction_env import torch_step; torch_step()", "torch"),
        ("jax", "from sd_friction_env import jax_step; jax_step()", "jax"),
        (
            "sb3_contrib",
            "from sd_friction_env.cli.main import main; main(['train', '--task', 'force', '--algo', 'ppo'])",
            "train",
        ),
    ],
)
def test_without_its_extra_an_import_says_what_to_install(blocked, statement, extra_name):
    command = [sys.executable, "-c", BLOCKED, blocked, statement]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert f'pip install "sd-friction-env[{extra_name}]"' in done.stdout + done.stderr


def test_public_names_are_those_listed_and_found():
    for name in sd_friction_env.__all__:
        assert getattr(sd_friction_env, name) is not None
    assert set(sd_friction_env.__all__) >= {*sd_friction_env._PUBLIC, *sd_friction_env._MODULES}
